"""Durations, tempos and phases of demonstrations, and their first and last states."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.movement.conjugate_regression import FLOOR
from zoo.movement.rollout import Primitive, Timing, roll_out
from zoo.movement.sufficient_statistics import Movements, of_weights, sights, squares, sums_of

__all__ = ["anchors", "expected", "period_of", "phases", "tempos", "timings_of"]

PHASES = 16
TEMPOS = (1.0, 0.8, 0.9, 1.1, 1.25)
FINE = (1.0, *(1.25 ** (k / 10) for k in range(-10, 11) if k))
TEMPO_SPREAD = 0.03
RATIO = 1e-2


def anchors(
    primitive: Primitive,
    x: Float[Tensor, "time channel"],
    seen: Bool[Tensor, "time channel"],
    timing: Timing,
) -> Float[Tensor, "channel 3"]:
    """y₁, ẏ₁ and g of a movement: its first seen frames and its last, or its mean if rhythmic."""
    if len(x) > 1 and bool(seen.all()):
        goal = x[-1] if primitive.kind == "discrete" else x.mean(0)
        return torch.stack([x[0], (x[1] - x[0]) * timing.unit, goal], dim=1)
    order = torch.arange(len(x))[:, None].expand_as(seen)
    first = order.where(seen, len(x) - 1).amin(0)
    second = order.where(seen & (order > first), len(x)).amin(0)
    last = order.where(seen, 0).amax(0)
    begin = x.gather(0, first[None])[0]
    next_ = x.gather(0, second.clamp(max=len(x) - 1)[None])[0]
    velocity = (next_ - begin) / (second - first).clamp(min=1) * timing.unit
    velocity = velocity.where(second < len(x), 0)
    middle = x.sum(0) / seen.sum(0).clamp(min=1)
    goal = x.gather(0, last[None])[0] if primitive.kind == "discrete" else middle
    return torch.stack([begin, velocity, goal], dim=1)


def period_of(movements: Movements) -> float:
    """Period in frames by the autocorrelation, summed over movements and channels.

    The highest peak after the first zero; without one the longest movement is one period.

    >>> wave = torch.sin(2 * torch.pi * torch.arange(100.0) / 25)[:, None]
    >>> period_of([(wave, torch.ones_like(wave, dtype=torch.bool))])
    25.0
    """
    longest = max(len(x) for x, _ in movements)
    correlation, weight = torch.zeros(2, 3 * longest // 4 + 1, dtype=torch.float64)
    for x, seen in movements:
        y = torch.where(seen, x - x.sum(0) / seen.sum(0).clamp(min=1), 0.0).double()
        for lag in range(min(len(x) - 1, len(correlation))):
            correlation[lag] += (y[lag:] * y[: len(y) - lag]).sum()
            weight[lag] += (seen[lag:] & seen[: len(y) - lag]).sum()
    correlation = correlation / weight.clamp(min=1)
    negative = (correlation < 0).nonzero()
    begin = int(negative[0]) if len(negative) else len(correlation)
    tail = correlation[begin:]
    if not len(tail) or tail.max() < 0.3 * correlation[0]:
        return float(longest - 1)
    return float(begin + int(tail.argmax()))


def phases(period: float, tempos: Sequence[float] = TEMPOS, count: int = PHASES) -> list[Timing]:
    """Timings that a rhythmic movement may have: tempos around ``period``, all over the circle."""
    return [
        Timing(period * tempo, 2 * math.pi * i / count) for tempo in tempos for i in range(count)
    ]


def tempos(
    periods: Float[Tensor, " movement"], count: int
) -> tuple[float, Float[Tensor, " count"]]:
    """Middle of some periods, and ``count`` equally likely tempos about it of a new movement.

    Log periods are Gaussian, about their mean; their spread is that of the movements and the 3 %
    by which a tempo changes within one.

    >>> middle, around = tempos(torch.tensor([100.0, 110.0, 121.0]), 3)
    >>> round(middle, 6), around.mul(100).round().tolist()
    (110.0, [90.0, 100.0, 112.0])
    """
    log = periods.double().log()
    between = log.var(correction=1) if len(log) > 1 else log.new_zeros(())
    spread = (between * (1 + 1 / len(log)) + TEMPO_SPREAD**2).sqrt()
    levels = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    around = (spread * torch.special.ndtri(levels)).exp()
    return float(log.mean().exp()), around


def expected(found: Sequence[Timing], count: int, directions: int = PHASES) -> list[Timing]:
    """Equally likely timings of a new rhythmic movement, after those ``found`` of others."""
    middle, around = tempos(torch.tensor([t.unit for t in found]), count)
    return phases(middle, around.tolist(), directions)


def timings_of(primitive: Primitive, movements: Movements, period: float | None) -> list[Timing]:
    """Duration of discrete movements; tempo and phase of rhythmic ones."""
    if primitive.kind == "discrete":
        return [Timing(len(x) - 1.0) for x, _ in movements]
    return _aligned(primitive, movements, period_of(movements) if period is None else period)


def _aligned(primitive: Primitive, movements: Movements, period: float) -> list[Timing]:
    """Phase of every movement at its first frame, against the longest one and then against all."""
    choices = phases(period)
    longest = max(range(len(movements)), key=lambda i: len(movements[i][0]))
    timings = [choices[0]] * len(movements)
    chosen = [longest]
    for _ in range(3):
        template = _pooled(primitive, [movements[i] for i in chosen], [timings[i] for i in chosen])
        timings = [_nearest(primitive, x, seen, choices, template) for x, seen in movements]
        chosen = list(range(len(movements)))
    return timings


def _pooled(
    primitive: Primitive, movements: Movements, timings: list[Timing]
) -> Float[Tensor, "channel kernel"]:
    ratio = movements[0][0].new_full(movements[0][0].shape[1:], RATIO)
    sums, _ = sums_of(primitive, ratio, movements, timings)
    pairs = zip(movements, timings, strict=True)
    starts = torch.stack([anchors(primitive, x, seen, t) for (x, seen), t in pairs])
    precision, linear = of_weights(sums, starts)
    total = precision.sum(0) * (len(linear) / len(precision))
    size = total.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None].clamp_min(FLOOR)
    ridge = 1e-6 * size * torch.eye(total.shape[-1], dtype=total.dtype)
    weights: Tensor = torch.linalg.solve(total + ridge, linear.sum(0)[..., None])
    return weights[..., 0]


def _nearest(
    primitive: Primitive, x: Tensor, seen: Tensor, choices: list[Timing], template: Tensor
) -> Timing:
    start = anchors(primitive, x, seen, choices[0])
    θ = torch.cat([start, template], dim=1)
    paths = torch.stack([roll_out(primitive, len(x), choice) @ θ.T for choice in choices])
    (view,) = sights(primitive, choices[:1], x.new_full(x.shape[1:], RATIO), seen)
    errors = view.errors((x - paths) * seen)
    return choices[int(squares(errors, len(choices)).sum(-1).argmin())]
