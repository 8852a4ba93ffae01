"""Timing and scale of a movement as discrete unknowns, with its parameters exact given these."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.primitives.movement_law import Noise
from zoo.models.primitives.population import Population
from zoo.movement.components import Components, Paths, alike, resample
from zoo.movement.rollout import Primitive, Timing
from zoo.movement.sufficient_statistics import Sight, Sums, in_parts, sights

__all__ = ["Case", "Cases", "Group", "Posteriors", "Unknowns"]

Drawn = Mapping[str, Tensor]


@dataclass(frozen=True)
class Case:
    """Movements with the same entries observed and one timing: p(θ | x) of each."""

    population: Population
    sight: Sight
    timing: Timing
    x: Float[Tensor, "sequence time channel"]


@dataclass(frozen=True)
class Group:
    """Movements with the same entries observed: what they say of θ at every timing."""

    rows: Int[Tensor, " some"]
    x: Float[Tensor, "some time channel"]
    sums: list[Sums]


@dataclass(frozen=True)
class Sighted(Group):
    """A group with how its entries see movements, at every timing."""

    sights: list[Sight]


@dataclass(frozen=True)
class Unknowns(ABC):
    """Equally likely timings and scales s of the deviations from the mean movement.

    Every entry counts as ``information`` of an independent one.
    """

    primitive: Primitive
    population: Population
    noise: Noise
    information: float
    timings: Sequence[Timing]
    scales: Float[Tensor, " scale"]

    @abstractmethod
    def groups(
        self,
        values: Float[Tensor, "sequence time channel"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> Iterator[Group]:
        """What the movements say of θ."""
        ...

    def likelihood(self, sums: Sums) -> tuple[Tensor, Tensor]:
        """Precision and linear term of θ."""
        weight = self.information / self.noise.std.square()
        return sums.precision * weight[:, None, None], sums.linear * weight[:, None]

    def evidence(self, group: Group) -> Float[Tensor, "timing scale sequence"]:
        """log ∫ p(θ) p(x | θ)^information dθ of every timing and scale."""
        population, variance = self.population, self.noise.std.square()
        fits = [population.log_evidences(self.scales, *self.likelihood(s)) for s in group.sums]
        at_zero = [self.information * s.log_density(variance) for s in group.sums]
        pairs = zip(at_zero, fits, strict=True)
        return torch.stack([zero + fit for zero, fit in pairs])

    def likeliest(self, group: Group) -> Int[Tensor, " some"]:
        """The likeliest timing of every movement."""
        if len(self.timings) == 1:
            return torch.zeros_like(group.rows)
        return self.evidence(group).logsumexp(1).argmax(0)

    def picked(self, group: Group, count: int) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """Timings and scales resampled to ``count``: timing, scale, movements, components of these.

        One alone is the likeliest timing, with the usual scale: whole movements tell their θ.
        """
        if count == 1:
            picks = self.likeliest(group)[None]
        else:
            picks = resample(self.evidence(group).flatten(0, 1), count)
        for i in picks.unique().tolist():
            some, one = (picks == i).any(0), self.scales.new_ones(())
            timing, scale = divmod(i, 1 if count == 1 else len(self.scales))
            yield timing, one if count == 1 else self.scales[scale], some, picks[:, some] == i

    def posterior(self, group: Group, timing: int, scale: Tensor, some: Tensor) -> Population:
        """p(θ | x) of some movements of a group."""
        p = self.population
        prior = Population(p.mean, scale * p.factors, scale * p.private)
        return prior.condition(*self.likelihood(group.sums[timing].of_movements(some)))


@dataclass(frozen=True)
class Cases(Unknowns):
    """Timings and scales of movements whose channels are seen as they are."""

    def groups(
        self,
        values: Float[Tensor, "sequence time channel"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> Iterator[Sighted]:
        """What the movements say of θ; the errors of timings of one tempo are the same."""
        for rows, mask in alike(seen):
            x = values if len(rows) == len(values) else values[rows]
            x = x if bool(mask.all()) else x * mask
            views = sights(self.primitive, self.timings, self.noise.ratio, mask)
            sums = list[Sums]()
            for _, same in groupby(zip(self.timings, views, strict=True), lambda p: p[0].unit):
                sums += in_parts(x, [(view, x.shape[1]) for _, view in same])
            yield Sighted(rows, x, sums, views)

    def chosen(
        self, values: Tensor, seen: Tensor, count: int
    ) -> Iterator[tuple[Tensor, Tensor, Case]]:
        """Rows, which of ``count`` components they are, and p(θ | x)."""
        for group in self.groups(values, seen):
            for timing, scale, some, which in self.picked(group, count):
                yield group.rows[some], which, self.case(group, timing, scale, some)

    def mixture(
        self, values: Tensor, seen: Tensor, count: int, render: Callable[[Case], Paths]
    ) -> Components:
        """Paths that ``render`` makes of every case, a mixture of ``count`` of them."""
        parts = None
        for rows, which, case in self.chosen(values, seen, count):
            if count == 1 and len(rows) == len(values):
                return Components.alone(render(case))
            parts = Components.empty(count, values) if parts is None else parts
            parts.put(rows, which, render(case))
        return parts or Components.empty(count, values)

    def demonstrated(self, values: Tensor, seen: Tensor) -> list[Case]:
        """The likeliest timing of every movement, with the usual scale, and p(θ | x)."""
        cases, one = dict[int, Case](), self.scales.new_ones(())
        for group in self.groups(values, seen):
            best = self.likeliest(group).tolist()
            for j, (row, i) in enumerate(zip(group.rows.tolist(), best, strict=True)):
                cases[row] = self.case(group, i, one, torch.tensor([j]))
        return [cases[row] for row in range(len(values))]

    def case(self, group: Sighted, timing: int, scale: Tensor, some: Tensor) -> Case:
        """p(θ | x) of some movements of a group."""
        posterior = self.posterior(group, timing, scale, some)
        x = group.x if len(some) == len(group.x) and bool(some.all()) else group.x[some]
        return Case(posterior, group.sights[timing], self.timings[timing], x)


class Posteriors:
    """p(timing | x), p(scale | timing, x) and p(θ | timing, scale, x) of some movements."""

    def __init__(self, cases: Unknowns, x: Tensor, seen: Tensor) -> None:
        """Weigh every timing and scale of every movement."""
        self.cases, self.groups = cases, list(cases.groups(x, seen))
        self.evidence = x.new_empty(len(cases.timings), len(cases.scales), len(x))
        for group in self.groups:
            self.evidence[..., group.rows] = cases.evidence(group)

    def log_evidence(self) -> Float[Tensor, " sequence"]:
        """Log of the likelihood, integrated over everything."""
        count = self.evidence.shape[0] * self.evidence.shape[1]
        total: Tensor = self.evidence.flatten(0, 1).logsumexp(0) - math.log(count)
        return total

    def timing(self, _: Drawn) -> dist.TorchDistribution:
        """p(timing | x)."""
        return dist.Categorical(logits=self.evidence.logsumexp(1).mT)

    def scale(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(scale | timing, x)."""
        timing = drawn["timing"]
        rows = torch.arange(self.evidence.shape[2]).expand_as(timing)
        return dist.Categorical(logits=self.evidence[timing, :, rows])

    def shared(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(a | timing, scale, x)."""
        a, b, p = self._given(drawn)
        mean, root = p.shared_posterior(a, b)
        return dist.MultivariateNormal(mean, precision_matrix=root @ root.mT)

    def private(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(V⁻¹δ | a, timing, scale, x)."""
        a, b, p = self._given(drawn)
        none = b.new_zeros(*b.shape[:-2], p.factors.shape[-1])
        mean, root = p.private_posterior(a, b, drawn.get("shared", none))
        white = dist.MultivariateNormal(mean, precision_matrix=root @ root.mT)
        law: dist.TorchDistribution = white.to_event(1)
        return law

    def _given(self, drawn: Drawn) -> tuple[Tensor, Tensor, Population]:
        """Likelihood and prior of the timings and scales drawn, for every movement."""
        timing, (channels, parameters) = drawn["timing"], self.cases.population.mean.shape
        linear = self.evidence.new_empty(*timing.shape, channels, parameters)
        precision = linear.new_empty(*linear.shape, parameters)
        for group in self.groups:
            chosen = timing[..., group.rows]
            for i in chosen.unique().tolist():
                *lead, which = (chosen == i).nonzero(as_tuple=True)
                index = (*lead, group.rows[which])
                precision[index], linear[index] = self._likelihood(group.sums[i], which)
        s = self.cases.scales[drawn["scale"]][..., None, None, None]
        p = self.cases.population
        return precision, linear, Population(p.mean, s * p.factors, s * p.private)

    def _likelihood(self, sums: Sums, which: Tensor) -> tuple[Tensor, Tensor]:
        return self.cases.likelihood(sums.of_movements(which))
