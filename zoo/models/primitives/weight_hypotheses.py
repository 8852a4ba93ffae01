"""Weights of a movement given its entries observed, at every timing and scale that it may have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.models.primitives.alignment import BasisOf
from zoo.models.primitives.hypotheses import Alike, Drawn, Hypotheses, HypothesisPosterior
from zoo.models.primitives.weight_learning import EntryNoise, View
from zoo.models.primitives.weights import Weights, superposed
from zoo.movement.components import Components, alike
from zoo.movement.timing import Timing

__all__ = ["WeightHypotheses", "WeightPosterior"]


@dataclass(frozen=True)
class Viewed(Alike):
    """Movements with the same entries observed, at every timing."""

    views: list[View]


@dataclass(frozen=True)
class WeightHypotheses(Hypotheses[Viewed]):
    """p(w) at every timing and scale: w ~ N(μ, s²Σ)."""

    prior: Weights
    noise: EntryNoise
    basis: BasisOf

    def observed_alike(
        self,
        values: Float[Tensor, "sequence time channel"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> Iterator[Viewed]:
        """Movements, about the offset, as every timing sees them."""
        for rows, mask in alike(seen):
            known = values[rows] * mask
            views = [View(rows, self.basis(len(mask), t), mask, known) for t in self.timings]
            yield Viewed(rows, views)

    def evidence(self, part: Viewed) -> Float[Tensor, "timing scale sequence"]:
        """Log p(x_observed) under every timing and scale."""
        each = [view.log_density(self.prior, self.noise, self.scales) for view in part.views]
        return torch.stack(each)

    def posterior(self, view: View, scale: int) -> Weights:
        """p(w | x_observed) at one timing and scale."""
        return view.posterior(self.prior.scaled(self.scales[scale]), self.noise)

    def filled(self, x: Tensor, seen: Tensor, count: int) -> Components:
        """Paths given the entries observed, a mixture over at most ``count`` hypotheses."""
        count = self.at_most(count)
        parts = Components.empty(count, x)
        whole = x.new_ones(x.shape[1])
        for part in self.observed_alike(x, seen):
            for timing, scale, some, which in self.resampled(part, count):
                view = part.views[timing].only(some)
                path = superposed([(view.basis, self.posterior(view, scale), whole)])
                parts.put(view.rows, which, path)
        return parts

    def demonstrated(self, x: Tensor, seen: Tensor) -> list[tuple[Timing, Weights]]:
        """The likeliest timing of every movement and the posterior of its weights."""
        found = dict[int, tuple[Timing, Weights]]()
        for part in self.observed_alike(x, seen):
            for i, scale, some, _ in self.resampled(part, 1):
                view = part.views[i].only(some)
                weights = self.posterior(view, scale)
                for row, mean in zip(view.rows.tolist(), weights.mean, strict=True):
                    found[row] = (self.timings[i], Weights(mean[None], weights.root))
        return [found[row] for row in range(len(x))]


class WeightPosterior(HypothesisPosterior[Viewed]):
    """Also p(w | timing, scale, x) of the movements."""

    def __init__(self, given: WeightHypotheses, x: Tensor, seen: Tensor) -> None:
        """Weigh every hypothesis of every movement."""
        super().__init__(given, x, seen)
        self.given = given

    def weights(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(w | timing, scale, x) of every movement."""
        timing, scale = drawn["timing"], drawn["scale"]
        size = self.given.prior.mean.shape[-1]
        mean = self.evidence.new_empty(*timing.shape, size)
        lower = self.evidence.new_empty(*timing.shape, size, size)
        for part in self.parts:
            kinds = torch.stack([timing[..., part.rows], scale[..., part.rows]], -1)
            for kind in kinds.flatten(0, -2).unique(dim=0):
                *lead, which = (kinds == kind).all(-1).nonzero(as_tuple=True)
                found = self.given.posterior(part.views[int(kind[0])], int(kind[1]))
                mean[(*lead, part.rows[which])] = found.mean[which]
                lower[(*lead, part.rows[which])] = found.lower
        return dist.MultivariateNormal(mean, scale_tril=lower)
