"""A population of movement primitives from demonstrations of unequal length with missing frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.dynamics.evidence import FLOOR, conjugate_weights
from zoo.dynamics.imitation import locally_weighted_regression, target_force
from zoo.dynamics.population import Population, estimate
from zoo.dynamics.rollout import Primitive, Timing
from zoo.dynamics.sums import Movements, Sums, of_weights, square_after, sums_of, uniform
from zoo.dynamics.timing import anchors, timings_of

__all__ = ["Learned", "Learning", "learn"]

RATIOS = (1e-2, 1e-1, 1.0, 10.0, 100.0)
SHRINKAGES = (0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.0)
FOLDS = 5
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
    timings = timings_of(primitive, movements, period)
    starts = torch.stack(
        [anchors(primitive, x, seen, t) for (x, seen), t in zip(movements, timings, strict=True)]
    )
    floor = _floor(movements, timings, primitive.kernels)
    parameters, uncertainty = _weights(primitive, learning, movements, timings, starts)
    fit = _residuals(primitive, movements, timings, parameters, uncertainty)
    whole = sums_of(primitive, fit.ratio, movements, timings)
    begun = sums_of(primitive, fit.ratio, [_begun(x, seen) for x, seen in movements], timings)
    shrinkage = _shrinkage(fit, whole, begun, floor)
    population = estimate(fit.parameters, fit.uncertainty, shrinkage, floor)
    if not all(bool(seen.all()) for _, seen in movements):
        population = _refined(population, whole, fit.noise, shrinkage, floor)
    return Learned(population, fit.noise, fit.ratio, shrinkage, tuple(timings))


def _weights(
    primitive: Primitive,
    learning: Learning,
    movements: Movements,
    timings: list[Timing],
    starts: Tensor,
) -> tuple[Tensor, Tensor]:
    """θ of every movement and its mean posterior covariance."""
    if learning == "lwr":
        weights = _local_weights(primitive, movements, timings, starts)
        size = starts.shape[2] + weights.shape[2]
        none = starts.new_zeros(starts.shape[1], size, size)
        return torch.cat([starts, weights], dim=2), none
    sums = sums_of(primitive, uniform(NOISE_OF[learning], movements), movements, timings)
    precision, linear = of_weights(sums, starts)
    count, square = (sums.count - 3).clamp_min(0), square_after(sums, starts)
    found = conjugate_weights(precision, linear, square, count, sums.log_volume)
    spread = found.noise[:, None, None] * found.covariance.mean(0)
    uncertainty = torch.nn.functional.pad(spread, (3, 0, 3, 0))
    return torch.cat([starts, found.mean], dim=2), uncertainty


def _residuals(
    primitive: Primitive,
    movements: Movements,
    timings: list[Timing],
    parameters: Tensor,
    uncertainty: Tensor,
) -> _Fit:
    """σ² and ρ of every channel that make the residuals of the roll-outs most probable."""
    noises, scores = [], []
    for ratio in RATIOS:
        sums = sums_of(primitive, uniform(ratio, movements), movements, timings)
        count, square = (sums.count - 3).clamp_min(0), square_after(sums, parameters)
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
    movements: Movements,
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


def _floor(movements: Movements, timings: list[Timing], kernels: int) -> Tensor:
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


def _shrinkage(fit: _Fit, whole: Sums, begun: Sums, floor: Tensor) -> float:
    """The shrinkage that best foretells movements left out; 0.5 of fewer than three movements."""
    if len(fit.parameters) < 3:
        return 0.5
    return max(SHRINKAGES, key=lambda share: _foretold(fit, whole, begun, share, floor))


def _foretold(fit: _Fit, whole: Sums, begun: Sums, shrinkage: float, floor: Tensor) -> float:
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


def _likelihood(sums: Sums, noise: Tensor, i: int) -> tuple[Tensor, Tensor]:
    return sums.precision[i] / noise[:, None, None], sums.linear[i] / noise[:, None]


def _refined(
    population: Population, whole: Sums, noise: Tensor, shrinkage: float, floor: Tensor
) -> Population:
    """The population again, from parameters that it completed itself where frames were missing."""
    rows = range(len(whole.linear))
    parts = [population.condition(*_likelihood(whole, noise, i)) for i in rows]
    spread = [p.private @ p.private.mT + p.factors @ p.factors.mT for p in parts]
    means = torch.stack([p.mean for p in parts])
    return estimate(means, torch.stack(spread).mean(0), shrinkage, floor)
