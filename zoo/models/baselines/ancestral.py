"""Movements whose frames are drawn one after the other, each given those before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

__all__ = ["Ancestral", "Law"]

Law = Callable[[Tensor, Tensor, range], TorchDistribution]


class Ancestral(TorchDistribution):
    r"""p(x) = Π_t p(x_t | x_{<t}) of movements.

    ``law(x, observed, frames)`` is p(x_t | x_{<t}) of ``frames``, its batch (movement, frame) and
    its event the channels, masked where entries are missing; a draw asks for one frame at a time.

    >>> from pyro.distributions import Normal
    >>> walk = lambda x, observed, t: Normal(x.roll(1, 1)[:, t], 1.0).to_event(1)
    >>> x = Ancestral(walk, torch.ones(400, 50, 1).bool(), torch.zeros(())).sample()
    >>> 0.9 < x[:, 1:].diff(dim=1).std() < 1.1
    tensor(True)
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.real, 2)

    def __init__(
        self, law: Law, observed: Bool[Tensor, "*sample movement frame channel"], like: Tensor
    ) -> None:
        """Movements with the entries ``observed``; ``like`` has their dtype and device."""
        self.law, self.observed, self.like = law, observed, like
        super().__init__(observed.shape[:-2], observed.shape[-2:], validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> Ancestral:
        """The same law for more movements."""
        observed = self.observed.expand(*batch_shape, *self.event_shape)
        return Ancestral(self.law, observed, self.like)

    def sample(self, sample_shape: Any = ()) -> Float[Tensor, "*sample movement frame channel"]:
        """Whole movements, as if all their entries were observed."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        x = self.like.new_zeros(shape).flatten(0, -3)
        observed = torch.ones_like(x, dtype=torch.bool)
        for t in range(x.shape[1]):
            x[:, t] = self.law(x, observed, range(t, t + 1)).sample()[:, 0]
        return x.reshape(shape)

    def log_prob(
        self, value: Float[Tensor, "*sample movement frame channel"]
    ) -> Float[Tensor, "*sample movement"]:
        """Log density of the entries observed, each given those observed before it."""
        x, observed = (v.flatten(0, -3) for v in torch.broadcast_tensors(value, self.observed))
        each = self.law(x, observed, range(x.shape[1])).log_prob(x)
        total: Tensor = each.sum(-1).reshape(value.shape[:-2])
        return total
