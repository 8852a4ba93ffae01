"""Collapsed bounds of sparse Gaussian processes, FITC and VFE, with a written gradient.

Items come in blocks: the projection Vᵀ = K_fu L⁻ᵀ is kept between two passes in memory that is
reused from evaluation to evaluation, everything else has the size of a block. With C = VᵀV + Λ,
B = I + V W Vᵀ, W = Λ⁻¹ and α = C⁻¹y the derivatives by V and Λ are V H and ½ diag H, where
H = P C⁻¹ − Σ_p α_p α_pᵀ/σ_f,p².
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.linalg import solve_triangular

from zoo.models.processes.evidence import Pattern, log_determinant, profiled

__all__ = ["Collapsed", "SparsePosterior"]

_BLOCK = 1 << 19


class SparsePosterior(NamedTuple):
    """q(v) of v = L⁻¹u for targets seen at the same items: B = L_B L_Bᵀ and the mean B⁻¹ V W y."""

    factor: Float[Tensor, "inducing inducing"]
    mean: Float[Tensor, "inducing target"]
    diagonal: Float[Tensor, " item"]
    weight: Float[Tensor, " item"]
    residual: Float[Tensor, "item target"]
    quadratic: Float[Tensor, " target"]


class Collapsed:
    """Minus the log evidence of all targets with u integrated out, signal variances profiled.

    FITC: Λ = 1 − diag Q + ρ; VFE: Λ = ρ and tr(K − Q)/2ρ on top, Q = K_fu K_uu⁻¹ K_uf.
    """

    def __init__(
        self,
        targets: Float[Tensor, "item target"],
        groups: tuple[Pattern, ...],
        bound: Literal["fitc", "vfe"],
    ) -> None:
        """The bound of these targets; ``groups`` are their patterns of missing entries."""
        self.targets, self.groups, self.bound = targets, groups, bound
        self._memory = targets.new_empty(0)

    def __call__(
        self,
        k_uu: Float[Tensor, "inducing inducing"],
        distances: Float[Tensor, "item inducing"],
        log_length: Float[Tensor, ""],
        noise: Float[Tensor, ""],
    ) -> Float[Tensor, ""]:
        """Value, differentiable once by each argument; covariances have unit signal variance."""
        arguments = (k_uu, distances, log_length, noise, self)
        value: Tensor = _Bound.apply(*arguments)  # type: ignore[no-untyped-call]
        return value

    def of(
        self,
        k_uu: Float[Tensor, "inducing inducing"],
        k_fu: Float[Tensor, "item inducing"],
        noise: Float[Tensor, ""],
    ) -> Float[Tensor, ""]:
        """The same value of whatever covariances, differentiable by autograd."""
        projection = solve_triangular(torch.linalg.cholesky(k_uu), k_fu.mT, upper=False).mT
        return self.value(projection, noise, self.posteriors(projection, noise))

    def project(self, factor: Tensor, distances: Tensor, log_length: Tensor) -> Tensor:
        """Vᵀ = K_fu L⁻ᵀ, in memory that the next evaluation overwrites."""
        if self._memory.shape != distances.shape:
            self._memory = torch.empty_like(distances)
        for rows in _blocks(distances):
            k_fu = _kernel(distances[rows], log_length)
            self._memory[rows] = solve_triangular(factor.mT, k_fu, upper=True, left=False)
        return self._memory

    def posteriors(self, projection: Tensor, noise: Tensor) -> list[SparsePosterior]:
        """q(v) of every group of targets."""
        left = 1 - torch.linalg.vector_norm(projection, dim=1).square()
        diagonal = left + noise if self.bound == "fitc" else noise.expand_as(left)
        return [
            _posterior(projection, diagonal, self.targets[:, list(targets)], observed)
            for observed, targets in self.groups
        ]

    def value(self, projection: Tensor, noise: Tensor, found: list[SparsePosterior]) -> Tensor:
        """Sum over groups of the profiled evidence, and for VFE of the trace."""
        terms = [
            self._value(projection, noise, *pair) for pair in zip(found, self.groups, strict=True)
        ]
        return torch.stack(terms).sum()

    def _value(
        self, projection: Tensor, noise: Tensor, q: SparsePosterior, group: Pattern
    ) -> Tensor:
        determinant = log_determinant(q.factor) + q.diagonal[group.observed].log().sum()
        value = profiled(q.quadratic, determinant, int(group.observed.sum()))
        if self.bound == "fitc":
            return value
        return value + len(q.quadratic) * _trace(projection, noise, group)


class _Bound(Function):
    @staticmethod
    def forward(
        ctx: Any,
        k_uu: Tensor,
        distances: Tensor,
        log_length: Tensor,
        noise: Tensor,
        bound: Collapsed,
    ) -> Tensor:
        factor = torch.linalg.cholesky(k_uu)
        projection = bound.project(factor, distances, log_length)
        found = bound.posteriors(projection, noise)
        if any(ctx.needs_input_grad):
            slopes = _Slopes(bound, factor, projection, noise, found)
            ctx.save_for_backward(*slopes.pull_back(distances, log_length, ctx.needs_input_grad[1]))
        return bound.value(projection, noise, found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        by_uu, by_distance, by_length, by_noise = ctx.saved_tensors
        by_distance = gradient * by_distance if by_distance.numel() else None
        return gradient * by_uu, by_distance, gradient * by_length, gradient * by_noise, None


class _Slopes:
    """Second pass: derivatives by K_uu, the distances, log l and ρ."""

    def __init__(
        self,
        bound: Collapsed,
        factor: Tensor,
        projection: Tensor,
        noise: Tensor,
        found: list[SparsePosterior],
    ) -> None:
        self.bound, self.factor, self.projection, self.noise = bound, factor, projection, noise
        self.found = found
        self.by_noise = noise.new_zeros(())

    def pull_back(
        self, distances: Tensor, log_length: Tensor, by_distances: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """From V to the arguments: G_fu = G_V L⁻¹ and G_uu = −½ L⁻ᵀ (G_V Vᵀ) L⁻¹."""
        inner = torch.zeros_like(self.factor)
        by_length = log_length.new_zeros(())
        precision = torch.exp(-2 * log_length)
        by_distance = torch.empty_like(distances) if by_distances else distances.new_empty(0)
        for rows in _blocks(distances):
            slope = self._by_projection(rows)
            inner.addmm_(slope.mT, self.projection[rows])
            flow = solve_triangular(self.factor, slope, upper=False, left=False)
            flow.mul_(_kernel(distances[rows], log_length))
            if by_distances:
                torch.mul(flow, -0.5 * precision, out=by_distance[rows])
            by_length += precision * torch.dot(flow.flatten(), distances[rows].flatten())
        left = solve_triangular(self.factor.mT, inner, upper=True)
        by_uu = -0.5 * solve_triangular(self.factor, left, upper=False, left=False)
        return by_uu, by_distance, by_length, self.by_noise

    def _by_projection(self, rows: slice) -> Tensor:
        """(V H)ᵀ over a block of items, with the part through Λ; adds to the slope by ρ."""
        total = torch.zeros_like(self.projection[rows])
        for q, group in zip(self.found, self.bound.groups, strict=True):
            total += self._group(rows, q, group)
        return total

    def _group(self, rows: slice, q: SparsePosterior, group: Pattern) -> Tensor:
        v, weight, observed = self.projection[rows], q.weight[rows], group.observed[rows]
        count, signal = len(q.quadratic), q.quadratic / group.observed.sum()
        alpha = weight[:, None] * q.residual[rows]
        half = solve_triangular(q.factor.mT, v, upper=True, left=False)
        inverse = weight - (weight * torch.linalg.vector_norm(half, dim=1)).square()
        by_diagonal = 0.5 * (count * inverse - (alpha.square() / signal).sum(1))
        self.by_noise = self.by_noise + by_diagonal.sum()
        half.mul_((count * weight)[:, None])
        slope: Tensor = solve_triangular(q.factor, half, upper=False, left=False)
        slope.addmm_(alpha, (q.mean / signal).mT, alpha=-1)
        if self.bound.bound == "fitc":
            slope.addcmul_(v, by_diagonal[:, None], value=-2)
            return slope
        part = Pattern(observed, group.targets)
        self.by_noise = self.by_noise - count * _trace(v, self.noise, part) / self.noise
        slope.addcmul_(v, (observed / self.noise)[:, None], value=-count)
        return slope


def _posterior(
    projection: Tensor, diagonal: Tensor, y: Tensor, observed: Tensor
) -> SparsePosterior:
    weight = observed / diagonal
    precision = torch.eye(projection.shape[1], dtype=y.dtype, device=y.device)
    for rows in _blocks(projection):
        precision.addmm_((projection[rows] * weight[rows, None]).mT, projection[rows])
    factor = torch.linalg.cholesky(precision)
    mean = torch.cholesky_solve(projection.mT @ (weight[:, None] * y), factor)
    residual = (y - projection @ mean) * observed[:, None]
    # the minimum over the mean of the penalised squares: no cancellation as in yᵀWy − cᵀc
    quadratic = weight @ residual.square() + mean.square().sum(0)
    return SparsePosterior(factor, mean, diagonal, weight, residual, quadratic)


def _trace(projection: Tensor, noise: Tensor, group: Pattern) -> Tensor:
    """tr(K − Q)/2σ_n² of one target."""
    left = 1 - torch.linalg.vector_norm(projection, dim=1).square()
    trace: Tensor = (left * group.observed).sum() / (2 * noise)
    return trace


def _kernel(distances: Tensor, log_length: Tensor) -> Tensor:
    covariance: Tensor = (distances * (-0.5 * torch.exp(-2 * log_length))).exp_()
    return covariance


def _blocks(matrix: Tensor) -> list[slice]:
    """Rows in blocks of some 4 MB, which the allocator reuses and the cache holds."""
    size = max(1, _BLOCK // matrix.shape[1])
    return [slice(i, i + size) for i in range(0, len(matrix), size)]
