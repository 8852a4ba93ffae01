"""The last value seen is held: `last-value`."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.baselines.observation import moments, normal, observe_in_turn
from zoo.movement.demonstrations import movements_of, seen_entries
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "LastValue"]


@settings
class Config:
    """Settings of :class:`LastValue`.

    ``noise_floor`` is the least standard deviation, in scaled units.
    """

    noise_floor: Positive = 1e-4


class LastValue(nn.Module):
    """A walk that stays where it is: every channel keeps its last value, ever less surely.

    x_{k+h} | x_k ~ N(x_k, s_h²)

    The standard deviation s_h of every channel is the root mean square of x_{t+h} − x_t over all
    training frames, fitted for each lead time h on its own; leads longer than the training
    movements grow with √h as a random walk does. Joint draws have stationary increments: covariance
    (s_h² + s_h'² − s_{|h−h'|}²)/2, projected to the nearest positive one with the same s_h. There
    is no observation noise: all uncertainty is of the path. A channel counts its lead from the
    frame that it was last seen in; one that was not seen at all gets its training mean and
    deviation. It knows no velocity and no posture: it says what standing still is worth. It is a
    baseline, not in the thesis, and it has no guide: there is no latent variable.

    Defaults: data standardised; missing entries left out.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    mean: Tensor
    deviation: Tensor
    spread: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        for name in ("mean", "deviation", "spread"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    def condition(self, data: Sequences | Pairs) -> None:
        """Fit s_h for every lead time of the training movements."""
        movements = movements_of("last-value", data, self.dtype)
        values, mask, frames = movements.values, movements.mask, int(movements.lengths.max())
        if frames < 2:
            raise ValueError("last-value needs movements of at least 2 frames; the longest has 1")
        floor = self.config.noise_floor
        steps = [_increment(values, mask, lead) for lead in range(1, frames)]
        mean, deviation, _ = moments(values.flatten(0, 1), mask.flatten(0, 1), 0)
        self.mean, self.deviation = mean, deviation.clamp(min=floor)
        self.spread = _extended(torch.stack(steps)).clamp(min=floor)

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every entry around the last one seen before it."""
        check_fitted("last-value", self.spread)
        return observe_in_turn(batch, self._step)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The last values, with the standard deviations of their leads."""
        check_fitted("last-value", self.spread)
        frames = batch.values.shape[1]
        last = _last_seen(seen_entries(batch))[:, -1:].expand(-1, horizon, -1)
        time = torch.arange(frames, frames + horizon, device=last.device)[:, None]
        location, spread = self._held(batch.values, last, time - last)
        step = (time - last - 1).expand(draws, -1, -1, -1)
        walk = self._walks(int(step.max()) + 1, (draws, len(batch))).gather(2, step)
        constant = self.deviation * torch.randn_like(walk[:, :, :1])
        path = location + torch.where(last < 0, constant, walk)
        return Predictive(location=location[None], epistemic=spread, draws=path)

    def _step(self, values: Tensor, seen: Tensor, frames: range) -> TorchDistribution:
        """``frames`` given what was observed before them."""
        time = torch.arange(values.shape[1], device=seen.device)[:, None]
        before = _last_seen(seen).roll(1, dims=1)
        before[:, 0] = -1
        held = self._held(values, before[:, frames], (time - before)[:, frames])
        return normal(*held, seen[:, frames])

    def _held(
        self, values: Tensor, last: Int[Tensor, "window time channel"], lead: Tensor
    ) -> tuple[Float[Tensor, "window time channel"], Float[Tensor, "window time channel"]]:
        """Moments of entries ``lead`` frames after frame ``last`` (-1: never observed)."""
        spread = self._spread(lead)
        held = values.gather(1, last.clamp(min=0))
        never = last < 0
        return torch.where(never, self.mean, held), torch.where(never, self.deviation, spread)

    def _spread(self, lead: Tensor) -> Tensor:
        longest = len(self.spread)
        row = lead.clamp(max=longest) - 1
        fitted = self.spread.gather(0, row.flatten(0, -2)).view(row.shape)
        return fitted * (lead.clamp(min=longest).to(fitted) / longest).sqrt()

    def _walks(
        self, leads: int, shape: tuple[int, int]
    ) -> Float[Tensor, "sample window lead channel"]:
        """Joint draws of x_{k+h} − x_k for h = 1 … ``leads``."""
        lead = torch.arange(1, leads + 1, device=self.spread.device)
        between = (lead[:, None] - lead).abs().clamp(min=1)
        channels = self.spread.shape[1]
        variogram = self._spread(between[..., None].expand(-1, -1, channels)).square()
        variogram = variogram * (lead[:, None] != lead)[..., None]
        marginal = self._spread(lead[:, None].expand(-1, channels))
        variance = marginal.square()
        covariance = (variance[:, None] + variance - variogram).permute(2, 0, 1) / 2
        value, vector = torch.linalg.eigh(covariance)
        root = vector * value.clamp(min=0).sqrt()[:, None]
        root = root * (marginal.T / root.norm(dim=-1))[..., None]
        unit = torch.randn(*shape, channels, leads, dtype=root.dtype, device=root.device)
        return torch.einsum("chi,snci->snhc", root, unit)


def _increment(values: Tensor, mask: Tensor, lead: int) -> Float[Tensor, " channel"]:
    """Root mean square of x_{t+lead} − x_t; NaN where no pair of frames was observed."""
    both = mask[:, lead:] & mask[:, :-lead]
    step = (values[:, lead:] - values[:, :-lead]) * both
    return (step.square().sum((0, 1)) / both.sum((0, 1))).sqrt()


def _extended(spread: Float[Tensor, "lead channel"]) -> Float[Tensor, "lead channel"]:
    """Leads without a pair grow with √h from the last lead that has one."""
    lead = torch.arange(1, len(spread) + 1, dtype=spread.dtype, device=spread.device)[:, None]
    known = (~spread.isnan() * lead).cummax(0).values
    from_known = spread.nan_to_num().gather(0, (known.long() - 1).clamp(min=0))
    return from_known * (lead / known.clamp(min=1)).sqrt()


def _last_seen(seen: Bool[Tensor, "window time channel"]) -> Int[Tensor, "window time channel"]:
    """Frame in which each channel was last seen, up to and with every frame; -1 for never."""
    time = torch.arange(seen.shape[1], device=seen.device)[:, None]
    return torch.where(seen, time, -1).cummax(1).values
