"""The most similar training movements are continued: `nearest-neighbour`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn.functional import pad

from zoo.datasets.records import Pairs, Sequences
from zoo.dynamics.analogues import (
    alignment_cost,
    carried,
    error_sums,
    interpolated,
    mean_square,
)
from zoo.models.baseline import (
    check_fitted,
    moments,
    movements_of,
    normal,
    observe_in_turn,
    seen_entries,
)
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "NearestNeighbour"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`NearestNeighbour`.

    ``neighbours`` movements are kept; forecasts compare the last ``context`` frames seen;
    imputation weighs frames by exp(−distance/``decay``), in frames. With ``align`` each neighbour
    is shifted to meet what was seen: the last frame, or the frames around a gap. ``leave_out`` is
    the group column whose members are never neighbours of each other when the spread is fitted
    (None: single movements), at ``positions`` places of every movement. ``noise_floor`` is in
    scaled units.
    """

    neighbours: int = 5
    context: int = 5
    align: bool = True
    decay: float = 5.0
    leave_out: str | None = None
    positions: int = 8
    noise_floor: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse settings without a meaning."""
        for name in ("neighbours", "context", "positions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}")
        for name in ("decay", "noise_floor"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive; got {getattr(self, name)}")


class NearestNeighbour(nn.Module):
    """What came next in the training movements that looked most alike is what comes next.

    x_{k+h} ~ 1/K Σ_{i=1}^K N(y_i(t_i + h) + x_k − y_i(t_i), s_h²)

    y_i(t_i) is the place of training movement i, over all its places, whose last frames are
    nearest to the last frames seen (mean squared distance over the entries seen in both); the K
    nearest movements are kept. Places with enough frames to come are preferred; a neighbour that
    ends too early holds its last frame. The spread is that of the neighbours, and s_h, which
    makes the mixture's variance that of the errors of the same forecasts of training movements
    that were left out (and is at least half of their root mean square). Imputation compares
    frame by frame, near frames counting most, and takes the missing entries from the nearest
    places, shifted by what they lie below the frames seen; its s is fitted on left-out movements
    with the same entries hidden. Fix & Hodges (1951); Lorenz, *Atmospheric predictability as
    revealed by naturally occurring analogues*, J. Atmos. Sci. 26 (1969).

    Missing entries of the training movements are interpolated in time where a neighbour is
    continued; distances and errors leave them out. Noise is independent from frame to frame.
    The generative program scores a movement one step at a time by the mixture's moments.

    Defaults: 5 neighbours, 5 frames of context, aligned; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    memory: Tensor
    seen: Tensor
    lengths: Tensor
    group: Tensor
    noise: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        for name in ("memory", "noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        for name in ("lengths", "group"):
            self.register_buffer(name, torch.empty(0, dtype=torch.long))
        self.register_buffer("seen", torch.empty(0, dtype=torch.bool))

    def condition(self, data: Sequences | Pairs) -> None:
        """Keep the movements and fit s_h on those left out."""
        movements = movements_of("nearest-neighbour", data, self.dtype)
        if int(movements.lengths.max()) <= self.config.context:
            raise ValueError(
                f"nearest-neighbour needs movements longer than its context of "
                f"{self.config.context} frames; the longest has {int(movements.lengths.max())}"
            )
        self.seen, self.lengths = movements.mask, movements.lengths
        self.group = self._groups(movements)
        mean, _, _ = moments(movements.values.flatten(0, 1), self.seen.flatten(0, 1), 0)
        self.memory = interpolated(movements.values, self.seen, mean)
        self.noise = self._forecast_noise()

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every frame after the first from the frames before it."""
        check_fitted("nearest-neighbour", self.noise)
        return observe_in_turn(batch, self._step)

    def _step(self, x: Tensor, seen: Tensor, frames: range) -> TorchDistribution:
        """``frames`` given the frames before them."""
        mean, deviation, _ = moments(self.memory.flatten(0, 1), self.seen.flatten(0, 1), 0)
        first = mean.expand_as(x[:, 0]), deviation.square().expand_as(x[:, 0])
        steps = [first if t == 0 else self._next(x[:, :t], seen[:, :t]) for t in frames]
        location, variance = (torch.stack(each, 1) for each in zip(*steps, strict=True))
        deviation = variance.sqrt().clamp(min=self.config.noise_floor)
        return normal(location, deviation, seen[:, frames])

    def _next(self, x: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        step = self._continued(x, seen, self._ahead(x, 1), self._nobody(len(x)))[:, :, 0]
        return step.mean(0), step.var(0, unbiased=False) + self.noise[0].square()

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The continuations of the nearest places, one component each."""
        check_fitted("nearest-neighbour", self.noise)
        seen, nobody = seen_entries(batch), self._nobody(len(batch))
        location = self._continued(batch.values, seen, self._ahead(seen, horizon), nobody)
        lead = torch.arange(horizon, device=location.device).clamp(max=len(self.noise) - 1)
        return Predictive(location=location, noise=self.noise[lead], joint=True)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The frames of the nearest places, one component each."""
        check_fitted("nearest-neighbour", self.noise)
        mask, nobody = seen_entries(batch), self._nobody(1)[0]
        pairs = zip(batch.values, mask, strict=True)
        location = torch.stack([self._filled(x, m, nobody) for x, m in pairs], 1)
        patterns, which = torch.unique(mask, dim=0, return_inverse=True)
        count = max(2, 20 // len(patterns))
        noise = torch.stack([self._imputation_noise(p, count) for p in patterns])
        return Predictive(location=location, noise=noise[which][:, None], joint=True)

    def _groups(self, data: Sequences) -> Int[Tensor, " movement"]:
        column = self.config.leave_out
        if column is not None and column not in data.groups:
            raise ValueError(f"no group column {column!r}; there are {', '.join(data.groups)}")
        labels = list(range(len(data))) if column is None else list(data.groups[column])
        order = list(dict.fromkeys(labels))
        if len(order) < 2:
            raise ValueError(
                "nearest-neighbour needs at least 2 "
                f"{'movements' if column is None else column + ' groups'} to fit its spread; got 1"
            )
        numbers = [order.index(label) for label in labels]
        return torch.tensor(numbers, device=data.lengths.device)

    def _nobody(self, queries: int) -> Bool[Tensor, "query movement"]:
        return torch.zeros(queries, len(self.memory), dtype=torch.bool, device=self.memory.device)

    def _ahead(self, queries: Tensor, horizon: int) -> Int[Tensor, " query"]:
        return torch.full((len(queries),), horizon, device=queries.device)

    def _spread_out(self, first: int, last: int, count: int) -> Int[Tensor, " place"]:
        even = torch.linspace(first, last, count, device=self.memory.device)
        places: Tensor = even.long().unique()
        return places

    def _continued(
        self,
        values: Float[Tensor, "query frame channel"],
        mask: Bool[Tensor, "query frame channel"],
        ahead: Int[Tensor, " query"],
        banned: Bool[Tensor, "query movement"],
    ) -> Float[Tensor, "neighbour query time channel"]:
        """The frames after the best place of each of the nearest movements, the longest ``ahead``.

        Every query prefers places with the frames that it asks for.
        """
        context = min(self.config.context, values.shape[1])
        x, m = values[:, -context:], mask[:, -context:]
        movement, end = self._nearest(x, m, ahead, banned)
        frame = end[..., None] + torch.arange(1, int(ahead.max()) + 1, device=end.device)
        frame = torch.minimum(frame, self.lengths[movement][..., None] - 1)
        future = self.memory[movement[..., None], frame]
        if self.config.align:
            shift = (x[:, -1] - self.memory[movement, end]) * m[:, -1]
            future = future + shift[:, :, None]
        return future

    def _nearest(
        self, x: Tensor, m: Tensor, ahead: Tensor, banned: Tensor
    ) -> tuple[Int[Tensor, "neighbour query"], Int[Tensor, "neighbour query"]]:
        """Movements, and in each the frame that matches the last frame of ``x``."""
        context = x.shape[1]
        distance = self._distances(x, m)
        end = torch.arange(context - 1, self.memory.shape[1], device=x.device)
        left = (self.lengths[:, None] - 1 - end).expand(len(x), -1, -1)
        left = left.masked_fill(banned[..., None], -1)
        neighbours = min(self.config.neighbours, int((left[..., 0] >= 0).sum(1).min()))
        if neighbours < 1:
            raise ValueError(
                f"no training movement of {context} frames is left to compare with; "
                f"the longest has {int(self.lengths.max())}"
            )
        enough = torch.minimum(left[..., 0].topk(neighbours, dim=1).values[:, -1], ahead)
        distance = distance.masked_fill(left < enough[:, None, None], torch.inf)
        best = distance.min(-1)
        movement = best.values.topk(neighbours, dim=1, largest=False).indices
        return movement.T, best.indices.gather(1, movement).T + context - 1

    def _distances(self, x: Tensor, m: Tensor) -> Float[Tensor, "query movement place"]:
        """Mean squared difference to every run of training frames, over entries seen in both."""
        y = (self.memory * self.seen).unfold(1, x.shape[1], 1).mT.flatten(-2)
        n = self.seen.to(y).unfold(1, x.shape[1], 1).mT.flatten(-2)
        x, m = (x * m).flatten(1), m.to(y).flatten(1)
        rows = mean_square(x, m, y.flatten(0, 1), n.flatten(0, 1))
        places: Tensor = rows.unflatten(1, y.shape[:2])
        return places

    def _forecast_noise(self) -> Float[Tensor, "lead channel"]:
        """s_h from forecasts of left-out movements, at evenly spaced places."""
        context, frames = self.config.context, self.memory.shape[1]
        error = self.memory.new_zeros(3, frames - context, self.memory.shape[2])
        for i in torch.nonzero(self.lengths > context).flatten().tolist():
            error += self._left_out(i)
        count = error[2]
        wrong, spread = error[:2] / count.clamp(min=1)
        return carried(self._unexplained(wrong, spread), count > 0)

    def _left_out(self, i: int) -> Float[Tensor, "3 lead channel"]:
        """Sums of squared error, of the neighbours' variance, and their count, by lead."""
        context, length = self.config.context, int(self.lengths[i])
        place = self._spread_out(context, length - 1, self.config.positions)
        back = place[:, None] + torch.arange(-context, 0, device=place.device)
        lead = place[:, None] + torch.arange(length - context, device=place.device)
        inside = lead.clamp(max=length - 1)
        banned = (self.group == self.group[i]).expand(len(place), -1)
        near = self._continued(self.memory[i, back], self.seen[i, back], length - place, banned)
        known = self.seen[i, inside] & (lead < length)[..., None]
        sums = error_sums(self.memory[i, inside] - near.mean(0), near, known)
        return pad(sums, (0, 0, 0, self.memory.shape[1] - length))

    def _filled(
        self,
        x: Float[Tensor, "time channel"],
        m: Bool[Tensor, "time channel"],
        banned: Bool[Tensor, " movement"],
    ) -> Float[Tensor, "neighbour time channel"]:
        """For every frame the frames that stand where the movement around it fits best."""
        weight = self._weight(len(x))
        cost = alignment_cost(x, m, self.memory, self.seen, self.lengths, weight)
        cost = cost.masked_fill(banned[:, None], torch.inf)
        best = cost.min(-1)
        neighbours = min(self.config.neighbours, int((~banned).sum()))
        movement = best.values.topk(neighbours, dim=1, largest=False).indices
        time = torch.arange(len(x), device=x.device)[:, None]
        lag = best.indices.gather(1, movement) - (len(x) - 1)
        frames = self.memory[movement, lag + time]
        if self.config.align:
            frames = frames + self._shift(x, m, movement, lag)
        return frames.transpose(0, 1)

    def _shift(self, x: Tensor, m: Tensor, movement: Tensor, lag: Tensor) -> Tensor:
        """What each place lies below the movement in the frames seen around it."""
        partner = lag[..., None] + torch.arange(len(x), device=x.device)
        ends = self.lengths[movement][..., None]
        inside = ((partner >= 0) & (partner < ends))[..., None] & m
        near = self.memory[movement[..., None], torch.minimum(partner.clamp(min=0), ends - 1)]
        weight = self._weight(len(x))[:, None, :, None] * inside
        below = (weight * (x - near)).sum(2)
        return below / weight.sum(2).clamp(min=torch.finfo(x.dtype).tiny)

    def _weight(self, frames: int) -> Float[Tensor, "time time"]:
        time = torch.arange(frames, device=self.memory.device)
        return torch.exp(-(time[:, None] - time).abs() / self.config.decay).to(self.memory)

    def _imputation_noise(
        self, pattern: Bool[Tensor, "time channel"], movements: int
    ) -> Float[Tensor, " channel"]:
        """s of every channel where left-out movements miss the entries that ``pattern`` misses."""
        rows = self._spread_out(0, len(self.memory) - 1, min(movements, len(self.memory)))
        sums = [self._left_out_filled(i, pattern) for i in rows.tolist()]
        wrong, spread, count = torch.stack(sums).sum(0)
        return self._unexplained(wrong / count.clamp(min=1), spread / count.clamp(min=1))

    def _left_out_filled(self, i: int, pattern: Tensor) -> Float[Tensor, "3 channel"]:
        frames = min(len(pattern), int(self.lengths[i]))
        x, seen, pattern = self.memory[i, :frames], self.seen[i, :frames], pattern[:frames]
        near = self._filled(x, seen & pattern, self.group == self.group[i])
        asked = seen & (~pattern | pattern.all(0))
        return error_sums(x - near.mean(0), near, asked)

    def _unexplained(self, error: Tensor, spread: Tensor) -> Tensor:
        """s from the mean squared error and the neighbours' variance, at least half the error."""
        variance = torch.maximum(error - spread, error / 4)
        return variance.clamp(min=self.config.noise_floor**2).sqrt()
