"""Parameters θ of a movement given its entries observed, at every timing and scale it may have."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.primitives.hypotheses import Alike, Drawn, Hypotheses, HypothesisPosterior
from zoo.models.primitives.movement_law import ResidualNoise
from zoo.models.primitives.population import Population
from zoo.models.primitives.rollout import Primitive
from zoo.models.primitives.sufficient_statistics import Sight, Sums, in_parts, sights
from zoo.movement.components import Components, Paths, alike
from zoo.movement.timing import Timing

__all__ = [
    "AtTiming",
    "DirectHypotheses",
    "ParameterHypotheses",
    "ParameterPosterior",
    "Summed",
]


@dataclass(frozen=True)
class AtTiming:
    """Movements with the same entries observed and one timing: p(θ | x) of each."""

    population: Population
    sight: Sight
    timing: Timing
    x: Float[Tensor, "sequence time channel"]


@dataclass(frozen=True)
class Summed(Alike):
    """Movements with the same entries observed: what they say of θ at every timing."""

    x: Float[Tensor, "some time channel"]
    sums: list[Sums]


@dataclass(frozen=True)
class Sighted(Summed):
    """Also how these entries see movements, at every timing."""

    sights: list[Sight]


G = TypeVar("G", bound=Summed)


@dataclass(frozen=True)
class ParameterHypotheses(Hypotheses[G]):
    """p(θ) at every timing and scale; an entry counts as ``information`` of an independent one."""

    primitive: Primitive
    population: Population
    noise: ResidualNoise
    information: float

    def likelihood(self, sums: Sums) -> tuple[Tensor, Tensor]:
        """Precision and linear term of θ."""
        weight = self.information / self.noise.std.square()
        return sums.precision * weight[:, None, None], sums.linear * weight[:, None]

    def evidence(self, part: G) -> Float[Tensor, "timing scale sequence"]:
        """log ∫ p(θ) p(x | θ)^information dθ of every timing and scale."""
        population, variance = self.population, self.noise.std.square()
        fits = [population.log_evidences(self.scales, *self.likelihood(s)) for s in part.sums]
        at_zero = [self.information * s.log_density(variance) for s in part.sums]
        pairs = zip(at_zero, fits, strict=True)
        return torch.stack([zero + fit for zero, fit in pairs])

    def likeliest(self, part: G) -> Int[Tensor, " some"]:
        """The likeliest timing of every movement."""
        if len(self.timings) == 1:
            return torch.zeros_like(part.rows)
        return self.evidence(part).logsumexp(1).argmax(0)

    def picked(self, part: G, count: int) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """Timings and scales resampled to ``count``: timing, scale, movements, components of these.

        One alone is the likeliest timing, with the usual scale: whole movements tell their θ.
        """
        if count > 1:
            for timing, scale, some, which in self.resampled(part, count):
                yield timing, self.scales[scale], some, which
            return
        likeliest = self.likeliest(part)
        for timing in likeliest.unique().tolist():
            some = likeliest == timing
            yield timing, self.scales.new_ones(()), some, some[None, some]

    def posterior(self, part: G, timing: int, scale: Tensor, some: Tensor) -> Population:
        """p(θ | x) of some movements of a part."""
        p = self.population
        prior = Population(p.mean, scale * p.loadings, scale * p.private)
        return prior.condition(*self.likelihood(part.sums[timing].of_movements(some)))


@dataclass(frozen=True)
class DirectHypotheses(ParameterHypotheses[Sighted]):
    """Timings and scales of movements whose channels are seen as they are."""

    def observed_alike(
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
    ) -> Iterator[tuple[Tensor, Tensor, AtTiming]]:
        """Rows, which of ``count`` components they are, and p(θ | x)."""
        for part in self.observed_alike(values, seen):
            for timing, scale, some, which in self.picked(part, count):
                yield part.rows[some], which, self.at_timing(part, timing, scale, some)

    def mixture(
        self, values: Tensor, seen: Tensor, count: int, render: Callable[[AtTiming], Paths]
    ) -> Components:
        """Paths that ``render`` makes of them at every timing, a mixture of ``count`` of them."""
        parts = None
        for rows, which, at in self.chosen(values, seen, count):
            if count == 1 and len(rows) == len(values):
                return Components.alone(render(at))
            parts = Components.empty(count, values) if parts is None else parts
            parts.put(rows, which, render(at))
        return parts or Components.empty(count, values)

    def demonstrated(self, values: Tensor, seen: Tensor) -> list[AtTiming]:
        """The likeliest timing of every movement, with the usual scale, and p(θ | x)."""
        found, one = dict[int, AtTiming](), self.scales.new_ones(())
        for part in self.observed_alike(values, seen):
            best = self.likeliest(part).tolist()
            for j, (row, i) in enumerate(zip(part.rows.tolist(), best, strict=True)):
                found[row] = self.at_timing(part, i, one, torch.tensor([j]))
        return [found[row] for row in range(len(values))]

    def at_timing(self, part: Sighted, timing: int, scale: Tensor, some: Tensor) -> AtTiming:
        """p(θ | x) of some movements of a part."""
        posterior = self.posterior(part, timing, scale, some)
        x = part.x if len(some) == len(part.x) and bool(some.all()) else part.x[some]
        return AtTiming(posterior, part.sights[timing], self.timings[timing], x)


class ParameterPosterior(HypothesisPosterior[G]):
    """Also p(a | timing, scale, x) and p(δ | a, timing, scale, x) of the movements."""

    def __init__(self, given: ParameterHypotheses[G], x: Tensor, seen: Tensor) -> None:
        """Weigh every timing and scale of every movement."""
        super().__init__(given, x, seen)
        self.given = given

    def shared(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(a | timing, scale, x)."""
        a, b, p = self._conditions(drawn)
        mean, root = p.shared_posterior(a, b)
        return dist.MultivariateNormal(mean, precision_matrix=root @ root.mT)

    def private(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(V⁻¹δ | a, timing, scale, x)."""
        a, b, p = self._conditions(drawn)
        none = b.new_zeros(*b.shape[:-2], p.loadings.shape[-1])
        mean, root = p.private_posterior(a, b, drawn.get("shared", none))
        white = dist.MultivariateNormal(mean, precision_matrix=root @ root.mT)
        law: dist.TorchDistribution = white.to_event(1)
        return law

    def _conditions(self, drawn: Drawn) -> tuple[Tensor, Tensor, Population]:
        """Likelihood and prior of the timings and scales drawn, for every movement."""
        timing, (channels, parameters) = drawn["timing"], self.given.population.mean.shape
        linear = self.evidence.new_empty(*timing.shape, channels, parameters)
        precision = linear.new_empty(*linear.shape, parameters)
        for part in self.parts:
            chosen = timing[..., part.rows]
            for i in chosen.unique().tolist():
                *lead, which = (chosen == i).nonzero(as_tuple=True)
                index = (*lead, part.rows[which])
                sums = part.sums[i].of_movements(which)
                precision[index], linear[index] = self.given.likelihood(sums)
        s = self.given.scales[drawn["scale"]][..., None, None, None]
        p = self.given.population
        return precision, linear, Population(p.mean, s * p.loadings, s * p.private)
