"""q(z_t | x_t): one encoder network for the latent state of every frame."""

from __future__ import annotations

from typing import ClassVar, Protocol

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from zoo.contract.settings import Layers, Positive, settings
from zoo.nn.mlp import Activation, widths
from zoo.nn.moments import GaussianNetwork
from zoo.types import Batch, Layout

__all__ = ["Amortised", "Config", "FrameLatent"]


class FrameLatent(Protocol):
    """A model with one Gaussian latent site ``z`` of shape (window, time, latent)."""

    latent_dim: int

    def explained(self, batch: Batch) -> tuple[int, Bool[Tensor, "window time"] | None]:
        """Leading frames that have a latent state, and which of them count (None: all)."""
        ...


@settings
class Config:
    """Settings of :class:`Amortised`; ``hidden`` are the encoder's layers (() is linear)."""

    hidden: Layers = (512,)
    activation: Activation = "relu"
    encoder_floor: Positive = 1e-4


class Amortised(nn.Module):
    """q(z_t | x_t) = N(μ(x_t), σ²(x_t)), σ with the square as transfer function (§4.3.1)."""

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: FrameLatent, config: Config) -> None:
        """An encoder of the channels of ``layout`` into the latent space of ``model``."""
        super().__init__()
        self.config = config
        self._model = (model,)
        self.encoder = GaussianNetwork(
            len(layout.channels),
            widths(config.hidden),
            model.latent_dim,
            activation=config.activation,
            noise="square",
            floor=config.encoder_floor,
        )

    def forward(self, batch: Batch) -> Tensor:
        """Draw z for every frame that has a latent state."""
        (model,) = self._model
        frames, relevant = model.explained(batch)
        mask = None if batch.mask is None else batch.mask[:, :frames]
        mean, std = self._moments(batch.values[:, :frames], mask)
        kept = True if relevant is None else relevant[..., None]
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            q = dist.Normal(mean, std).mask(kept).to_event(2)
            z: Tensor = pyro.sample("z", q)
        return z

    def encode(
        self,
        values: Float[Tensor, "*batch channel"],
        mask: Bool[Tensor, "*batch channel"] | None = None,
    ) -> torch.distributions.Normal:
        """q(z_t | x_t) of single frames; missing entries are 0 to the encoder."""
        mean, std = self._moments(values, mask)
        return torch.distributions.Normal(mean, std)

    def _moments(self, values: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        x = values if mask is None else torch.where(mask, values, 0.0)
        moments: tuple[Tensor, Tensor] = self.encoder(x)
        return moments
