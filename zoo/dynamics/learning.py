"""A population of movement primitives from demonstrations of unequal length with missing frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.dynamics.evidence import FLOOR, conjugate_weights
from zoo.dynamics.imitation import locally_weighted_regression, target_force
from zoo.dynamics.population import Population, estimate
from zoo.dynamics.rollout import Primitive, Timing, path_noise, roll_out, sight

__all__ = ["Learned", "Learning", "anchors", "learn", "period_of", "phases"]

RATIOS = (1e-2, 1e-1, 1.0, 10.0, 100.0)
SHRINKAGES = (0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.0)
FOLDS = 5
PHASES = 16
TEMPOS = (1.0, 0.8, 0.9, 1.1, 1.25)
NOISE_OF = {"path": 100.0, "force": 1e-4}

Learning = Literal["path", "force", "lwr"]


@dataclass(frozen=True)
class Learned:
    """p(θ) with the residual variance σ² of every channel, ρ, and the timings that were seen."""

    population: Population
    noise: Float[Tensor, " channel"]
    ratio: Float[Tensor, " channel"]
    shrinkage: float
    timings: tuple[Timing, ...]


@dataclass(frozen=True)
class _Sums:
    """Sufficient statistics of every demonstration in units of σ; see :class:`Sight`."""

    precision: Float[Tensor, "sequence #channel parameter parameter"]
    linear: Float[Tensor, "sequence channel parameter"]
    square: Float[Tensor, "sequence channel"]
    count: Float[Tensor, "sequence #channel"]
    log_volume: Float[Tensor, "sequence #channel"]


@dataclass(frozen=True)
class _Fit:
    """Parameters of every demonstration, how uncertain they are, and their residuals."""

    parameters: Float[Tensor, "sequence channel parameter"]
    uncertainty: Float[Tensor, "channel parameter parameter"]
    noise: Float[Tensor, " channel"]
    ratio: Float[Tensor, " channel"]


def learn(
    primitive: Primitive,
    learning: Learning,
    period: float | None,
    values: Float[Tensor, "sequence time channel"],
    mask: Bool[Tensor, "sequence time channel"],
    lengths: Int[Tensor, " sequence"],
) -> Learned:
    """Weights of every movement, noise by their evidence, and the population over movements."""
    movements = [
        (x[:n], seen[:n]) for x, seen, n in zip(values, mask, lengths.tolist(), strict=True)
    ]
    timings = _timings(primitive, movements, period)
    starts = torch.stack(
        [anchors(primitive, x, seen, t) for (x, seen), t in zip(movements, timings, strict=True)]
    )
    floor = _floor(movements, timings, primitive.kernels)
    parameters, uncertainty = _weights(primitive, learning, movements, timings, starts)
    fit = _residuals(primitive, movements, timings, parameters, uncertainty)
    whole = _sums(primitive, fit.ratio, movements, timings)
    begun = _sums(primitive, fit.ratio, [_begun(x, seen) for x, seen in movements], timings)
    shrinkage = _shrinkage(fit, whole, begun, floor)
    population = estimate(fit.parameters, fit.uncertainty, shrinkage, floor)
    if not all(bool(seen.all()) for _, seen in movements):
        population = _refined(population, whole, fit.noise, shrinkage, floor)
    return Learned(population, fit.noise, fit.ratio, shrinkage, tuple(timings))


def anchors(
    primitive: Primitive,
    x: Float[Tensor, "time channel"],
    seen: Bool[Tensor, "time channel"],
    timing: Timing,
) -> Float[Tensor, "channel 3"]:
    """y₁, ẏ₁ and g of a movement: its first seen frames and its last, or its mean if rhythmic."""
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


def period_of(movements: list[tuple[Tensor, Tensor]]) -> float:
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


def phases(period: float) -> list[Timing]:
    """Timings that a rhythmic movement may have: tempos around ``period``, all over the circle."""
    return [
        Timing(period * tempo, 2 * math.pi * i / PHASES) for tempo in TEMPOS for i in range(PHASES)
    ]


def _timings(
    primitive: Primitive, movements: list[tuple[Tensor, Tensor]], period: float | None
) -> list[Timing]:
    if primitive.kind == "discrete":
        return [Timing(len(x) - 1.0) for x, _ in movements]
    return _aligned(primitive, movements, period_of(movements) if period is None else period)


def _aligned(
    primitive: Primitive, movements: list[tuple[Tensor, Tensor]], period: float
) -> list[Timing]:
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
    primitive: Primitive, movements: list[tuple[Tensor, Tensor]], timings: list[Timing]
) -> Float[Tensor, "channel kernel"]:
    sums = _sums(primitive, _uniform(1e-2, movements), movements, timings)
    pairs = zip(movements, timings, strict=True)
    starts = torch.stack([anchors(primitive, x, seen, t) for (x, seen), t in pairs])
    precision, linear = _of_weights(sums, starts)
    total = precision.sum(0)
    size = total.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None].clamp_min(FLOOR)
    ridge = 1e-6 * size * torch.eye(total.shape[-1], dtype=total.dtype)
    weights: Tensor = torch.linalg.solve(total + ridge, linear.sum(0)[..., None])
    return weights[..., 0]


def _nearest(
    primitive: Primitive, x: Tensor, seen: Tensor, choices: list[Timing], template: Tensor
) -> Timing:
    noise = path_noise(primitive, len(x), choices[0])
    ratio = _uniform(1e-2, [(x, seen)])
    whiten = sight(roll_out(primitive, len(x), choices[0]), noise, ratio, seen).whiten
    start = anchors(primitive, x, seen, choices[0])
    costs = []
    for choice in choices:
        path = roll_out(primitive, len(x), choice) @ torch.cat([start, template], dim=1).T
        costs.append((whiten @ ((x - path) * seen).T[..., None]).square().sum())
    return choices[int(torch.stack(costs).argmin())]


def _sums(
    primitive: Primitive,
    ratio: Tensor,
    movements: list[tuple[Tensor, Tensor]],
    timings: list[Timing],
) -> _Sums:
    parts = [
        _sum(primitive, ratio, x, seen, t) for (x, seen), t in zip(movements, timings, strict=True)
    ]
    channels = max(p[0].shape[0] for p in parts)
    wide = [[a.expand(max(channels, len(a)), *a.shape[1:]) for a in p] for p in parts]
    return _Sums(*(torch.stack(column) for column in zip(*wide, strict=True)))


def _sum(
    primitive: Primitive, ratio: Tensor, x: Tensor, seen: Tensor, timing: Timing
) -> tuple[Tensor, ...]:
    design, noise = roll_out(primitive, len(x), timing), path_noise(primitive, len(x), timing)
    view = sight(design, noise, ratio, seen)
    known = (x * seen).T[..., None]
    square = (view.whiten @ known).square().sum((-1, -2))
    return view.precision, (view.project @ known)[..., 0], square, view.count, view.log_volume


def _of_weights(sums: _Sums, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Precision and linear term of w, given the anchors."""
    cross = sums.precision[..., 3:, :3] @ starts[..., None]
    return sums.precision[..., 3:, 3:], sums.linear[..., 3:] - cross[..., 0]


def _square_after(sums: _Sums, θ: Tensor) -> Tensor:
    """‖whitened x − R θ‖² of the leading parameters θ."""
    count = θ.shape[-1]
    curve = (θ * (sums.precision[..., :count, :count] @ θ[..., None])[..., 0]).sum(-1)
    return (sums.square - 2 * (θ * sums.linear[..., :count]).sum(-1) + curve).clamp_min(0)


def _uniform(ratio: float, movements: list[tuple[Tensor, Tensor]]) -> Float[Tensor, " channel"]:
    return torch.full((movements[0][0].shape[1],), ratio, dtype=torch.float64)


def _weights(
    primitive: Primitive,
    learning: Learning,
    movements: list[tuple[Tensor, Tensor]],
    timings: list[Timing],
    starts: Tensor,
) -> tuple[Tensor, Tensor]:
    """θ of every movement and its mean posterior covariance."""
    if learning == "lwr":
        weights = _local_weights(primitive, movements, timings, starts)
        size = starts.shape[2] + weights.shape[2]
        none = starts.new_zeros(starts.shape[1], size, size)
        return torch.cat([starts, weights], dim=2), none
    sums = _sums(primitive, _uniform(NOISE_OF[learning], movements), movements, timings)
    precision, linear = _of_weights(sums, starts)
    count, square = (sums.count - 3).clamp_min(0), _square_after(sums, starts)
    found = conjugate_weights(precision, linear, square, count, sums.log_volume)
    spread = found.noise[:, None, None] * found.covariance.mean(0)
    uncertainty = torch.nn.functional.pad(spread, (3, 0, 3, 0))
    return torch.cat([starts, found.mean], dim=2), uncertainty


def _residuals(
    primitive: Primitive,
    movements: list[tuple[Tensor, Tensor]],
    timings: list[Timing],
    parameters: Tensor,
    uncertainty: Tensor,
) -> _Fit:
    """σ² and ρ of every channel that make the residuals of the roll-outs most probable."""
    noises, scores = [], []
    for ratio in RATIOS:
        sums = _sums(primitive, _uniform(ratio, movements), movements, timings)
        count, square = (sums.count - 3).clamp_min(0), _square_after(sums, parameters)
        noise = (square.sum(0) / count.sum(0).clamp_min(1)).clamp_min(FLOOR)
        each = square / noise / 2 + count / 2 * noise.log() + sums.log_volume
        noises.append(noise)
        scores.append(-each.sum(0))
    winner, rows = torch.stack(scores).argmax(0), torch.arange(len(scores[0]))
    ratio_of = torch.tensor(RATIOS, dtype=parameters.dtype)[winner]
    return _Fit(parameters, uncertainty, torch.stack(noises)[winner, rows], ratio_of)


def _begun(x: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """A movement of which only the first quarter is seen."""
    early = torch.arange(len(x))[:, None] < max(2, len(x) // 4)
    return x, seen & early


def _local_weights(
    primitive: Primitive,
    movements: list[tuple[Tensor, Tensor]],
    timings: list[Timing],
    starts: Tensor,
) -> Float[Tensor, "sequence channel kernel"]:
    rows = []
    for (x, seen), timing, start in zip(movements, timings, starts, strict=True):
        _, target = target_force(x, start[:, 2], primitive.system(timing))
        usable = seen[:-1] & seen[1:] & torch.cat([seen[:1], seen[:-2]])
        kernels = primitive.kernel_values(len(x), timing, normalised=False)[:-1]
        gate = primitive.gate(len(x), timing)[:-1]
        rows.append(locally_weighted_regression(kernels, target, scale=gate, mask=usable).T)
    return torch.stack(rows)


def _floor(movements: list[tuple[Tensor, Tensor]], timings: list[Timing], kernels: int) -> Tensor:
    """Least variance of the parameters; of one movement alone the spread over its own time."""
    floor = torch.full((3 + kernels,), 1e-8, dtype=torch.float64)
    if len(movements) == 1:
        ((x, seen),) = movements
        both = seen[1:] & seen[:-1]
        size = x[seen].var(unbiased=False) if seen.any() else torch.tensor(1.0)
        step = x.diff(dim=0)[both] if both.any() else torch.zeros(1)
        floor[0] = floor[2] = size
        floor[1] = step.square().mean() * timings[0].unit ** 2
    return floor


def _shrinkage(fit: _Fit, whole: _Sums, begun: _Sums, floor: Tensor) -> float:
    """The shrinkage that best foretells movements left out; 0.5 of fewer than three movements."""
    if len(fit.parameters) < 3:
        return 0.5
    return max(SHRINKAGES, key=lambda share: _foretold(fit, whole, begun, share, floor))


def _foretold(fit: _Fit, whole: _Sums, begun: _Sums, shrinkage: float, floor: Tensor) -> float:
    """Log density of the later three quarters of movements left out, given their first."""
    count, score = len(fit.parameters), 0.0
    folds = torch.arange(count) % min(FOLDS, count)
    for fold in folds.unique():
        out = folds == fold
        population = estimate(fit.parameters[~out], fit.uncertainty, shrinkage, floor)
        for i in out.nonzero()[:, 0].tolist():
            score += float(population.log_evidence(*_likelihood(whole, fit.noise, i)))
            score -= float(population.log_evidence(*_likelihood(begun, fit.noise, i)))
    return score


def _likelihood(sums: _Sums, noise: Tensor, i: int) -> tuple[Tensor, Tensor]:
    return sums.precision[i] / noise[:, None, None], sums.linear[i] / noise[:, None]


def _refined(
    population: Population, whole: _Sums, noise: Tensor, shrinkage: float, floor: Tensor
) -> Population:
    """The population again, from parameters that it completed itself where frames were missing."""
    rows = range(len(whole.linear))
    parts = [population.condition(*_likelihood(whole, noise, i)) for i in rows]
    spread = [p.private @ p.private.mT + p.factors @ p.factors.mT for p in parts]
    means = torch.stack([p.mean for p in parts])
    return estimate(means, torch.stack(spread).mean(0), shrinkage, floor)
