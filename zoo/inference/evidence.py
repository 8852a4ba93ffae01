"""Log evidence of Gaussian processes with the signal variance profiled out, and its gradient.

With covariance σ_f² C, C = κ + ρI or its sparse approximation Q + Λ, the best signal variance is
σ_f² = yᵀC⁻¹y / n, and minus the log evidence (41) of one target becomes
½ [n log(2π yᵀC⁻¹y / n) + n + log|C|]. Length scale and noise ratio ρ = σ_n²/σ_f² are shared by the
targets, hence every Cholesky factor too. Gradients are written out, as in (42).
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from zoo.datasets.records import Pairs, Sequences

__all__ = ["Pattern", "collapsed", "dense", "pairs_of", "patterns", "sparse_posterior"]


class Pattern(NamedTuple):
    """Targets that were observed at the same items."""

    observed: Bool[Tensor, " item"]
    targets: tuple[int, ...]


class SparsePosterior(NamedTuple):
    """q(u) in the coordinates v = L⁻¹u: B = I + V W Vᵀ = L_B L_Bᵀ and its mean b = B⁻¹ V W y."""

    factor: Float[Tensor, "inducing inducing"]
    mean: Float[Tensor, "inducing target"]
    diagonal: Float[Tensor, " item"]
    weight: Float[Tensor, " item"]
    residual: Float[Tensor, "item target"]
    quadratic: Float[Tensor, " target"]


def pairs_of(data: Pairs | Sequences) -> Pairs:
    """``data`` if it can condition a Gaussian process: pairs, every target observed somewhere."""
    if not isinstance(data, Pairs):
        raise TypeError(f"a Gaussian process needs Pairs; got {type(data).__name__}")
    for name, seen in zip(data.channels, data.mask.any(0).tolist(), strict=True):
        if not seen:
            raise ValueError(f"target {name} has no observed item")
    return data


def patterns(mask: Bool[Tensor, "item target"]) -> tuple[Pattern, ...]:
    """Targets grouped by which of their items were observed.

    >>> [p.targets for p in patterns(torch.tensor([[True, True, False], [True, True, True]]))]
    [(0, 1), (2,)]
    """
    groups: dict[tuple[bool, ...], list[int]] = {}
    for target in range(mask.shape[1]):
        groups.setdefault(tuple(mask[:, target].tolist()), []).append(target)
    return tuple(Pattern(mask[:, t[0]], tuple(t)) for t in groups.values())


def dense(
    covariance: Float[Tensor, "item item"], targets: Float[Tensor, "item target"]
) -> Float[Tensor, ""]:
    """Minus the log evidence of complete targets under C, signal variance profiled.

    >>> y = torch.tensor([[1.0], [1.0]], dtype=torch.float64)
    >>> round(float(dense(torch.eye(2, dtype=torch.float64), y)), 4)
    2.8379
    """
    value: Tensor = _Dense.apply(covariance, targets)  # type: ignore[no-untyped-call]
    return value


def collapsed(
    k_uu: Float[Tensor, "inducing inducing"],
    k_uf: Float[Tensor, "inducing item"],
    noise: Float[Tensor, ""],
    targets: Float[Tensor, "item target"],
    groups: tuple[Pattern, ...],
    bound: Literal["fitc", "vfe"],
) -> Float[Tensor, ""]:
    """Minus the FITC log evidence, Λ = 1 − diag Q + ρ, or the bound of Titsias, Λ = ρ.

    ``k_uu`` and ``k_uf`` have unit signal variance; Q = K_fu K_uu⁻¹ K_uf as (43) means it.
    """
    data = (targets, groups, bound)
    value: Tensor = _Collapsed.apply(k_uu, k_uf, noise, *data)  # type: ignore[no-untyped-call]
    return value


def sparse_posterior(
    projection: Float[Tensor, "inducing item"],
    noise: Float[Tensor, ""],
    targets: Float[Tensor, "item target"],
    observed: Bool[Tensor, " item"],
    bound: Literal["fitc", "vfe"],
) -> SparsePosterior:
    """q(u) of targets seen at the same items; ``projection`` is V = L⁻¹ K_uf, Q = VᵀV."""
    explained = projection.square().sum(0)
    diagonal = 1 - explained + noise if bound == "fitc" else noise.expand_as(explained)
    weight = observed / diagonal
    weighted = projection * weight
    precision = weighted @ projection.mT
    precision.diagonal().add_(1)
    factor = torch.linalg.cholesky(precision)
    mean = torch.cholesky_solve(weighted @ targets, factor)
    residual = (targets - projection.mT @ mean) * observed[:, None]
    # the minimum over b of the penalised squares: free of the cancellation of yᵀWy − cᵀc
    quadratic = weight @ residual.square() + mean.square().sum(0)
    return SparsePosterior(factor, mean, diagonal, weight, residual, quadratic)


def _profiled(quadratic: Tensor, log_determinant: Tensor, count: int) -> Tensor:
    fit = count * (torch.log(quadratic / count) + math.log(2 * math.pi) + 1)
    return 0.5 * (fit + log_determinant).sum()


def _log_determinant(factor: Tensor) -> Tensor:
    return 2 * factor.diagonal().log().sum()


class _Dense(Function):
    @staticmethod
    def forward(ctx: Any, covariance: Tensor, targets: Tensor) -> Tensor:
        factor = torch.linalg.cholesky(covariance)
        alpha = torch.cholesky_solve(targets, factor)
        quadratic = (targets * alpha).sum(0)
        ctx.save_for_backward(factor, alpha, quadratic)
        return _profiled(quadratic, _log_determinant(factor), len(targets))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        factor, alpha, quadratic = ctx.saved_tensors
        inverse = torch.cholesky_inverse(factor)
        signal = quadratic / len(alpha)
        slope = alpha.shape[1] * inverse - (alpha / signal) @ alpha.mT
        return 0.5 * gradient * slope, None


class _Collapsed(Function):
    @staticmethod
    def forward(
        ctx: Any,
        k_uu: Tensor,
        k_uf: Tensor,
        noise: Tensor,
        targets: Tensor,
        groups: tuple[Pattern, ...],
        bound: Literal["fitc", "vfe"],
    ) -> Tensor:
        factor = torch.linalg.cholesky(k_uu)
        projection = torch.linalg.solve_triangular(factor, k_uf, upper=False)
        value, slope, noise_slope = k_uu.new_zeros(()), None, k_uu.new_zeros(())
        for observed, which in groups:
            y = targets[:, list(which)]
            q = sparse_posterior(projection, noise, y, observed, bound)
            value = value + _value(projection, noise, q, observed, bound)
            if any(ctx.needs_input_grad):
                part, noise_part = _slopes(projection, noise, q, observed, bound)
                slope = part if slope is None else slope.add_(part)
                noise_slope = noise_slope + noise_part
        if slope is not None:
            ctx.save_for_backward(*_pull_back(factor, projection, slope), noise_slope)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        slopes = (gradient * slope for slope in ctx.saved_tensors)
        return (*slopes, None, None, None)


def _value(
    projection: Tensor, noise: Tensor, q: SparsePosterior, observed: Tensor, bound: str
) -> Tensor:
    log_determinant = _log_determinant(q.factor) + q.diagonal[observed].log().sum()
    value = _profiled(q.quadratic, log_determinant, int(observed.sum()))
    return (
        value if bound == "fitc" else value + len(q.quadratic) * _trace(projection, noise, observed)
    )


def _trace(projection: Tensor, noise: Tensor, observed: Tensor) -> Tensor:
    """tr(K − Q)/2σ_n² of one target."""
    return ((1 - projection.square().sum(0)) * observed).sum() / (2 * noise)


def _slopes(
    projection: Tensor, noise: Tensor, q: SparsePosterior, observed: Tensor, bound: str
) -> tuple[Tensor, Tensor]:
    """Derivatives by V and ρ; with H = P C⁻¹ − Σ_p αα'/σ_f² they are V H and ½ tr H, plus Λ's."""
    count = len(q.quadratic)
    signal = q.quadratic / observed.sum()
    alpha = q.weight[:, None] * q.residual
    half = torch.linalg.solve_triangular(q.factor, projection, upper=False)
    inverse = q.weight - q.weight.square() * half.square().sum(0)
    by_diagonal = 0.5 * (count * inverse - (alpha.square() / signal).sum(1))
    half.mul_(count * q.weight)
    slope = torch.linalg.solve_triangular(q.factor.mT, half, upper=True)
    slope.addmm_(q.mean / signal, alpha.mT, alpha=-1)
    if bound == "fitc":
        slope.addcmul_(projection, by_diagonal, value=-2)
        return slope, by_diagonal.sum()
    slope.addcmul_(projection, observed / noise, value=-count)
    return slope, by_diagonal.sum() - count * _trace(projection, noise, observed) / noise


def _pull_back(factor: Tensor, projection: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """From V to K_uu and K_uf: G_uf = L⁻ᵀ G_V and G_uu = −½ L⁻ᵀ G_V Vᵀ L⁻¹."""
    inner = slope @ projection.mT
    by_uf = torch.linalg.solve_triangular(factor.mT, slope, upper=True)
    left = torch.linalg.solve_triangular(factor.mT, inner, upper=True)
    by_uu = torch.linalg.solve_triangular(factor, left, upper=False, left=False)
    return -0.5 * by_uu, by_uf
