"""Networks that give the moments of a Gaussian."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from zoo.nn.mlp import Activation, trunk

__all__ = ["ConstantNoiseHead", "GaussianHead", "GaussianNetwork", "Noise", "Transfer"]

Transfer = Literal["square", "exponential"]
Noise = Literal["state", "square", "constant", "shared"]

_transfers: dict[Transfer, tuple[Callable[[Tensor], Tensor], Callable[[float], float]]] = {
    "square": (lambda s: s.square(), lambda std: std**0.5),
    "exponential": (lambda s: (s / 2).exp(), lambda std: 2 * math.log(std)),
}


class GaussianHead(nn.Module):
    """Mean μ = W_μ h + b_μ and standard deviation of s = W_σ h + b_σ.

    ``transfer="square"`` is σ = s² + floor (§4.3.1), ``"exponential"`` log σ² = s plus the floor
    (30). W_σ starts at 0 and b_σ so that σ starts at ``initial`` for every input: a square of
    random weights is far off for some.

    >>> import torch
    >>> mean, std = GaussianHead(8, 3)(torch.randn(4, 8))
    >>> mean.shape, std.unique()
    (torch.Size([4, 3]), tensor([1.0010], grad_fn=<Unique2Backward0>))
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        transfer: Transfer = "square",
        floor: float = 1e-3,
        initial: float = 1.0,
    ) -> None:
        """Heads from ``inputs`` features to ``outputs`` coordinates."""
        super().__init__()
        self.floor, self.transfer = floor, transfer
        self.mean = nn.Linear(inputs, outputs)
        self.root = nn.Linear(inputs, outputs)
        nn.init.zeros_(self.root.weight)
        nn.init.constant_(self.root.bias, _transfers[transfer][1](initial))

    def forward(
        self, features: Float[Tensor, "*batch feature"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        std = _transfers[self.transfer][0](self.root(features)) + self.floor
        return self.mean(features), std


class ConstantNoiseHead(nn.Module):
    """Mean from the features and constant standard deviations σ = s² + floor.

    One σ a coordinate, or one for all where ``shared``.

    >>> import torch
    >>> mean, std = ConstantNoiseHead(8, 3)(torch.randn(4, 8))
    >>> mean.shape, std.shape
    (torch.Size([4, 3]), torch.Size([4, 3]))
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        shared: bool = False,
        floor: float = 1e-3,
        initial: float = 1.0,
    ) -> None:
        """Head from ``inputs`` features to ``outputs`` coordinates."""
        super().__init__()
        self.floor = floor
        self.mean = nn.Linear(inputs, outputs)
        start = self.mean.bias.detach().new_full((1 if shared else outputs,), initial**0.5)
        self.root = nn.Parameter(start)

    def forward(
        self, features: Float[Tensor, "*batch feature"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        mean = self.mean(features)
        return mean, (self.root.square() + self.floor).expand_as(mean)


class GaussianNetwork(nn.Module):
    """Hidden layers and a head: p(y | x) = N(y; μ(x), σ²), (30).

    ``noise`` says what σ depends on: the ``state`` x, with log σ² linear in the features, (30); the
    ``square`` of a linear map of them, §4.3.1; a ``constant`` of each output; or one constant
    ``shared`` by all. Without hidden layers μ is linear in x.

    >>> import torch
    >>> mean, std = GaussianNetwork(5, (512,), 50, noise="shared")(torch.randn(8, 70, 5))
    >>> mean.shape, std.unique().numel()
    (torch.Size([8, 70, 50]), 1)
    """

    def __init__(
        self,
        inputs: int,
        hidden: Sequence[int],
        outputs: int,
        *,
        activation: Activation = "relu",
        noise: Noise = "state",
        floor: float = 1e-3,
        initial: float = 1.0,
    ) -> None:
        """A network from ``inputs`` over the ``hidden`` layers to the moments of ``outputs``."""
        super().__init__()
        sizes = [inputs, *hidden]
        self.trunk = trunk(sizes, activation)
        heads: dict[Noise, Callable[..., nn.Module]] = {
            "state": partial(GaussianHead, transfer="exponential"),
            "square": partial(GaussianHead, transfer="square"),
            "constant": ConstantNoiseHead,
            "shared": partial(ConstantNoiseHead, shared=True),
        }
        self.head = heads[noise](sizes[-1], outputs, floor=floor, initial=initial)

    def forward(
        self, x: Float[Tensor, "*batch input"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        moments: tuple[Tensor, Tensor] = self.head(self.trunk(x))
        return moments
