"""Squared exponential covariance from squared distances that are computed once."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

__all__ = ["median_distance", "squared_distances", "squared_exponential"]

_BLOCK = 1 << 21


def squared_distances(
    a: Float[Tensor, "a feature"], b: Float[Tensor, "b feature"]
) -> Float[Tensor, "a b"]:
    """‖a_i − b_j‖² in float64, one matrix product over blocks of ``a`` of some 16 MB.

    Both are centred on the mean of ``b``, which keeps the product's cancellation small.

    >>> squared_distances(torch.tensor([[0.0], [1.0]]), torch.tensor([[3.0]])).tolist()
    [[9.0], [4.0]]
    """
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"inputs have {a.shape[1]} features; {b.shape[1]} are needed")
    centre = b.detach().double().mean(0)
    others = b.double() - centre
    norms = others.square().sum(1)
    size = max(1, _BLOCK // a.shape[1])
    return torch.cat([_distances(part.double() - centre, others, norms) for part in a.split(size)])


def squared_exponential(
    distances: Float[Tensor, "*shape"], log_length: Float[Tensor, ""]
) -> Float[Tensor, "*shape"]:
    """κ = exp(−d²/2l²) of squared distances, (35) with unit signal variance.

    >>> squared_exponential(torch.tensor([2.0]), torch.tensor(0.0)).log().tolist()
    [-1.0]
    """
    covariance: Tensor = _SquaredExponential.apply(distances, log_length)  # type: ignore[no-untyped-call]
    return covariance


def median_distance(distances: Float[Tensor, "a b"]) -> Float[Tensor, ""]:
    """Median of the distances that are not 0; 1 where all are."""
    apart = distances[distances > 0]
    return apart.median().sqrt() if len(apart) else distances.new_ones(())


def _distances(rows: Tensor, others: Tensor, norms: Tensor) -> Tensor:
    own: Tensor = torch.linalg.vecdot(rows, rows)[:, None]
    return (own + torch.addmm(norms, rows, others.mT, alpha=-2)).clamp_min(0)


class _SquaredExponential(Function):
    """Keeps the covariance for its backward, so that nothing is exponentiated twice."""

    @staticmethod
    def forward(ctx: Any, distances: Tensor, log_length: Tensor) -> Tensor:
        precision = torch.exp(-2 * log_length)
        covariance = (distances * (-0.5 * precision)).exp_()
        ctx.save_for_backward(distances, covariance, precision)
        return covariance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        distances, covariance, precision = ctx.saved_tensors
        flow = gradient * covariance
        back = flow * (-0.5 * precision) if ctx.needs_input_grad[0] else None
        length = torch.dot(flow.flatten(), distances.flatten()) * precision
        return back, length if ctx.needs_input_grad[1] else None
