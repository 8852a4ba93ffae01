"""Draws from Gaussians whose covariance may be singular, and posteriors of white variables."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["joint_draws", "white_posterior"]


def joint_draws(
    mean: Float[Tensor, "item target"],
    covariance: Float[Tensor, "item item"],
    signal: Float[Tensor, " target"],
    draws: int,
) -> Float[Tensor, "sample item target"]:
    """Draws of independent targets, each N(mean_p, signal_p · covariance) jointly over items.

    Eigenvalues below 0, rounding in a smooth process, count as 0.

    >>> joint_draws(torch.zeros(3, 2), torch.ones(3, 3), torch.ones(2), 5).shape
    torch.Size([5, 3, 2])
    """
    values, vectors = torch.linalg.eigh(0.5 * (covariance + covariance.mT))
    root = vectors * values.clamp_min(0).sqrt()
    noise = torch.randn(draws, *mean.shape, dtype=mean.dtype, device=mean.device)
    paths: Tensor = mean + (root @ noise) * signal.sqrt()
    return paths


def white_posterior(
    projection: Float[Tensor, "*target white item"],
    weight: Float[Tensor, "target item"],
    y: Float[Tensor, "target item"],
) -> tuple[Float[Tensor, "target white"], Float[Tensor, "target white white"]]:
    """Mean and lower root of p(v | y) for v ~ N(0, I), y ~ N(Vᵀv, W⁻¹), V the ``projection``.

    The covariance is B⁻¹ with B = I + V W Vᵀ. As B = U Uᵀ with U upper triangular, U⁻ᵀ is its
    lower root, and no difference of covariances is taken. A weight of 0 is a missing item.

    >>> one = torch.ones(1, 1)
    >>> [part.item() for part in white_posterior(one[None], 3 * one, 2 * one)]
    [1.5, 0.5]
    """
    weighted = projection * weight[:, None]
    eye = torch.eye(projection.shape[-2], dtype=y.dtype, device=y.device)
    precision = eye + weighted @ projection.mT
    upper = torch.linalg.cholesky(precision.flip(-1, -2)).flip(-1, -2)
    root = torch.linalg.solve_triangular(upper, eye, upper=True).mT
    mean = root @ (root.mT @ (weighted @ y[..., None]))
    return mean[..., 0], root
