"""The exact posterior of models that know it in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

from zoo.types import Batch, Layout

__all__ = ["Config", "ExactPosterior", "KnowsPosterior"]


class KnowsPosterior(Protocol):
    """A model with closed-form inference."""

    def posterior_of(self, batch: Batch) -> dict[str, dist.TorchDistribution]:
        """p(latent site | data) by site name, its batch axis the windows."""
        ...


@dataclass(frozen=True, kw_only=True)
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
        """Draw every latent site from its posterior."""
        (model,) = self._model
        sites = model.posterior_of(batch)
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            return {name: pyro.sample(name, site) for name, site in sites.items()}
