"""Stationary covariances of unit variance by name; all but the squared exponential of gpytorch."""

from __future__ import annotations

from functools import cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call

from zoo.models.processes.kernels import squared_distances, squared_exponential

__all__ = ["KERNELS", "Name", "learned_shape", "stationary"]

Name = Literal["squared-exponential", "matern12", "matern32", "matern52", "rational-quadratic"]
KERNELS: dict[str, float | None] = {
    "squared-exponential": None,
    "matern12": 0.5,
    "matern32": 1.5,
    "matern52": 2.5,
    "rational-quadratic": None,
}


class _Forward(nn.Module):
    """The forward of a gpytorch kernel on tensors, without its lazy call."""

    def __init__(self, kernel: nn.Module) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        covariance: Tensor = self.kernel.forward(a, b)
        return covariance


def stationary(
    name: Name,
    a: Float[Tensor, "a feature"],
    b: Float[Tensor, "b feature"],
    length: Float[Tensor, " length"],
    shape: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "a b"]:
    """κ(a_i, b_j) of a named kernel, differentiable by inputs, length scales and shape.

    ``length`` holds one length scale or one for each feature; ``shape`` is α of the rational
    quadratic, (1 + d²/2α)^−α, and None of the others. The diagonal of a covariance of gpytorch of
    ``a`` with itself is 1 without rounding.

    >>> one = torch.ones(1, dtype=torch.float64)
    >>> x = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    >>> stationary("matern12", x, x, one).log().tolist()
    [[0.0, -1.0], [-1.0, 0.0]]
    """
    if name == "squared-exponential":
        distances = squared_distances(a / length, b / length)
        return squared_exponential(distances, distances.new_zeros(()))
    given = {"kernel.raw_lengthscale": _raw(length)[None]}
    if shape is not None:
        given["kernel.raw_alpha"] = _raw(shape)[None]
    covariance: Tensor = functional_call(_made(name, len(length)), given, (a, b))
    if a is not b:
        return covariance
    same = torch.eye(len(a), dtype=torch.bool, device=a.device)
    return torch.where(same, 1.0, covariance)


def learned_shape(name: Name, *size: int) -> nn.Parameter | None:
    """log α = 0 of so many rational quadratic kernels; None of the others.

    >>> learned_shape("matern12", 3) is None, learned_shape("rational-quadratic", 3).shape
    (True, torch.Size([3]))
    """
    if name != "rational-quadratic":
        return None
    return nn.Parameter(torch.zeros(size, dtype=torch.float64))


@cache
def _made(name: Name, lengths: int) -> _Forward:
    """The kernel; its parameters are given in every call."""
    from gpytorch.kernels import MaternKernel, RQKernel

    features = None if lengths == 1 else lengths
    smoothness = KERNELS[name]
    if smoothness is None:
        return _Forward(RQKernel(ard_num_dims=features))
    return _Forward(MaternKernel(nu=smoothness, ard_num_dims=features))


def _raw(positive: Tensor) -> Tensor:
    """The inverse of softplus, which gpytorch's constraints apply, without overflow."""
    raw: Tensor = positive + torch.log(-torch.expm1(-positive))
    return raw
