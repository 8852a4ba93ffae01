"""Log evidence of Gaussian processes with the signal variance profiled out, and its gradient.

With covariance σ_f² C, C = κ + ρI or its sparse approximation Q + Λ, the best signal variance is
σ_f² = yᵀC⁻¹y / n, and minus the log evidence (41) of one target becomes
½ [n log(2π yᵀC⁻¹y / n) + n + log|C|]. Length scale and noise ratio ρ = σ_n²/σ_f² are shared by the
targets, hence every Cholesky factor too. Gradients are written out, as in (42).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from zoo.datasets.records import Pairs, Sequences

__all__ = ["Pattern", "dense", "log_determinant", "pairs_of", "patterns", "profiled"]


class Pattern(NamedTuple):
    """Targets that were observed at the same items."""

    observed: Bool[Tensor, " item"]
    targets: tuple[int, ...]


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


def profiled(
    quadratic: Float[Tensor, " target"], determinant: Float[Tensor, ""], count: int
) -> Float[Tensor, ""]:
    """½ Σ_p [n log(2π yᵀC⁻¹y / n) + n + log|C|] for targets with the same n and C."""
    fit = count * (torch.log(quadratic / count) + math.log(2 * math.pi) + 1)
    return 0.5 * (fit + determinant).sum()


def log_determinant(factor: Float[Tensor, "item item"]) -> Float[Tensor, ""]:
    """log|C| from its Cholesky factor."""
    return 2 * factor.diagonal().log().sum()


class _Dense(Function):
    @staticmethod
    def forward(ctx: Any, covariance: Tensor, targets: Tensor) -> Tensor:
        factor = torch.linalg.cholesky(covariance)
        alpha = torch.cholesky_solve(targets, factor)
        quadratic = (targets * alpha).sum(0)
        ctx.save_for_backward(factor, alpha, quadratic)
        return profiled(quadratic, log_determinant(factor), len(targets))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        factor, alpha, quadratic = ctx.saved_tensors
        inverse = torch.cholesky_inverse(factor)
        signal = quadratic / len(alpha)
        slope = alpha.shape[1] * inverse - (alpha / signal) @ alpha.mT
        return 0.5 * gradient * slope, None
