"""Skeleton of a generative model for ``zoo.Svi``: put your mathematics in."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn

import zoo
from zoo.contract.settings import Count, settings

__all__ = ["Config", "FactorModel"]


@settings
class Config:
    """Settings of the model; every field can be set by ``zoo.create(name, data, field=…)``."""

    latent_dim: Count = 2


class FactorModel(nn.Module):
    """Factor analysis of single frames.

    z_t ~ N(0, I),  x_t ~ N(W z_t + μ, diag σ²),

    with z_t the latent state of frame t and σ a learned standard deviation per channel. Write the
    equations of your model here, in the symbols of its paper, with the section of the thesis that
    it comes from, its defaults, and what it cannot give: this docstring is the model's card.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32

    def __init__(self, layout: zoo.Layout, config: Config) -> None:
        """Parameters for data of ``layout``; they are initialised from the seed of the assembly."""
        super().__init__()
        self.layout, self.config = layout, config
        self.latent_dim = config.latent_dim
        self.decoder = nn.Linear(config.latent_dim, len(layout.channels))
        self.log_scale = nn.Parameter(torch.zeros(len(layout.channels)))

    def forward(self, batch: zoo.Batch) -> None:
        """p(x, z): the Pyro program; a plate of the whole size scales a minibatch rightly."""
        shape = (*batch.values.shape[:2], self.latent_dim)
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            prior = dist.Normal(batch.values.new_zeros(shape), 1.0).to_event(2)
            z = pyro.sample("z", prior)
            likelihood = dist.Normal(self.decoder(z), self.log_scale.exp())
            if batch.mask is not None:
                likelihood = likelihood.mask(batch.mask)
            pyro.sample("x", likelihood.to_event(2), obs=batch.given(batch.values))

    def reconstruct(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, draws: int
    ) -> zoo.Predictive:
        """p(x̂ | x): a capability is a method; the zoo finds it by its name."""
        if posterior is None:
            raise ValueError("reconstruct needs the guide's posterior")
        z: Float[Tensor, "sample sequence time latent"] = posterior.draw(batch, draws)["z"]
        return zoo.Predictive(location=self.decoder(z), noise=self.log_scale.exp(), joint=True)
