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
from zoo.dynamics.sums import Movements, Sums, of_weights, square_after, sums_of
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
    ratios = _ratios(learning)
    shape = (-1, values.shape[2])
    every, begun = sums_of(primitive, ratios[:, None].expand(shape), movements, timings)
    if learning == "lwr":
        parameters, uncertainty = _local_weights(primitive, movements, timings, starts)
    else:
        own = int((ratios == NOISE_OF[learning]).nonzero())
        parameters, uncertainty = _weights(every.at(own), starts)
    fit, winner = _residuals(every, ratios, parameters, uncertainty)
    whole, early = every.of_channels(winner), begun.of_channels(winner)
    shrinkage = _shrinkage(fit, whole, early, floor)
    population = estimate(fit.parameters, fit.uncertainty, shrinkage, floor)
    if not all(bool(seen.all()) for _, seen in movements):
        population = _refined(population, whole, fit.noise, shrinkage, floor)
    return Learned(population, fit.noise, fit.ratio, shrinkage, tuple(timings))


def _ratios(learning: Learning) -> Float[Tensor, " ratio"]:
    """Those of the residuals, and that under which the weights are learned."""
    own = [NOISE_OF[learning]] if learning in NOISE_OF else []
    return torch.tensor([*RATIOS, *(r for r in own if r not in RATIOS)], dtype=torch.float64)


def _weights(sums: Sums, starts: Tensor) -> tuple[Tensor, Tensor]:
    """θ of every movement and its mean posterior covariance."""
    precision, linear = of_weights(sums, starts)
    count, square = (sums.count - 3).clamp_min(0), square_after(sums, starts)
    found = conjugate_weights(precision, linear, square, count, sums.log_volume)
    spread = found.noise[:, None, None] * found.covariance.mean(0)
    uncertainty = torch.nn.functional.pad(spread, (3, 0, 3, 0))
    return torch.cat([starts, found.mean], dim=2), uncertainty


def _residuals(
    every: Sums, ratios: Tensor, parameters: Tensor, uncertainty: Tensor
) -> tuple[_Fit, Int[Tensor, " channel"]]:
    """σ² and ρ of every channel that make the residuals of the roll-outs most probable."""
    noises, scores = [], []
    for i in range(len(RATIOS)):
        sums = every.at(i)
        count, square = (sums.count - 3).clamp_min(0), square_after(sums, parameters)
        noise = (square.sum(0) / count.sum(0).clamp_min(1)).clamp_min(FLOOR)
        each = square / noise / 2 + count / 2 * noise.log() + sums.log_volume
        noises.append(noise)
        scores.append(-each.sum(0))
    winner, rows = torch.stack(scores).argmax(0), torch.arange(len(scores[0]))
    noise = torch.stack(noises)[winner, rows]
    return _Fit(parameters, uncertainty, noise, ratios[winner]), winner


def _local_weights(
    primitive: Primitive, movements: Movements, timings: list[Timing], starts: Tensor
) -> tuple[Tensor, Tensor]:
    """θ of every movement by (61), which has no posterior covariance."""
    rows = []
    for (x, seen), timing, start in zip(movements, timings, starts, strict=True):
        _, target = target_force(x, start[:, 2], primitive.system(timing))
        usable = seen[:-1] & seen[1:] & torch.cat([seen[:1], seen[:-2]])
        kernels = primitive.kernel_values(len(x), timing, normalised=False)[:-1]
        gate = primitive.gate(len(x), timing)[:-1]
        rows.append(locally_weighted_regression(kernels, target, scale=gate, mask=usable).T)
    parameters = torch.cat([starts, torch.stack(rows)], dim=2)
    channels, size = parameters.shape[1:]
    return parameters, parameters.new_zeros(channels, size, size)


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


def _shrinkage(fit: _Fit, whole: Sums, early: Sums, floor: Tensor) -> float:
    """The shrinkage that best foretells movements left out; 0.5 of fewer than three movements."""
    if len(fit.parameters) < 3:
        return 0.5
    return max(SHRINKAGES, key=lambda share: _foretold(fit, whole, early, share, floor))


def _foretold(fit: _Fit, whole: Sums, early: Sums, shrinkage: float, floor: Tensor) -> float:
    """Log density of the later three quarters of movements left out, given their first."""
    count, score = len(fit.parameters), 0.0
    folds = torch.arange(count) % min(FOLDS, count)
    for fold in folds.unique():
        rows = (folds == fold).nonzero()[:, 0]
        population = estimate(fit.parameters[folds != fold], fit.uncertainty, shrinkage, floor)
        for sums, sign in ((whole, 1), (early, -1)):
            evidence = population.log_evidence(*_likelihood(sums.of_movements(rows), fit.noise))
            score += sign * float(evidence.sum())
    return score


def _likelihood(sums: Sums, noise: Tensor) -> tuple[Tensor, Tensor]:
    return sums.precision / noise[:, None, None], sums.linear / noise[:, None]


def _refined(
    population: Population, whole: Sums, noise: Tensor, shrinkage: float, floor: Tensor
) -> Population:
    """The population again, from parameters that it completed itself where frames were missing."""
    part = population.condition(*_likelihood(whole, noise))
    spread = part.private @ part.private.mT + part.factors @ part.factors.mT
    return estimate(part.mean, spread.mean(0), shrinkage, floor)
