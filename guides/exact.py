"""The exact posterior of models that know it in closed form."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import pyro
import torch
from torch import Tensor, nn

from zoo.contract.parts import KnowsPosterior
from zoo.contract.settings import settings
from zoo.types import Batch, Layout, Sites

__all__ = ["Config", "ExactPosterior"]


@settings
class Config:
    """No settings: there is nothing to learn."""


class ExactPosterior(nn.Module):
    """q = p(z | x): log p(x, z) − log q(z) is the log evidence, whatever the draw."""

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: KnowsPosterior, config: Config) -> None:
        """Keep a reference to ``model`` outside the registered modules."""
        super().__init__()
        self.config = config
        self._model = (model,)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Draw every latent site from its posterior given those before it."""
        (model,) = self._model
        sites = model.posterior_sites(batch)
        drawn: dict[str, Tensor] = {}
        with _plate(sites):
            for name, law in sites.of.items():
                drawn[name] = pyro.sample(name, law(drawn))
        return drawn


def _plate(sites: Sites) -> AbstractContextManager[Any]:
    if sites.plate is None:
        return nullcontext()
    plate: AbstractContextManager[Any] = pyro.plate(
        sites.plate, size=sites.size, subsample=torch.arange(sites.rows)
    )
    return plate
