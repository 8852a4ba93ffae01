"""Movements of unlike length: each its own duration τ, the longest as the unit of time."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zoo.errors import MovementLengthError
from zoo.movement.response import Response, Transformation, input_vector, transition_matrix
from zoo.types import Batch

__all__ = ["lengths_of", "moves", "pace", "stretched", "timed_paths", "windows_of"]

LIMIT = 2 * (math.sqrt(8) - 2)


@lru_cache(maxsize=256)
def pace(label: str, system: Transformation, frames: int, longest: int) -> float:
    """τ of a movement of ``frames`` frames, 1 for those of ``longest``.

    Raises MovementLengthError where Euler steps of so few frames are unstable.

    >>> pace("vae-dmp", Transformation(dt=1 / 70), 36, 71)
    0.5
    """
    found = (frames - 1) / (longest - 1)
    if not replace(system, tau=found).stable:
        least = math.ceil(1 + system.alpha / LIMIT)
        raise MovementLengthError(
            f"{label} was trained on movements of up to {longest} frames; one of {frames} is too "
            f"short for its steps: at least {least} frames are needed"
        )
    return found


def lengths_of(batch: Batch, longest: int) -> Int[Tensor, " sequence"] | None:
    """Frames of every movement of a batch; None where all have ``longest``."""
    if batch.lengths is not None:
        return batch.lengths
    count, frames = batch.movements.shape[:2]
    return None if frames == longest else batch.sequence.new_full((count,), frames)


def windows_of(batch: Batch, lengths: Int[Tensor, " sequence"]) -> Int[Tensor, " window"]:
    """Frames of the movement that each window was cut from."""
    return lengths.index_select(0, batch.sequence)


def stretched(
    values: Float[Tensor, "sequence frame feature"],
    lengths: Int[Tensor, " sequence"] | None,
    frames: int,
) -> Float[Tensor, "sequence new feature"]:
    """Every movement at ``frames`` equally spaced phases, linear between its own frames.

    ``lengths`` None: all are as long as the tensor.

    >>> ramp = torch.tensor([[[0.0], [1.0], [2.0]], [[0.0], [4.0], [99.0]]])
    >>> stretched(ramp, torch.tensor([3, 2]), 5)[..., 0]
    tensor([[0.0000, 0.5000, 1.0000, 1.5000, 2.0000],
            [0.0000, 1.0000, 2.0000, 3.0000, 4.0000]])
    """
    count, given = values.shape[:2]
    if lengths is None:
        if given == frames:
            return values
        lengths = torch.full((count,), given, device=values.device)
    at = torch.linspace(0, 1, frames, dtype=torch.float64, device=values.device)
    place = at * (lengths[:, None] - 1)
    before = place.floor().long().minimum((lengths[:, None] - 2).clamp(min=0))
    row = torch.arange(count, device=values.device)[:, None]
    after = (before + 1).clamp(max=given - 1)
    share = (place - before)[..., None].to(values)
    return torch.lerp(values[row, before], values[row, after], share)


@lru_cache(maxsize=256)
def moves(system: Transformation, latent: int) -> tuple[Tensor, Tensor]:
    """A of (76) and the input's row of (77) for row vectors (z, ż), in float64."""
    eye = torch.eye(latent, dtype=torch.float64)
    step = torch.kron(transition_matrix(system).T.contiguous(), eye)
    return step, torch.kron(input_vector(system)[None], eye)


def timed_paths(
    systems: list[Transformation],
    which: Int[Tensor, " window"],
    begin: Float[Tensor, "2 window latent"],
    force: Float[Tensor, "step window latent"],
) -> Float[Tensor, "window time latent"]:
    """z_{1:T} of every window by the linear response of its own system."""
    steps = len(force) + 1
    parts, rows = [], []
    for i, system in enumerate(systems):
        mine = (which == i).nonzero()[:, 0]
        response = Response.of(system, steps, force.dtype, force.device)
        start, push = begin[:, mine].flatten(1), force[:, mine].flatten(1)
        parts.append(response.product(start, push)[0].unflatten(1, (len(mine), -1)))
        rows.append(mine)
    found = torch.cat(parts, dim=1).transpose(0, 1)
    return found.index_select(0, torch.cat(rows).argsort())
