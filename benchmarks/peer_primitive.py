"""The conventions of the package movement-primitives, where they differ from the zoo's own."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.movement.response import Transformation, phase

__all__ = ["central_target_force", "design", "imitated"]

OVERLAP = 1 / math.sqrt(-2 * math.log(0.8))


def design(kernels: int, frames: int) -> Float[Tensor, "frame kernel"]:
    """s Ψ/ΣΨ of every frame, kernels as wide as meet their neighbours at 0.8."""
    ends = torch.linspace(0, frames - 1, kernels, dtype=torch.float64)
    centre = phase(ends, duration=frames - 1)
    gap = centre[:-1] - centre[1:]
    s = phase(torch.arange(frames, dtype=torch.float64), duration=frames - 1)[:, None]
    ψ = torch.exp(-((s - centre) / (OVERLAP * torch.cat([gap, gap[-1:]]))).square() / 2)
    return s * ψ / ψ.sum(1, keepdim=True)


def central_target_force(
    position: Float[Tensor, "time channel"], system: Transformation
) -> Float[Tensor, "time channel"]:
    """The force (59) of every frame by central differences; the movement ends at rest."""
    velocity = torch.gradient(position, spacing=system.dt, dim=0)[0]
    velocity[-1] = 0
    acceleration = torch.gradient(velocity, spacing=system.dt, dim=0)[0]
    acceleration[-1] = 0
    spring = system.stiffness * (position[-1] - position)
    return system.tau**2 * acceleration - spring + system.alpha * system.tau * velocity


def imitated(
    position: Float[Tensor, "time channel"], kernels: int, system: Transformation
) -> Float[Tensor, "kernel channel"]:
    """Least-squares weights of a movement, all kernels at once (63)."""
    Ψ = design(kernels, len(position))
    return torch.linalg.lstsq(Ψ, central_target_force(position, system)).solution
