"""The training mean of every frame, or of every target: `mean`, `mean-regressor`."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.baselines.observation import moments, observe
from zoo.movement.demonstrations import movements_of, seen_entries
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "Mean", "MeanRegressor"]


@settings
class Config:
    """Settings of both models: ``noise_floor`` is the least standard deviation, in scaled units."""

    noise_floor: Positive = 1e-4


class _Moments(nn.Module):
    """Mean, standard deviation and standard error of the mean."""

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    mean: Tensor
    deviation: Tensor
    error: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until ``condition``."""
        super().__init__()
        self.layout, self.config = layout, config
        for name in ("mean", "deviation", "error"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    def _keep(self, mean: Tensor, deviation: Tensor, count: Tensor) -> None:
        self.mean, self.deviation = mean, deviation.clamp(min=self.config.noise_floor)
        self.error = self.deviation / count.sqrt()


class Mean(_Moments):
    """Every frame is the mean of that frame over the training movements, whatever was observed.

    x_{t,c} ~ N(m_{t,c}, s_{t,c}²), m_{t,c} known to s_{t,c}/√n

    The reference of R², and what every model has to beat: m and s are the mean and the standard
    deviation of the n training movements that have frame t; a frame that fewer than two have, or
    beyond the longest, gets those of all frames of its channel. It answers every question by the
    same movement, so that it shows what mere knowledge of the task is worth. Frames and channels
    are independent given m, and nothing that was observed changes the answer. It is a baseline, not
    in the thesis, and it has no guide: there is no latent variable.

    Defaults: data standardised; missing entries left out.
    """

    def condition(self, data: Sequences | Pairs) -> None:
        """Moments of every frame; the last row holds those of all frames."""
        movements = movements_of("mean", data, self.dtype)
        values, mask = movements.values, movements.mask
        frame = moments(values, mask, 0)
        overall = moments(values.flatten(0, 1), mask.flatten(0, 1), 0)
        few = frame[2] < 2
        rows = (
            torch.cat([torch.where(few, o, f), o[None]])
            for f, o in zip(frame, overall, strict=True)
        )
        self._keep(*rows)

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every frame on its own."""
        rows = self._rows(batch.start, batch.values.shape[1])
        return observe(batch, dist.Normal(self.mean[rows], self.deviation[rows]))

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The training mean of the frames to come."""
        return self._predictive(batch.start + batch.values.shape[1], horizon, draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The training mean of every frame, seen or not."""
        return self._predictive(batch.start, batch.values.shape[1], draws)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The training mean of every frame, which is the reference of R²."""
        return self._predictive(batch.start, batch.values.shape[1], draws)

    def _rows(self, start: Int[Tensor, " window"], frames: int) -> Int[Tensor, "window time"]:
        check_fitted("mean", self.mean)
        time = start[:, None] + torch.arange(frames, device=start.device)
        return time.clamp(max=len(self.mean) - 1)

    def _predictive(self, start: Tensor, frames: int, draws: int) -> Predictive:
        rows = self._rows(start, frames)
        unit = torch.randn(draws, *self.mean.shape, dtype=self.mean.dtype, device=self.mean.device)
        return Predictive(
            location=self.mean[rows][None],
            noise=self.deviation[rows],
            epistemic=self.error[rows],
            joint=True,
            draws=(self.mean + self.error * unit)[:, rows],
        )


class MeanRegressor(_Moments):
    """Every target is its training mean, whatever the inputs.

    y_p ~ N(m_p, s_p²), m_p known to s_p/√n

    The reference of R² in regression (it is what R² compares with, and what a Gaussian
    process falls back to far from its data): m and s are the mean and the standard deviation of
    the n training items that have target p. Targets are independent; inputs are not looked at. It
    is a baseline, not in the thesis, and it has no guide: there is no latent variable.

    Defaults: data standardised; missing targets left out.
    """

    def condition(self, data: Sequences | Pairs) -> None:
        """Moments of every target."""
        if not isinstance(data, Pairs):
            raise TypeError(f"mean-regressor needs Pairs; got {type(data).__name__}")
        never = ~data.mask.any(0)
        if never.any():
            target = data.channels[int(never.nonzero()[0])]
            raise ValueError(f"target {target} is missing in every item; drop it")
        values = torch.where(data.mask, data.targets, 0.0).to(self.dtype)
        self._keep(*moments(values, data.mask, 0))

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every item on its own."""
        check_fitted("mean-regressor", self.mean)
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            likelihood = dist.Normal(self.mean, self.deviation).expand(batch.values.shape)
            site = likelihood.mask(seen_entries(batch)).to_event(1)
            y: Tensor = pyro.sample("y", site, obs=batch.given(batch.values))
        return y

    def regress(self, inputs: Float[Tensor, "item feature"], *, draws: int) -> Predictive:
        """The training mean for every item."""
        check_fitted("mean-regressor", self.mean)
        shape = (1, len(inputs), len(self.mean))
        return Predictive(
            location=self.mean.expand(shape), noise=self.deviation, epistemic=self.error
        )
