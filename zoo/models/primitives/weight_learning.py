"""Weights of demonstrations and their population, by expectation maximisation under a prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.primitives.alignment import BasisOf
from zoo.models.primitives.weights import Basis, Weights
from zoo.movement.components import alike
from zoo.movement.timing import Movements, Timing

__all__ = [
    "EntryNoise",
    "LearnedWeights",
    "Single",
    "View",
    "learn_weights",
    "maximise",
    "similarity",
    "views_of",
]

FLOOR = 1e-8
REACH = 0.25


@dataclass(frozen=True)
class EntryNoise:
    """σ_c², and the part of an independent observation that every entry counts."""

    variance: Float[Tensor, " channel"]
    information: float = 1.0

    @property
    def precision(self) -> Float[Tensor, " channel"]:
        """What an observed entry tells of the path."""
        precision: Tensor = self.information / self.variance
        return precision


@dataclass(frozen=True)
class View:
    """Movements ``rows`` with one basis and the same entries observed; ``x`` is 0 where unseen."""

    rows: Int[Tensor, " sequence"]
    basis: Basis
    seen: Bool[Tensor, "time channel"]
    x: Float[Tensor, "sequence time channel"]

    def likelihood(self, noise: EntryNoise) -> tuple[Tensor, Tensor]:
        """A and b of every movement."""
        counts = noise.precision
        return self.basis.precision(self.seen * counts), self.basis.linear(self.x * counts)

    def log_density(
        self, prior: Weights, noise: EntryNoise, scales: Float[Tensor, " scale"] | None = None
    ) -> Float[Tensor, "scale sequence"]:
        """Log p(x_observed) of every movement for w ~ N(μ, s²Σ); s = 1 without ``scales``."""
        s = self.x.new_ones(1) if scales is None else scales
        if self.separable:
            return self._compressed(prior, noise, s)
        square = (self.x.square() * noise.precision).sum((1, 2))
        volume = noise.information * (self.seen * (2 * math.pi * noise.variance).log()).sum()
        return prior.log_evidence(*self.likelihood(noise), s) - (square + volume) / 2

    @property
    def separable(self) -> bool:
        """Whether the same frames were observed of every channel that was observed at all."""
        frames, channels = self.seen.any(1), self.seen.any(0)
        return bool((self.seen == frames[:, None] & channels).all())

    def _compressed(self, prior: Weights, noise: EntryNoise, scales: Tensor) -> Tensor:
        """The same density by the part of x that w explains: φ = QR of the frames observed."""
        frames, channels = self.seen.any(1), self.seen.any(0)
        deviation = noise.precision[channels].sqrt()
        q, r = torch.linalg.qr(self.basis.phases[frames])
        inner = Basis(r, self.basis.synergies[channels] * deviation[:, None])
        x = self.x[:, frames][..., channels] * deviation
        z = q.mT @ x
        rest = x.square().sum((1, 2)) - z.square().sum((1, 2))
        error = (z - inner.path(prior.mean)).flatten(1)
        half = inner.path(prior.covariance).flatten(-2)
        cover = inner.path(half.mT).flatten(-2)
        square, volume = _gaussian(cover, error, scales)
        entries = noise.information * (2 * math.pi * noise.variance[channels]).log().sum()
        density: Tensor = -(square + rest + volume[:, None] + len(q) * entries) / 2
        return density

    def posterior(self, prior: Weights, noise: EntryNoise) -> Weights:
        """p(w | x_observed) of every movement."""
        return prior.condition(*self.likelihood(noise))

    def only(self, here: Bool[Tensor, " sequence"]) -> View:
        """Those of its movements that are ``here``."""
        return View(self.rows[here], self.basis, self.seen, self.x[here])


def _gaussian(cover: Tensor, error: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """eᵀ(I + s²C)⁻¹e of every error, and log |I + s²C|, for every scale s."""
    eye = torch.eye(len(cover), dtype=cover.dtype, device=cover.device)
    root = torch.linalg.cholesky(eye + scales[:, None, None].square() * cover)
    white = torch.linalg.solve_triangular(root, error.mT.expand(len(scales), -1, -1), upper=False)
    volume = 2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return white.square().sum(1), volume


@dataclass(frozen=True)
class LearnedWeights:
    """p(w), σ², and the objective after every iteration."""

    weights: Weights
    variance: Float[Tensor, " channel"]
    objective: tuple[float, ...]


@dataclass(frozen=True)
class Single:
    """Weights of every movement alone, shrunk a little towards those of all, with σ² and Σ₀."""

    weights: Weights
    variance: Float[Tensor, " channel"]
    target: Float[Tensor, "weight weight"]

    @classmethod
    def of(cls, views: Sequence[View], correlation: Float[Tensor, "kernel kernel"]) -> Single:
        """Every movement for itself; ``correlation`` is that of neighbouring kernels."""
        size = views[0].x.new_ones(views[0].x.shape[-1])
        prior = Weights(*_pooled(views, EntryNoise(size)))
        found = _expect(views, prior, EntryNoise(1e-2 * size))
        count = torch.as_tensor(sum(len(v.rows) * v.seen.sum(0) for v in views)).clamp(min=1)
        covariance = found.covariance / len(found.mean) + FLOOR * torch.eye(len(prior.mean))
        weights = Weights(found.mean, torch.linalg.cholesky(covariance))
        variance = (found.energy / count).clamp_min(FLOOR)
        return cls(weights, variance, _target(found.mean, correlation))

    def population(self, share: float) -> Weights:
        """N(μ, Σ) of the movements, of which Σ₀ has that ``share``."""
        mean = self.weights.mean.mean(0)
        deviation = self.weights.mean - mean
        sample = deviation.mT @ deviation / len(deviation) + self.weights.covariance
        return Weights(mean, torch.linalg.cholesky((1 - share) * sample + share * self.target))


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


def similarity(kernels: int, *, circular: bool) -> Float[Tensor, "kernel kernel"]:
    """Correlation of the weights of two kernels under the prior, e to the minus their distance.

    It falls to 1/e over a quarter of the kernels, on a circle where they are ``circular``.

    >>> similarity(4, circular=True)[0].log().round(decimals=3).tolist()
    [0.0, -1.0, -2.0, -1.0]
    """
    order = torch.arange(kernels, dtype=torch.float64)
    apart = (order[:, None] - order).abs()
    apart = torch.minimum(apart, kernels - apart) if circular else apart
    return torch.exp(-apart / (REACH * kernels))


def learn_weights(
    single: Single, views: Sequence[View], share: float, iterations: int, tolerance: float
) -> LearnedWeights:
    """p(w) and σ² of several movements, whose own weights are known.

    Σ₀ is the scale of an inverse-Wishart prior that counts as much as ``share`` of all evidence on
    Σ; see :func:`maximise`.
    """
    strength = len(single.weights.mean) * share / (1 - share)
    start = single.population(share)
    return maximise(views, start, single.variance, single.target, strength, iterations, tolerance)


def maximise(
    views: Sequence[View],
    weights: Weights,
    variance: Tensor,
    target: Float[Tensor, "weight weight"],
    strength: float,
    iterations: int,
    tolerance: float,
) -> LearnedWeights:
    """EM from ``weights`` until an iteration gains less than ``tolerance`` nats an observed entry.

    The objective is Σ log p(x) − λ/2 (log|Σ| + tr Σ₀Σ⁻¹), with λ ``strength`` and Σ₀ ``target``.
    """
    count = sum(len(v.rows) * v.seen.sum(0) for v in views)
    entries, objective = float(torch.as_tensor(count).sum()), list[float]()
    movements = sum(len(v.rows) for v in views)
    for _ in range(iterations):
        found = _expect(views, weights, EntryNoise(variance))
        objective.append(float(found.log_density - _penalty(weights, target, strength)))
        if len(objective) > 1 and objective[-1] - objective[-2] < tolerance * entries:
            break
        mean = found.mean.mean(0)
        scatter = (found.mean - mean).mT @ (found.mean - mean)
        total = found.covariance + scatter + strength * target
        weights = Weights(mean, torch.linalg.cholesky(total / (movements + strength)))
        variance = (found.energy / torch.as_tensor(count).clamp(min=1)).clamp_min(FLOOR)
    return LearnedWeights(weights, variance, tuple(objective))


def _expect(views: Sequence[View], prior: Weights, noise: EntryNoise) -> _Expected:
    movements = sum(len(v.rows) for v in views)
    mean = prior.mean.new_zeros(movements, prior.mean.shape[-1])
    covariance, energy = torch.zeros_like(prior.root), torch.zeros_like(noise.variance)
    log_density = noise.variance.new_zeros(())
    for view in views:
        posterior = view.posterior(prior, noise)
        path, variance = posterior.moments(view.basis)
        mean[view.rows] = posterior.mean
        covariance = covariance + len(view.rows) * posterior.covariance
        error = (view.x - path * view.seen).square().sum((0, 1))
        energy = energy + error + len(view.rows) * (variance * view.seen).sum(0)
        log_density = log_density + view.log_density(prior, noise).sum()
    return _Expected(mean, covariance, energy, log_density)


def _penalty(weights: Weights, target: Tensor, strength: float) -> Tensor:
    trace = torch.cholesky_solve(target, weights.root).diagonal().sum()
    return strength * (weights.root.diagonal().log().sum() + trace / 2)


def _pooled(views: Sequence[View], noise: EntryNoise) -> tuple[Tensor, Tensor]:
    """Least-squares weights of all movements together, and I as the covariance about them."""
    parts = [view.likelihood(noise) for view in views]
    total = torch.stack([len(v.rows) * a for v, (a, _) in zip(views, parts, strict=True)]).sum(0)
    eye = torch.eye(len(total), dtype=total.dtype)
    linear = torch.stack([b.sum(0) for _, b in parts]).sum(0)
    return torch.linalg.solve(total + 1e-6 * total.diagonal().mean() * eye, linear), eye


def _target(
    w: Float[Tensor, "sequence weight"], correlation: Tensor
) -> Float[Tensor, "weight weight"]:
    """Σ₀: synergies are independent, each of its own size; neighbouring kernels go together."""
    deviation = (w - w.mean(0)).unflatten(1, (-1, len(correlation)))
    size = deviation.square().sum((0, 2)) / ((len(w) - 1) * len(correlation))
    return torch.kron(size.clamp_min(FLOOR).diag(), correlation)
