"""Demonstrations with another goal: forces scaled by the ratio of the ways, and the doubt in it."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.models.primitives.population import Population

__all__ = ["aimed", "recentred"]


def aimed(
    demonstrated: Population,
    goal: Float[Tensor, " channel"],
    least: Float[Tensor, "*sequence channel"],
    *,
    scaled: bool,
) -> tuple[Population, Float[Tensor, "*sequence channel parameter"]]:
    """p(θ | x) scaled about y₁ by κ, and how far its goal then is from ``goal``.

    κ = (g' − y₁)/(g − y₁) of joints whose way g − y₁ is at least ``least``, nearer to 1 of others,
    and 1 unless ``scaled``. How forces go with goals is not known: half of what κ could change
    them, in either direction, is a standard deviation of all joints together.
    """
    first, fitted = demonstrated.mean[..., [0, 2]].unbind(-1)
    reach = fitted - first
    size = torch.maximum(reach.abs(), least).clamp_min(torch.finfo(least.dtype).tiny)
    change = (goal - fitted) / size
    κ = 1 + change * reach / size if scaled else torch.ones_like(change)
    aim = first + κ * reach
    doubt = demonstrated.mean * change[..., None] / 2
    doubt[..., :3] = 0
    moved = _scaled(demonstrated, κ, aim)
    doubtful = doubt[..., None].expand(*moved.loadings.shape[:-1], 1)
    loadings = torch.cat([moved.loadings, doubtful], -1)
    return replace(moved, loadings=loadings), (goal - aim)[..., None]


def recentred(demonstrated: Population, goal: Float[Tensor, " channel"]) -> Population:
    """p(θ | x) about another centre, of movements that repeat."""
    return _scaled(demonstrated, torch.ones_like(demonstrated.mean[..., 2]), goal)


def _scaled(p: Population, κ: Float[Tensor, "*sequence channel"], goal: Tensor) -> Population:
    """Weights scaled by κ, and another goal."""
    scale = κ[..., None].expand_as(p.mean).clone()
    scale[..., :2], scale[..., 2] = 1, 0
    shift = torch.zeros_like(scale)
    shift[..., 2] = goal
    return p.affine(scale, shift)
