r"""Gaussian over the weights of whole movements, jointly over all channels.

A movement is linear in one weight vector w of basis functions and synergies::

    w ~ N(μ, Σ),   y_tc = Σ_jk S_cj φ_k(t) w_jk,   x_tc ~ N(y_tc, σ_c²)

so that every set of observed entries is a Gaussian likelihood exp(−½ wᵀAw + bᵀw).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.movement.components import Paths

__all__ = ["Basis", "Weights", "superposed"]


@dataclass(frozen=True)
class Basis:
    """φ of every frame and the synergies S, by which the weights act on the channels."""

    phases: Float[Tensor, "*batch time kernel"]
    synergies: Float[Tensor, "channel synergy"]

    def path(self, w: Float[Tensor, "*batch weight"]) -> Float[Tensor, "*batch time channel"]:
        """y of weight vectors.

        >>> Basis(torch.eye(3), torch.tensor([[1.0], [2.0]])).path(torch.tensor([0.0, 1.0, 5.0])).mT
        tensor([[ 0.,  1.,  5.],
                [ 0.,  2., 10.]])
        """
        table = w.unflatten(-1, (self.synergies.shape[1], self.phases.shape[-1]))
        y: Tensor = (self.synergies @ table @ self.phases.mT).mT
        return y

    def precision(self, weight: Float[Tensor, "time channel"]) -> Float[Tensor, "weight weight"]:
        """A of entries that count ``weight``, 1/σ² where they were observed and 0 elsewhere."""
        s, φ = self.synergies, self.phases
        gram = torch.einsum("tc,ci,cj->tij", weight, s, s).flatten(1)
        kernel = (φ[:, :, None] * φ[:, None, :]).flatten(1)
        blocks = (gram.mT @ kernel).view(s.shape[1], s.shape[1], φ.shape[1], φ.shape[1])
        return blocks.transpose(1, 2).flatten(2).flatten(0, 1)

    def linear(
        self, weighted: Float[Tensor, "*batch time channel"]
    ) -> Float[Tensor, "*batch weight"]:
        """B of values that were multiplied by their weights: the adjoint of :meth:`path`."""
        linear: Tensor = self.synergies.mT @ weighted.mT @ self.phases
        return linear.flatten(-2)


@dataclass(frozen=True)
class Weights:
    """N(mean, root rootᵀ); ``mean`` may have leading axes, all with the same covariance."""

    mean: Float[Tensor, "*sequence weight"]
    root: Float[Tensor, "weight rank"]

    @cached_property
    def covariance(self) -> Float[Tensor, "weight weight"]:
        """Σ."""
        covariance: Tensor = self.root @ self.root.mT
        return covariance

    @property
    def lower(self) -> Float[Tensor, "weight weight"]:
        """Lower-triangular factor of Σ."""
        turned: Tensor = torch.linalg.qr(self.root.mT, mode="r").R.mT
        return turned * turned.diagonal().sign()

    def scaled(self, scale: float | Tensor) -> Weights:
        """The same mean with ``scale`` times the standard deviations."""
        return Weights(self.mean, scale * self.root)

    def condition(
        self, precision: Float[Tensor, "weight weight"], linear: Float[Tensor, "sequence weight"]
    ) -> Weights:
        """Posterior given the likelihoods exp(−½ wᵀAw + bᵀw)."""
        root = self._posterior_root(self._inner(precision))
        error = linear - self.mean @ precision
        return Weights(self.mean + (error @ root) @ root.mT, root)

    def log_evidence(
        self,
        precision: Float[Tensor, "weight weight"],
        linear: Float[Tensor, "sequence weight"],
        scales: Float[Tensor, " scale"],
    ) -> Float[Tensor, "scale sequence"]:
        """Log of the likelihood, integrated over w ~ N(μ, s²Σ), for every scale s."""
        inner = self._inner(precision, scales[:, None, None])
        error = linear - self.mean @ precision
        at_mean = (self.mean * (linear + error)).sum(-1) / 2
        pull = scales[:, None, None] * (error @ self.root).mT
        white = torch.linalg.solve_triangular(inner, pull, upper=False)
        volume = inner.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        evidence: Tensor = at_mean + white.square().sum(1) / 2 - volume[:, None]
        return evidence

    def affine(self, matrix: Float[Tensor, "weight weight"], shift: Tensor) -> Weights:
        """The distribution of matrix w + shift."""
        return Weights(self.mean @ matrix.mT + shift, matrix @ self.root)

    def moved(
        self, basis: Basis, goal: Float[Tensor, " channel"], population: Weights, smooth: float
    ) -> Weights:
        """w + MHᵀ(HMHᵀ)⁺ (0, g − y_T): nearest in the metric M, with the same first frame.

        M is the population's Σ with, for every synergy, ``smooth`` of its mean variance along the
        path of least jerk from 0 to 1, which leads to goals that Σ says nothing of. How M varies
        about that is added, as many times as the mean square of g − y_T in the units of M.
        """
        metric = population.covariance + smooth * _jerkless(basis, population)
        eye = torch.eye(len(metric), dtype=metric.dtype, device=metric.device)
        ends = basis.path(eye)[:, [0, -1]].flatten(1).mT
        inner = torch.linalg.pinv(ends @ metric @ ends.mT, rtol=1e-9, hermitian=True)
        gain = metric @ ends.mT @ inner
        last = ends[len(goal) :]
        change = goal - self.mean @ last.mT
        found = self.affine(eye - gain[:, len(goal) :] @ last, gain[:, len(goal) :] @ goal)
        far = change @ inner[len(goal) :, len(goal) :] @ change.mT / len(goal)
        rest = (eye - gain @ ends) @ torch.linalg.cholesky(metric)
        return Weights(found.mean, torch.cat([found.root, far.diagonal().mean().sqrt() * rest], 1))

    def centred(self, basis: Basis, goal: Float[Tensor, " channel"]) -> Weights:
        """Every synergy's weights about a new centre: those of a basis whose rows sum to one."""
        kernels, synergies = basis.phases.shape[1], basis.synergies.shape[1]
        alike = goal.new_full((kernels, kernels), 1 / kernels)
        middle = torch.kron(torch.eye(synergies, dtype=goal.dtype), alike)
        keep = torch.eye(len(middle), dtype=goal.dtype) - middle
        centre = torch.linalg.pinv(basis.synergies) @ goal
        return self.affine(keep, centre.repeat_interleave(kernels))

    def moments(
        self, basis: Basis
    ) -> tuple[Float[Tensor, "*sequence time channel"], Float[Tensor, "time channel"]]:
        """Mean of y, and its variance."""
        s, φ = basis.synergies, basis.phases
        cover = self.covariance.view(s.shape[1], φ.shape[1], s.shape[1], φ.shape[1])
        half = torch.einsum("cj,jkil->ckil", s, cover)
        each = torch.einsum("ckil,ci->ckl", half, s)
        variance = torch.einsum("ctk,tk->tc", φ @ each, φ).clamp_min(0)
        return basis.path(self.mean), variance

    def sample(self, count: int) -> Float[Tensor, "sample *sequence weight"]:
        """Draws of w, from torch's default generator."""
        shape = (count, *self.mean.shape[:-1], self.root.shape[-1])
        ε = torch.randn(shape, dtype=self.mean.dtype, device=self.mean.device)
        return self.mean + ε @ self.root.mT

    def _inner(self, precision: Tensor, scale: float | Tensor = 1.0) -> Tensor:
        """Cholesky factor of I + s² rootᵀ A root."""
        eye = torch.eye(self.root.shape[-1], dtype=self.root.dtype, device=self.root.device)
        gram = self.root.mT @ precision @ self.root
        factor: Tensor = torch.linalg.cholesky(eye + scale * scale * gram)
        return factor

    def _posterior_root(self, inner: Tensor) -> Tensor:
        turned: Tensor = torch.linalg.solve_triangular(inner, self.root.mT, upper=False)
        return turned.mT


def _jerkless(basis: Basis, population: Weights) -> Float[Tensor, "weight weight"]:
    """Every synergy's mean variance, along its path of least jerk (Flash & Hogan, 1985)."""
    kernels, synergies = basis.phases.shape[1], basis.synergies.shape[1]
    s = torch.linspace(0, 1, len(basis.phases), dtype=basis.phases.dtype)
    path = s**3 * (10 - 15 * s + 6 * s**2)
    φ = basis.phases
    gram = φ.mT @ φ + 1e-9 * torch.eye(kernels, dtype=φ.dtype)
    p = torch.linalg.solve(gram, φ.mT @ path)
    size = population.covariance.diagonal().view(synergies, kernels).mean(1)
    return torch.kron(size.diag(), torch.outer(p, p))


def superposed(terms: Sequence[tuple[Basis, Weights, Float[Tensor, " time"]]]) -> Paths:
    """Sum of independent paths, each counting a part at every frame."""
    parts = [(basis, weights, part[:, None]) for basis, weights, part in terms]
    moments = [weights.moments(basis) for basis, weights, _ in parts]
    mean = sum(p * m for (_, _, p), (m, _) in zip(parts, moments, strict=True))
    variance = sum(p.square() * v for (_, _, p), (_, v) in zip(parts, moments, strict=True))
    centre = torch.as_tensor(mean)

    def draw(count: int) -> Tensor:
        return torch.as_tensor(sum(p * b.path(w.sample(count)) for b, w, p in parts))

    return Paths(centre, torch.as_tensor(variance).expand_as(centre), draw)
