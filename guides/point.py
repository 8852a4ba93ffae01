"""A point guide of movements whose latent paths are primitives: an encoder and a regression."""

from __future__ import annotations

from typing import Annotated, ClassVar, Protocol

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.settings import Count, Layers, Share, settings
from zoo.nn.mlp import Activation, mlp, widths
from zoo.types import Batch, Layout

__all__ = ["Config", "Imitated", "PointGuide", "RunDropout"]


class Imitated(Protocol):
    """A model with a latent path ``y`` of whole movements and parameters ``theta`` of each."""

    latent_dim: int

    def imitate(
        self,
        path: Float[Tensor, "window time latent"],
        seen: Bool[Tensor, "window time"] | None,
        batch: Batch | None = None,
    ) -> Float[Tensor, "window parameter latent"]:
        """Parameters whose roll-out is nearest to a path where it was seen."""
        ...


@settings
class Config:
    """``hidden`` layers of the encoder; ``corruption`` the share of inputs set to 0 in training.

    ``corrupted`` is the share of the training that does so, from its begin. Inputs are dropped in
    runs of ``together`` neighbours: where those of a limb are neighbours, 4 teach an encoder to do
    without the limb, which independent drops (1) hardly ever do.
    """

    hidden: Layers = (36, 20)
    activation: Activation = "tanh"
    corruption: Annotated[float, Field(ge=0, lt=1)] = 0.1
    corrupted: Share = 0.3
    together: Count = 1


class RunDropout(nn.Dropout):
    """Dropout of runs of ``together`` neighbours that may overlap and leave the ends.

    Every entry is dropped with probability p, and the rest divided by 1 − p.

    >>> _ = torch.manual_seed(0)
    >>> RunDropout(0.5, together=3)(torch.ones(12))
    tensor([0., 0., 0., 0., 2., 2., 2., 2., 2., 2., 0., 0.])
    """

    def __init__(self, p: float, together: int = 1) -> None:
        """Dropout of single entries where ``together`` is 1."""
        super().__init__(p)
        self.together = together

    def forward(self, x: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch channel"]:
        """``x`` with entries set to 0 in training, and ``x`` itself after it."""
        if self.together == 1 or not self.training or not self.p:
            kept: Tensor = super().forward(x)
            return kept
        begins = torch.rand(*x.shape[:-1], x.shape[-1] + self.together - 1).to(x)
        dropped = (begins.unfold(-1, self.together, 1) < self._rate).any(-1)
        return x.masked_fill(dropped, 0.0) / (1 - self.p)

    @property
    def _rate(self) -> float:
        """How often a run begins at an entry: none of the runs over it with probability 1 − p."""
        rate: float = 1 - (1 - self.p) ** (1 / self.together)
        return rate


class PointGuide(nn.Module):
    """Points y_t = enc(x_t) and θ, the regression of the path y_{1:n}: one θ a demonstration.

    A first share of the training is that of a denoising encoder: inputs are dropped, singly or in
    runs (:class:`RunDropout`), and the rest is divided by 1 − ``corruption``. Missing entries count
    as the training mean, 0; θ regards frames of which anything was seen.
    """

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: Imitated, config: Config) -> None:
        """An encoder of the channels of ``layout`` into the latent space of ``model``."""
        super().__init__()
        self.config = config
        self._model = (model,)
        sizes = [len(layout.channels), *widths(config.hidden), model.latent_dim]
        self.corrupt = RunDropout(0.0, config.together)
        self.encoder = mlp(sizes, config.activation)
        self.settled = True

    def advance(self, done: float) -> None:
        """Corrupt the inputs in the first share of all steps."""
        self.settled = done >= self.config.corrupted
        self.corrupt.p = 0.0 if self.settled else self.config.corruption

    def forward(self, batch: Batch) -> None:
        """Both latent sites as points."""
        (model,) = self._model
        y = self._encoded(batch.values, batch.mask)
        seen = None if batch.mask is None else batch.mask.any(-1)
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            pyro.sample("y", dist.Delta(y).to_event(2))
            pyro.sample("theta", dist.Delta(model.imitate(y, seen, batch)).to_event(2))

    def encode(
        self,
        values: Float[Tensor, "*batch channel"],
        mask: Bool[Tensor, "*batch channel"] | None = None,
    ) -> torch.distributions.Normal:
        """enc(x_t) of single frames, as a Gaussian of no width to speak of."""
        y = self._encoded(values, mask)
        return torch.distributions.Normal(y, torch.full_like(y, torch.finfo(y.dtype).tiny))

    def _encoded(self, values: Tensor, mask: Tensor | None) -> Tensor:
        seen = values if mask is None else torch.where(mask, values, 0.0)
        y: Tensor = self.encoder(self.corrupt(seen))
        return y
