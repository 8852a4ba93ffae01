"""Conjugate regression of many movements with their variances by evidence maximisation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

FLOOR = 1e-8
GRID = 121
ENTRIES = 2**18

__all__ = ["FLOOR", "ConjugateWeights", "conjugate_weights"]


@dataclass(frozen=True)
class ConjugateWeights:
    """Posterior w_ic ~ N(mean, noise · covariance), with the σ² ``noise`` of every channel."""

    mean: Float[Tensor, "sequence channel kernel"]
    covariance: Float[Tensor, "#sequence channel kernel kernel"]
    noise: Float[Tensor, " channel"]


def conjugate_weights(
    precision: Float[Tensor, "#sequence #channel kernel kernel"],
    linear: Float[Tensor, "sequence channel kernel"],
    square: Float[Tensor, "sequence channel"],
    count: Float[Tensor, "sequence #channel"],
) -> ConjugateWeights:
    """Posterior of the weights of every movement; noise and prior are shared by all movements.

    With white residuals r = x̃ − Φw, w ~ N(0, τ²I), ``precision`` is ΦᵀΦ, ``linear`` Φᵀx̃ and
    ``square`` x̃ᵀx̃. For every λ = σ²/τ² the best σ² is Σ(‖r‖² + λ‖w‖²)/Σn; λ has the highest
    evidence on a fine grid, of every channel. σ² stays above 1e-8.
    """
    values, vectors = torch.linalg.eigh(precision)
    s = values.clamp_min(0)
    β = (vectors.mT @ linear[..., None])[..., 0]
    total = count.sum(0).clamp_min(1)
    grid = torch.logspace(-9, 3, GRID, dtype=s.dtype, device=s.device) * s.mean()
    energy = β.square().sum(0, keepdim=True) if len(s) == 1 else β.square()
    some = grid.split(max(1, ENTRIES // s.numel()))
    scores = [_profile(s, energy, square.sum(0), len(β), total, λ) for λ in some]
    λ = grid[torch.cat(scores, -1).argmax(-1)]
    shrunk = s + λ[:, None]
    energy = (square - (β.square() / shrunk).sum(-1)).clamp_min(0)
    return ConjugateWeights(
        mean=(vectors @ (β / shrunk)[..., None])[..., 0],
        covariance=(vectors / shrunk[..., None, :]) @ vectors.mT,
        noise=(energy.sum(0) / total).clamp_min(FLOOR),
    )


def _profile(
    s: Tensor,
    explained: Tensor,
    square: Tensor,
    sequences: int,
    total: Tensor,
    λ: Float[Tensor, " grid"],
) -> Float[Tensor, "channel grid"]:
    """Log evidence of every channel at every λ with the best σ², up to a constant."""
    shrunk = s[..., None] + λ
    energy = square[:, None] - torch.einsum("sck,sckg->cg", explained, 1 / shrunk)
    volume = (shrunk / λ).log().sum((0, -2)) / 2 * (sequences / len(s))
    best = (energy / total[:, None]).clamp_min(FLOOR)
    return -total[:, None] / 2 * best.log() - volume
