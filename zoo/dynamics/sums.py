"""Sufficient statistics of demonstrations under the linear-Gaussian model of a movement."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.dynamics.rollout import Primitive, Timing, path_noise, roll_out, sight

__all__ = ["Movements", "Sums", "of_weights", "square_after", "sums_of", "uniform"]

Movements = list[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of every demonstration in units of σ; see :class:`Sight`."""

    precision: Float[Tensor, "sequence #channel parameter parameter"]
    linear: Float[Tensor, "sequence channel parameter"]
    square: Float[Tensor, "sequence channel"]
    count: Float[Tensor, "sequence #channel"]
    log_volume: Float[Tensor, "sequence #channel"]


def uniform(ratio: float, movements: Movements) -> Float[Tensor, " channel"]:
    """One noise ratio for every channel."""
    return torch.full((movements[0][0].shape[1],), ratio, dtype=torch.float64)


def sums_of(
    primitive: Primitive,
    ratio: Tensor,
    movements: Movements,
    timings: list[Timing],
) -> Sums:
    """Sums of every movement, stacked over movements."""
    parts = [
        _sum(primitive, ratio, x, seen, t) for (x, seen), t in zip(movements, timings, strict=True)
    ]
    channels = max(p[0].shape[0] for p in parts)
    wide = [[a.expand(max(channels, len(a)), *a.shape[1:]) for a in p] for p in parts]
    return Sums(*(torch.stack(column) for column in zip(*wide, strict=True)))


def _sum(
    primitive: Primitive, ratio: Tensor, x: Tensor, seen: Tensor, timing: Timing
) -> tuple[Tensor, ...]:
    design, noise = roll_out(primitive, len(x), timing), path_noise(primitive, len(x), timing)
    view = sight(design, noise, ratio, seen)
    known = (x * seen).T[..., None]
    square = (view.whiten @ known).square().sum((-1, -2))
    return view.precision, (view.project @ known)[..., 0], square, view.count, view.log_volume


def of_weights(sums: Sums, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Precision and linear term of w, given the anchors."""
    cross = sums.precision[..., 3:, :3] @ starts[..., None]
    return sums.precision[..., 3:, 3:], sums.linear[..., 3:] - cross[..., 0]


def square_after(sums: Sums, θ: Tensor) -> Tensor:
    """‖whitened x − R θ‖² of the leading parameters θ."""
    count = θ.shape[-1]
    curve = (θ * (sums.precision[..., :count, :count] @ θ[..., None])[..., 0]).sum(-1)
    return (sums.square - 2 * (θ * sums.linear[..., :count]).sum(-1) + curve).clamp_min(0)
