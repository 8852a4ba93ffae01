"""Draws from Gaussians whose covariance may be singular."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["joint_draws"]


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
