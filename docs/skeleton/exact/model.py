"""Skeleton of a generative model for ``zoo.Exact``: ``condition`` is the whole training."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

import zoo
from zoo.contract.settings import Positive, settings

__all__ = ["Config", "Posture"]


@settings
class Config:
    """Settings of the model: ``floor`` is the least standard deviation, in scaled units."""

    floor: Positive = 1e-3


class Posture(nn.Module):
    """A posture z for every movement, about which its frames scatter.

        z ~ N(μ, diag s²),  x_t ~ N(z, diag σ²)

    Given μ, s and σ, which are moments of the training movements, p(z | x) is known, and with it
    the forecast and the missing entries. The uncertainty of μ, s and σ is not in the bands.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    mean: Tensor
    spread: Tensor
    noise: Tensor

    def __init__(self, layout: zoo.Layout, config: Config) -> None:
        """Buffers are saved with the run; their sizes may come with the data."""
        super().__init__()
        self.layout, self.config = layout, config
        for name in ("mean", "spread", "noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    def condition(self, data: zoo.Sequences) -> None:
        """Moments between and within movements; what is missing is 0 in ``mask``."""
        count = data.mask.sum(1)
        level = (data.values * data.mask).sum(1) / count.clamp_min(1)
        within = (data.mask * (data.values - level[:, None])).square().sum((0, 1))
        seen = count > 0
        if not bool((seen.sum(0) > 1).all()):
            raise ValueError("posture needs two movements with every channel; some are missing")
        noise = within / (count - 1).clamp_min(0).sum(0).clamp_min(1)
        movements = seen.sum(0)
        self.mean = (level * seen).sum(0) / movements
        between = ((level - self.mean) * seen).square().sum(0) / (movements - 1)
        share = (seen / count.clamp_min(1)).sum(0) / movements
        self.spread = (between - noise * share).clamp_min(self.config.floor**2).sqrt()
        self.noise = noise.sqrt().clamp_min(self.config.floor)

    def forward(self, batch: zoo.Batch) -> Tensor:
        """p(x, z): the Pyro program, which draws x where ``batch`` is not observed."""
        mask = True if batch.mask is None else batch.mask
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            prior = dist.Normal(self.mean, self.spread).expand([len(batch), len(self.mean)])
            z = pyro.sample("z", prior.to_event(1))
            frames = z[..., None, :].expand(*z.shape[:-1], *batch.values.shape[1:])
            law = dist.Normal(frames, self.noise).mask(mask)
            x: Tensor = pyro.sample("x", law.to_event(2), obs=batch.given(batch.values))
        return x

    def posterior_sites(self, batch: zoo.Batch) -> zoo.Sites:
        """What the exact guide draws from: p(z | x)."""
        z = dist.Normal(*self._posterior(batch)).to_event(1)
        return zoo.Sites(plate="windows", size=batch.total, rows=len(batch), of={"z": lambda _: z})

    def forecast(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, horizon: int, draws: int
    ) -> zoo.Predictive:
        """The frames to come scatter about the posture of those seen."""
        return self._frames(batch, horizon, draws)

    def impute(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, draws: int
    ) -> zoo.Predictive:
        """So do those that are missing."""
        return self._frames(batch, batch.values.shape[1], draws)

    def _frames(self, batch: zoo.Batch, frames: int, draws: int) -> zoo.Predictive:
        mean, std = self._posterior(batch)
        noise = torch.randn(draws, *mean.shape, dtype=mean.dtype)
        moments = {"location": mean[None], "epistemic": std[None], "draws": mean + std * noise}
        every = {k: v[:, :, None].expand(-1, -1, frames, -1) for k, v in moments.items()}
        return zoo.Predictive(noise=self.noise, **every)

    def _posterior(self, batch: zoo.Batch) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of z given the entries seen."""
        mask = torch.ones_like(batch.values) if batch.mask is None else batch.mask
        prior, weight = self.spread.square().reciprocal(), self.noise.square().reciprocal()
        precision = prior + weight * mask.sum(1)
        mean = (prior * self.mean + weight * (mask * batch.values).sum(1)) / precision
        return mean, precision.rsqrt()
