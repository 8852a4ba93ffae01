"""A guide as models see it: joint draws of its latent sites and encodings of single frames."""

from __future__ import annotations

from typing import Any, cast

import pyro
import torch
from pyro import poutine
from torch import Tensor, nn

from zoo.errors import NotCapableError
from zoo.types import Batch

__all__ = ["GuidePosterior"]


class GuidePosterior:
    """Draws and encodings of a trained guide, behind :class:`zoo.types.Posterior`."""

    def __init__(self, guide: nn.Module) -> None:
        """Wrap ``guide``; it stays the owner of its parameters."""
        self._guide = guide

    def draw(self, batch: Batch, draws: int) -> dict[str, Tensor]:
        """Joint draws of every latent site, shape (sample, ...), from ``draws`` passes at once."""
        many = batch.repeat(draws)
        with pyro.validation_enabled(False):
            trace = poutine.trace(self._guide).get_trace(many)
        values = {n: cast(Tensor, trace.nodes[n]["value"]) for n in trace.stochastic_nodes}
        return {name: v.reshape(draws, -1, *v.shape[1:]) for name, v in values.items()}

    def encode(self, values: Tensor, mask: Tensor | None = None) -> torch.distributions.Normal:
        """q(z_t | x_t) of single frames."""
        encoder = getattr(self._guide, "encode", None)
        if encoder is None:
            raise NotCapableError(f"guide {type(self._guide).__name__} cannot encode single frames")
        return cast(torch.distributions.Normal, cast(Any, encoder)(values, mask))
