r"""A movement primitive as a linear-Gaussian model of a whole movement.

With θ = (y₁, ẏ₁, g, w), white forces ε and white observation noise η::

    y = R θ + σ N ε,   x = y + σ √ρ η,   ε, η ~ N(0, I)

so that f_target ~ N(Ψw, ·) of every step, observed through x. N is the response to forces, of
unit variance in the long run; ρ, one a channel, is the share of the observation noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.movement.forcing import trajectory_matrix
from zoo.movement.response import Response, Transformation, discrete_basis, phase, rhythmic_basis
from zoo.movement.timing import Kind, Timing

__all__ = ["Primitive", "kernel_values", "roll_out"]


def kernel_values(
    kind: Kind, kernels: int, frames: int, timing: Timing, *, normalised: bool = True
) -> Float[Tensor, "frame kernel"]:
    """Ψ_i/ΣΨ of every frame, or Ψ_i."""
    time = torch.arange(frames, dtype=torch.float64)
    if kind == "discrete":
        return discrete_basis(time, kernels=kernels, duration=timing.unit, normalised=normalised)
    unit, at = timing.unit, timing.offset
    return rhythmic_basis(time, kernels=kernels, period=unit, offset=at, normalised=normalised)


@dataclass(frozen=True)
class Primitive:
    """Constants of a movement primitive whose unit of time is its duration or its period."""

    kind: Kind
    kernels: int
    alpha: float
    beta: float
    gated: bool

    def system(self, timing: Timing) -> Transformation:
        """Transformation system with one step a frame; too few frames are refused."""
        system = Transformation(self.alpha, self.beta, 1.0, 1 / timing.unit)
        if not system.stable:
            raise ValueError(
                f"{timing.unit:g} frames in a {self._unit} are too few for stable steps at "
                f"alpha={self.alpha:g}: resample the movements to more frames or lower alpha"
            )
        return system

    def gate(self, frames: int, timing: Timing) -> Float[Tensor, " frame"]:
        """ξ of every frame: the phase s where the forcing term is gated, else 1."""
        time = torch.arange(frames, dtype=torch.float64)
        return phase(time, duration=timing.unit) if self.gated else torch.ones_like(time)

    def basis(self, frames: int, timing: Timing) -> Float[Tensor, "frame kernel"]:
        """ξ Ψ/ΣΨ of every frame."""
        return self.gate(frames, timing)[:, None] * kernel_values(
            self.kind, self.kernels, frames, timing
        )

    @property
    def _unit(self) -> str:
        return "movement" if self.kind == "discrete" else "period"


@lru_cache(maxsize=128)
def roll_out(primitive: Primitive, frames: int, timing: Timing) -> Float[Tensor, "frame parameter"]:
    """R of ``frames`` frames."""
    response = Response.of(primitive.system(timing), frames)
    return trajectory_matrix(response, primitive.basis(frames, timing)[:-1])
