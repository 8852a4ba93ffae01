"""Timing and scale of a movement as discrete unknowns, with its weights exact given these."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.models.primitives.alignment import BasisOf
from zoo.models.primitives.weight_learning import Noise, View
from zoo.models.primitives.weights import Weights, superposed
from zoo.movement.components import Components, alike, resample
from zoo.movement.rollout import Timing

if TYPE_CHECKING:
    from pyro.distributions import TorchDistribution

__all__ = ["Hypotheses", "Posteriors"]

Drawn = Mapping[str, Tensor]


@dataclass(frozen=True)
class Hypotheses:
    """p(w) at every one of some equally likely timings and scales: w ~ N(μ, s²Σ)."""

    prior: Weights
    noise: Noise
    basis: BasisOf
    timings: list[Timing]
    scales: Float[Tensor, " scale"]

    def sights(
        self, x: Float[Tensor, "sequence time channel"], seen: Bool[Tensor, "sequence time channel"]
    ) -> Iterator[list[View]]:
        """Movements with the same entries observed, at every timing; ``x`` is about the offset."""
        for rows, mask in alike(seen):
            known = x[rows] * mask
            yield [View(rows, self.basis(len(mask), t), mask, known) for t in self.timings]

    def evidence(self, views: list[View]) -> Float[Tensor, "hypothesis sequence"]:
        """Log p(x_observed) of every timing with every scale, the scales of one timing together."""
        each = [view.log_density(self.prior, self.noise, self.scales) for view in views]
        return torch.cat(each)

    def posterior(self, view: View, scale: int) -> Weights:
        """p(w | x_observed) at one timing and scale."""
        return view.posterior(self.prior.scaled(self.scales[scale]), self.noise)

    def chosen(self, views: list[View], count: int) -> Iterator[tuple[int, View, int, Tensor]]:
        """Hypotheses resampled to ``count``: timing, its movements, scale, and which components."""
        several = len(views) * len(self.scales) > 1
        picks = resample(self.evidence(views), count) if several else views[0].rows[None] * 0
        for i in picks.unique().tolist():
            here = picks == i
            some, timing = here.any(0), i // len(self.scales)
            yield timing, views[timing].only(some), i % len(self.scales), here[:, some]

    def filled(self, x: Tensor, seen: Tensor, count: int) -> Components:
        """Paths given the entries observed, a mixture over at most ``count`` hypotheses."""
        count = 1 if len(self.timings) * len(self.scales) == 1 else count
        parts = Components.empty(count, x)
        whole = x.new_ones(x.shape[1])
        for views in self.sights(x, seen):
            for _, view, scale, which in self.chosen(views, count):
                path = superposed([(view.basis, self.posterior(view, scale), whole)])
                parts.put(view.rows, which, path)
        return parts

    def demonstrated(self, x: Tensor, seen: Tensor) -> list[tuple[Timing, Weights]]:
        """The likeliest timing of every movement and the posterior of its weights."""
        found = dict[int, tuple[Timing, Weights]]()
        for views in self.sights(x, seen):
            for i, view, scale, _ in self.chosen(views, 1):
                weights = self.posterior(view, scale)
                for row, mean in zip(view.rows.tolist(), weights.mean, strict=True):
                    found[row] = (self.timings[i], Weights(mean[None], weights.root))
        return [found[row] for row in range(len(x))]


class Posteriors:
    """p(timing | x), p(scale | timing, x) and p(w | timing, scale, x) of some movements."""

    def __init__(self, given: Hypotheses, x: Tensor, seen: Tensor) -> None:
        """Weigh every hypothesis of every movement."""
        self.given = given
        self.sights = list(given.sights(x, seen))
        shape = (len(given.timings), len(given.scales), len(x))
        self.evidence = x.new_empty(shape)
        for views in self.sights:
            self.evidence[..., views[0].rows] = given.evidence(views).unflatten(0, shape[:2])

    def log_evidence(self) -> Float[Tensor, " sequence"]:
        """Log p(x_observed) of every movement."""
        count = len(self.given.timings) * len(self.given.scales)
        total: Tensor = self.evidence.flatten(0, 1).logsumexp(0) - math.log(count)
        return total

    def timing(self, _: Drawn) -> TorchDistribution:
        """p(timing | x) of every movement."""
        return dist.Categorical(logits=self.evidence.logsumexp(1).mT)

    def scale(self, drawn: Drawn) -> TorchDistribution:
        """p(scale | timing, x) of every movement."""
        timing = drawn["timing"]
        rows = torch.arange(self.evidence.shape[2], device=timing.device).expand_as(timing)
        return dist.Categorical(logits=self.evidence[timing, :, rows])

    def weights(self, drawn: Drawn) -> TorchDistribution:
        """p(w | timing, scale, x) of every movement."""
        timing, scale = drawn["timing"], drawn["scale"]
        size = self.given.prior.mean.shape[-1]
        mean = self.evidence.new_empty(*timing.shape, size)
        lower = self.evidence.new_empty(*timing.shape, size, size)
        for views in self.sights:
            rows = views[0].rows
            kinds = torch.stack([timing[..., rows], scale[..., rows]], -1)
            for kind in kinds.flatten(0, -2).unique(dim=0):
                *lead, which = (kinds == kind).all(-1).nonzero(as_tuple=True)
                found = self.given.posterior(views[int(kind[0])], int(kind[1]))
                mean[(*lead, rows[which])] = found.mean[which]
                lower[(*lead, rows[which])] = found.lower
        return dist.MultivariateNormal(mean, scale_tril=lower)
