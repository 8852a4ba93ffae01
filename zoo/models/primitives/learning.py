"""A population of movement primitives from demonstrations of unequal length with missing frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.primitives.alignment import anchors_of, primitive_timings
from zoo.models.primitives.communality import blocks, unshared
from zoo.models.primitives.conjugate_regression import FLOOR, conjugate_weights
from zoo.models.primitives.population import ParameterShrinkage, Population, estimate
from zoo.models.primitives.rollout import Primitive, kernel_values, roll_out
from zoo.models.primitives.scales import student_scales
from zoo.models.primitives.sufficient_statistics import Sums, of_weights, square_after, sums_of
from zoo.movement.cross_validation import chosen_in_turn, folds_of, splits
from zoo.movement.forcing import locally_weighted_regression, target_force, target_known
from zoo.movement.timing import Movements, Timing

__all__ = ["LearnedParameters", "Learning", "learn_parameters"]

RATIOS = (1e-2, 1e-1, 1.0, 10.0, 100.0)
INDEPENDENT = (0.0, 0.3, 1.0)
SCALES = {"discrete": 16, "rhythmic": 8}
LEAST = 3
LOW = 0.1
INFORMATION = (1.0, 0.3, 0.1, 0.03, 0.01)
FOLDS = 5
PLACES = 25
NOISE_OF = {"path": 100.0, "force": 1e-4}

Learning = Literal["path", "force", "lwr"]


@dataclass(frozen=True)
class LearnedParameters:
    """p(θ) with the residual variance σ² of every channel, ρ, and the timings of the movements.

    ``scales`` are those of the t that a population of few movements is.
    """

    population: Population
    noise: Float[Tensor, " channel"]
    ratio: Float[Tensor, " channel"]
    shrinkage: ParameterShrinkage
    scales: Float[Tensor, " scale"]
    timings: tuple[Timing, ...]


@dataclass(frozen=True)
class _Fit:
    """Parameters of every demonstration, how uncertain they are, and their residuals."""

    parameters: Float[Tensor, "sequence channel parameter"]
    uncertainty: Float[Tensor, "channel parameter parameter"]
    noise: Float[Tensor, " channel"]
    ratio: Float[Tensor, " channel"]


def learn_parameters(
    primitive: Primitive,
    learning: Learning,
    period: float | None,
    values: Float[Tensor, "sequence time channel"],
    mask: Bool[Tensor, "sequence time channel"],
    lengths: Int[Tensor, " sequence"],
) -> LearnedParameters:
    """Weights of every movement, noise by their evidence, and the population over movements."""
    movements = [
        (x[:n], seen[:n]) for x, seen, n in zip(values, mask, lengths.tolist(), strict=True)
    ]
    timings = primitive_timings(primitive, movements, period)
    starts = anchors_of(primitive, movements, timings)
    floor = _floor(movements, timings, primitive.kernels)
    scales = torch.ones(1, dtype=torch.float64)
    if len(movements) > 1:
        scales = student_scales(len(movements) - 1, SCALES[primitive.kind])
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
    shrinkage = ParameterShrinkage()
    if len(movements) >= LEAST:
        entries = _entries(primitive, movements, timings)
        shrinkage = _chosen(_HeldOut(fit, whole, early, entries, floor))
    population = estimate(fit.parameters, fit.uncertainty, shrinkage, floor)
    if not all(bool(seen.all()) for _, seen in movements):
        population = _refined(population, whole, fit.noise, shrinkage, floor)
    return LearnedParameters(population, fit.noise, fit.ratio, shrinkage, scales, tuple(timings))


def _ratios(learning: Learning) -> Float[Tensor, " ratio"]:
    """Those of the residuals, and that under which the weights are learned."""
    own = [NOISE_OF[learning]] if learning in NOISE_OF else []
    return torch.tensor([*RATIOS, *(r for r in own if r not in RATIOS)], dtype=torch.float64)


def _weights(sums: Sums, starts: Tensor) -> tuple[Tensor, Tensor]:
    """θ of every movement and its mean posterior covariance."""
    precision, linear = of_weights(sums, starts)
    count, square = (sums.count - 3).clamp_min(0), square_after(sums, starts)
    found = conjugate_weights(precision, linear, square, count)
    covariance = found.noise[:, None, None] * found.covariance.mean(0)
    uncertainty = torch.nn.functional.pad(covariance, (3, 0, 3, 0))
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
    rows, kind, count = [], primitive.kind, primitive.kernels
    for (x, seen), timing, start in zip(movements, timings, starts, strict=True):
        _, target = target_force(x, start[:, 2], primitive.system(timing))
        usable = target_known(seen.mT).mT
        kernels = kernel_values(kind, count, len(x), timing, normalised=False)[:-1]
        gate = primitive.gate(len(x), timing)[:-1]
        rows.append(locally_weighted_regression(kernels, target, scale=gate, mask=usable).T)
    parameters = torch.cat([starts, torch.stack(rows)], dim=2)
    channels, size = parameters.shape[1:]
    return parameters, parameters.new_zeros(channels, size, size)


def _floor(movements: Movements, timings: list[Timing], kernels: int) -> Tensor:
    """Least variance of the parameters; of one movement alone the variance over its own time."""
    floor = torch.full((3 + kernels,), 1e-8, dtype=torch.float64)
    if len(movements) == 1:
        ((x, seen),) = movements
        both = seen[1:] & seen[:-1]
        size = x[seen].var(unbiased=False) if seen.any() else torch.tensor(1.0)
        step = x.diff(dim=0)[both] if both.any() else torch.zeros(1)
        floor[0] = floor[2] = size
        floor[1] = step.square().mean() * timings[0].unit ** 2
    return floor


def _chosen(held_out: _HeldOut) -> ParameterShrinkage:
    """Shares, and then information, under which entries of held-out movements are most probable.

    What a channel has alone is what the others cannot tell of it. Shares are compared at a low
    information: at 1 they would make up for residuals that go together over channels and time,
    which are no matter of movements' parameters.
    """
    start = ParameterShrinkage(unshared(held_out.fit.parameters), INDEPENDENT[0], LOW)
    grids = [("independent", INDEPENDENT), ("information", INFORMATION)]
    return chosen_in_turn(start, grids, held_out.density)


@dataclass(frozen=True)
class _Entries:
    """Some entries of every movement, which of them are after its first quarter, and R there."""

    x: Float[Tensor, "sequence place channel"]
    seen: Bool[Tensor, "sequence place channel"]
    late: Bool[Tensor, "sequence place 1"]
    design: Float[Tensor, "sequence place parameter"]

    def errors(self, mean: Float[Tensor, "sequence channel parameter"]) -> Tensor:
        """x − R θ."""
        return self.x - self.design @ mean.mT

    def of_movements(self, rows: Bool[Tensor, " sequence"]) -> _Entries:
        """Those of some movements."""
        return _Entries(self.x[rows], self.seen[rows], self.late[rows], self.design[rows])


def _entries(primitive: Primitive, movements: Movements, timings: list[Timing]) -> _Entries:
    """Entries of ``PLACES`` frames evenly spaced."""
    designs: dict[tuple[int, Timing], Tensor] = {}
    rows = []
    for (x, seen), timing in zip(movements, timings, strict=True):
        frames = len(x)
        at = torch.linspace(0, frames - 1, PLACES).round().long()
        if (frames, timing) not in designs:
            designs[frames, timing] = roll_out(primitive, frames, timing)[at]
        late = (at >= max(2, frames // 4))[:, None]
        rows.append((x[at], seen[at], late, designs[frames, timing]))
    return _Entries(*(torch.stack(part) for part in zip(*rows, strict=True)))


@dataclass(frozen=True)
class _HeldOut:
    """Movements in folds, each under the population of the others."""

    fit: _Fit
    whole: Sums
    early: Sums
    entries: _Entries
    floor: Tensor

    def density(self, shrinkage: ParameterShrinkage) -> float:
        """Mean log density of single held-out entries, to two questions that count alike.

        The later three quarters are given the first; a block of channels, another in every fold, is
        given the others. Of single entries: jointly, thousands would count as independent.
        """
        e, information, found = self.entries, shrinkage.information, []
        count = e.seen.sum((0, 1)).clamp_min(1)
        rest = (e.errors(self.fit.parameters).square() * e.seen).sum((0, 1)) / count
        rest = rest.clamp_min(FLOOR)
        block = blocks(len(rest))
        for fold, rows, population in self._folds(shrinkage):
            a, b, whole_a, whole_b = self._likelihoods(rows)
            hidden = block == fold % (block.max() + 1)
            known = information * (~hidden).to(b)
            later = population.condition(information * a, information * b)
            filled = population.condition(known[:, None, None] * whole_a, known[:, None] * whole_b)
            here = e.of_movements(rows)
            found.append(_of_entries(later, here, here.late, rest))
            found.append(_of_entries(filled, here, hidden[None, None], rest))
        return float(torch.stack(found).unflatten(0, (-1, 2)).nanmean(0).nansum())

    def _folds(self, shrinkage: ParameterShrinkage) -> Iterator[tuple[int, Tensor, Population]]:
        """Every fold, its movements, and the population of the others."""
        parameters = self.fit.parameters
        for fold, rows in splits(folds_of(torch.arange(len(parameters)), FOLDS)):
            others = parameters[~rows]
            yield fold, rows, estimate(others, self.fit.uncertainty, shrinkage, self.floor)

    def _likelihoods(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of the first quarter, and of all."""
        parts = (self.early.of_movements(rows), self.whole.of_movements(rows))
        (a, b), (whole_a, whole_b) = (_likelihood(part, self.fit.noise) for part in parts)
        return a, b, whole_a, whole_b


def _of_entries(
    population: Population,
    entries: _Entries,
    asked: Bool[Tensor, "#sequence #place #channel"],
    rest: Float[Tensor, " channel"],
) -> Tensor:
    """Mean log density of the entries asked, up to a constant; NaN where none was observed."""
    root = torch.cat([population.loadings, population.private], dim=-1)
    alike = bool((entries.design == entries.design[0]).all())
    design = entries.design[:1] if alike else entries.design
    path = torch.linalg.vector_norm(design[:, None] @ root, dim=-1).square().mT
    variance = path + rest
    density = -(entries.errors(population.mean).square() / variance + variance.log()) / 2
    mean: Tensor = density[entries.seen & asked].mean()
    return mean


def _likelihood(sums: Sums, noise: Tensor) -> tuple[Tensor, Tensor]:
    return sums.precision / noise[:, None, None], sums.linear / noise[:, None]


def _refined(
    population: Population, whole: Sums, noise: Tensor, shrinkage: ParameterShrinkage, floor: Tensor
) -> Population:
    """The population again, from parameters that it completed itself where frames were missing."""
    part = population.condition(*_likelihood(whole, noise))
    covariance = part.private @ part.private.mT + part.loadings @ part.loadings.mT
    return estimate(part.mean, covariance.mean(0), shrinkage, floor)
