"""Skeleton of an amortised guide: it knows a model by a protocol only."""

from __future__ import annotations

from typing import ClassVar, Protocol

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

import zoo
from zoo.contract.settings import Count, settings

__all__ = ["Config", "FrameGuide", "HasLatent"]


class HasLatent(Protocol):
    """What the guide needs of any model."""

    latent_dim: int


@settings
class Config:
    """Settings of the guide."""

    hidden: Count = 32


class FrameGuide(nn.Module):
    """q(z_t | x_t) = N(μ(x_t), diag σ²(x_t)), one hidden layer; sites are named as the model's."""

    config_class: ClassVar[type] = Config

    def __init__(self, layout: zoo.Layout, model: HasLatent, config: Config) -> None:
        """Networks for data of ``layout`` and latents of ``model``."""
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(len(layout.channels), config.hidden), nn.Tanh())
        self.mean = nn.Linear(config.hidden, model.latent_dim)
        self.log_scale = nn.Linear(config.hidden, model.latent_dim)

    def forward(self, batch: zoo.Batch) -> None:
        """q(z | x), in the same plate as the model's."""
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            q = self.encode(batch.values, batch.mask)
            pyro.sample("z", dist.Normal(q.mean, q.stddev).to_event(2))

    def encode(self, values: Tensor, mask: Tensor | None = None) -> torch.distributions.Normal:
        """q(z_t | x_t) of single frames; a missing entry comes in as its mean, 0."""
        h = self.trunk(values if mask is None else values * mask)
        return torch.distributions.Normal(self.mean(h), self.log_scale(h).exp())
