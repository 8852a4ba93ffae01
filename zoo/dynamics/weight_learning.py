"""Weights of demonstrations and their population, by expectation maximisation under a prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.dynamics.alignment import BasisOf
from zoo.dynamics.components import alike
from zoo.dynamics.rollout import Timing
from zoo.dynamics.sums import Movements
from zoo.dynamics.weights import Basis, Weights

__all__ = ["Learned", "View", "learn", "maximise", "views_of"]

FLOOR = 1e-8
FOLDS = 5
LARGEST = 12
SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9)


@dataclass(frozen=True)
class View:
    """Movements ``rows`` with one basis and the same entries seen; ``x`` is 0 where unseen."""

    rows: Int[Tensor, " sequence"]
    basis: Basis
    seen: Bool[Tensor, "time channel"]
    x: Float[Tensor, "sequence time channel"]

    def likelihood(self, variance: Float[Tensor, " channel"]) -> tuple[Tensor, Tensor]:
        """A and b of every movement, given σ²."""
        return self.basis.precision(self.seen / variance), self.basis.linear(self.x / variance)

    def log_density(self, prior: Weights, variance: Tensor) -> Float[Tensor, " sequence"]:
        """Log p(x_seen) of every movement."""
        square = (self.x.square() / variance).sum((1, 2))
        volume = (self.seen * (2 * math.pi * variance).log()).sum()
        return prior.log_evidence(*self.likelihood(variance)) - (square + volume) / 2

    def posterior(self, prior: Weights, variance: Tensor) -> Weights:
        """p(w | x_seen) of every movement."""
        return prior.condition(*self.likelihood(variance))

    def begun(self) -> View:
        """The same movements of which only the first quarter is seen."""
        early = torch.arange(len(self.seen))[:, None] < max(2, len(self.seen) // 4)
        return View(self.rows, self.basis, self.seen & early, self.x * early)

    def only(self, here: Bool[Tensor, " sequence"]) -> View:
        """Those of its movements that are ``here``."""
        return View(self.rows[here], self.basis, self.seen, self.x[here])


@dataclass(frozen=True)
class Learned:
    """p(w), σ², the share of the prior, and the objective after every iteration."""

    weights: Weights
    variance: Float[Tensor, " channel"]
    shrinkage: float
    objective: tuple[float, ...]


@dataclass(frozen=True)
class _Expected:
    """What the posteriors of all movements add up to."""

    mean: Float[Tensor, "sequence weight"]
    covariance: Float[Tensor, "weight weight"]
    energy: Float[Tensor, " channel"]
    log_density: Tensor


def views_of(basis: BasisOf, movements: Movements, timings: Sequence[Timing]) -> list[View]:
    """Movements with the same timing, length and entries, gathered."""
    found = []
    kinds = [(t, len(x)) for t, (x, _) in zip(timings, movements, strict=True)]
    for timing, frames in dict.fromkeys(kinds):
        rows = torch.tensor([i for i, k in enumerate(kinds) if k == (timing, frames)])
        x, seen = (torch.stack([movements[i][j] for i in rows.tolist()]) for j in (0, 1))
        for some, mask in alike(seen):
            found.append(View(rows[some], basis(frames, timing), mask, x[some]))
    return found


def learn(
    views: Sequence[View],
    group: Int[Tensor, " sequence"],
    shrinkage: float | None,
    *,
    iterations: int,
    tolerance: float,
) -> Learned:
    """p(w) and σ² of several movements.

    Every movement gets weights of its own first. Their spread, pooled to one shape with a size for
    every synergy, is the scale Σ₀ of an inverse-Wishart prior that counts as much as
    ``shrinkage`` of all evidence on Σ; None takes the share under which groups of movements left
    out are most probable after their first quarter.
    """
    single, variance = _single(views)
    target = _target(single.mean, views[0].basis)
    share = _share(single, views, group, target, variance) if shrinkage is None else shrinkage
    start = _population(single, target, share)
    strength = len(single.mean) * share / (1 - share)
    return maximise(views, start, variance, target, strength, iterations, tolerance)


def maximise(
    views: Sequence[View],
    weights: Weights,
    variance: Tensor,
    target: Float[Tensor, "weight weight"],
    strength: float,
    iterations: int,
    tolerance: float,
) -> Learned:
    """EM from ``weights`` until an iteration gains less than ``tolerance`` nats a seen entry.

    The objective is Σ log p(x) − λ/2 (log|Σ| + tr Σ₀Σ⁻¹), with λ ``strength`` and Σ₀ ``target``.
    """
    count = sum(len(v.rows) * v.seen.sum(0) for v in views)
    entries, objective = float(torch.as_tensor(count).sum()), list[float]()
    movements = sum(len(v.rows) for v in views)
    for _ in range(iterations):
        found = _expect(views, weights, variance)
        objective.append(float(found.log_density - _penalty(weights, target, strength)))
        if len(objective) > 1 and objective[-1] - objective[-2] < tolerance * entries:
            break
        mean = found.mean.mean(0)
        scatter = (found.mean - mean).mT @ (found.mean - mean)
        total = found.covariance + scatter + strength * target
        weights = Weights(mean, torch.linalg.cholesky(total / (movements + strength)))
        variance = (found.energy / torch.as_tensor(count).clamp(min=1)).clamp_min(FLOOR)
    share = strength / (movements + strength)
    return Learned(weights, variance, share, tuple(objective))


def _expect(views: Sequence[View], prior: Weights, variance: Tensor) -> _Expected:
    movements = sum(len(v.rows) for v in views)
    mean = prior.mean.new_zeros(movements, prior.mean.shape[-1])
    covariance, energy = torch.zeros_like(prior.root), torch.zeros_like(variance)
    log_density = variance.new_zeros(())
    for view in views:
        posterior = view.posterior(prior, variance)
        path, spread = posterior.moments(view.basis)
        mean[view.rows] = posterior.mean
        covariance = covariance + len(view.rows) * posterior.covariance
        error = (view.x - path * view.seen).square().sum((0, 1))
        energy = energy + error + len(view.rows) * (spread * view.seen).sum(0)
        log_density = log_density + view.log_density(prior, variance).sum()
    return _Expected(mean, covariance, energy, log_density)


def _penalty(weights: Weights, target: Tensor, strength: float) -> Tensor:
    trace = torch.cholesky_solve(target, weights.root).diagonal().sum()
    return strength * (weights.root.diagonal().log().sum() + trace / 2)


def _single(views: Sequence[View]) -> tuple[Weights, Tensor]:
    """Weights of every movement alone, shrunk a little towards those of all, and σ²."""
    size = views[0].x.new_ones(views[0].x.shape[-1])
    parts = [view.likelihood(size) for view in views]
    total = torch.stack([len(v.rows) * a for v, (a, _) in zip(views, parts, strict=True)]).sum(0)
    ridge = 1e-6 * total.diagonal().mean() * torch.eye(len(total), dtype=total.dtype)
    linear = torch.stack([b.sum(0) for _, b in parts]).sum(0)
    mean = torch.linalg.solve(total + ridge, linear)
    prior = Weights(mean, torch.eye(len(total), dtype=total.dtype))
    found = _expect(views, prior, 1e-2 * size)
    count = torch.as_tensor(sum(len(v.rows) * v.seen.sum(0) for v in views)).clamp(min=1)
    root = torch.linalg.cholesky(found.covariance / len(found.mean) + FLOOR * torch.eye(len(mean)))
    return Weights(found.mean, root), (found.energy / count).clamp_min(FLOOR)


def _target(w: Float[Tensor, "sequence weight"], basis: Basis) -> Float[Tensor, "weight weight"]:
    """Σ₀: synergies are independent, of one shape over kernels and an own size each."""
    kernels = basis.phases.shape[1]
    deviation = (w - w.mean(0)).unflatten(1, (-1, kernels))
    size = deviation.square().sum((0, 2)).clamp_min(FLOOR)
    scaled = deviation / size.sqrt()[:, None]
    shape = torch.einsum("ijk,ijl->kl", scaled, scaled) / len(size)
    shape = shape + 1e-4 * shape.diagonal().mean() * torch.eye(kernels, dtype=w.dtype)
    return torch.kron((size / len(w)).diag(), shape)


def _population(single: Weights, target: Tensor, share: float) -> Weights:
    mean = single.mean.mean(0)
    deviation = single.mean - mean
    sample = deviation.mT @ deviation / len(deviation) + single.covariance
    return Weights(mean, torch.linalg.cholesky((1 - share) * sample + share * target))


def _share(
    single: Weights, views: Sequence[View], group: Tensor, target: Tensor, variance: Tensor
) -> float:
    """The share of the prior that best foretells groups left out; 0.5 of fewer than three."""
    if len(group.unique()) < 3:
        return 0.5
    largest = sorted(views, key=lambda v: -len(v.rows))[:LARGEST]
    return max(SHARES, key=lambda s: _foretold(s, single, largest, group, target, variance))


def _foretold(
    share: float,
    single: Weights,
    views: Sequence[View],
    group: Tensor,
    target: Tensor,
    variance: Tensor,
) -> float:
    """Log density of the later three quarters of movements left out, given their first."""
    score, fold = 0.0, group % FOLDS
    for left in fold.unique():
        out = fold == left
        population = _population(Weights(single.mean[~out], single.root), target, share)
        for view in (v.only(out[v.rows]) for v in views):
            if len(view.rows):
                score += float(view.log_density(population, variance).sum())
                score -= float(view.begun().log_density(population, variance).sum())
    return score
