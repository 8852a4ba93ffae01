r"""A movement primitive as a linear-Gaussian model of a whole movement, seen in part.

With θ = (y₁, ẏ₁, g, w), white forces ε and white observation noise η::

    y = R θ + σ N ε,   x = y + σ √ρ η,   ε, η ~ N(0, I)

so that f_target ~ N(Ψw, ·) of every step, observed through x. N is the response to forces, of
unit variance in the long run; ρ, one a channel, is the share of the observation noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.dynamics.dmp import Response, Transformation, discrete_basis, phase, rhythmic_basis
from zoo.dynamics.imitation import stationary_variance, trajectory_matrix

__all__ = ["Primitive", "Sight", "Timing", "path_noise", "roll_out", "sight"]


@dataclass(frozen=True)
class Timing:
    """Frames in a movement's unit of time (its duration or its period) and the phase at frame 0."""

    unit: float
    offset: float = 0.0


@dataclass(frozen=True)
class Primitive:
    """Constants of a movement primitive whose unit of time is its duration or its period."""

    kind: Literal["discrete", "rhythmic"]
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

    def kernel_values(self, frames: int, timing: Timing, *, normalised: bool = True) -> Tensor:
        """Ψ_i of every frame, without the gate."""
        time = torch.arange(frames, dtype=torch.float64)
        if self.kind == "discrete":
            return discrete_basis(
                time, kernels=self.kernels, duration=timing.unit, normalised=normalised
            )
        return rhythmic_basis(
            time,
            kernels=self.kernels,
            period=timing.unit,
            offset=timing.offset,
            normalised=normalised,
        )

    def gate(self, frames: int, timing: Timing) -> Float[Tensor, " frame"]:
        """ξ of every frame: the phase s where the forcing term is gated, else 1."""
        time = torch.arange(frames, dtype=torch.float64)
        return phase(time, duration=timing.unit) if self.gated else torch.ones_like(time)

    def basis(self, frames: int, timing: Timing) -> Float[Tensor, "frame kernel"]:
        """ξ Ψ/ΣΨ of every frame."""
        return self.gate(frames, timing)[:, None] * self.kernel_values(frames, timing)

    @property
    def _unit(self) -> str:
        return "movement" if self.kind == "discrete" else "period"


@lru_cache(maxsize=128)
def roll_out(primitive: Primitive, frames: int, timing: Timing) -> Float[Tensor, "frame parameter"]:
    """R of ``frames`` frames."""
    response = Response.of(primitive.system(timing), frames)
    return trajectory_matrix(response, primitive.basis(frames, timing)[:-1])


@lru_cache(maxsize=128)
def path_noise(
    primitive: Primitive, frames: int, timing: Timing
) -> Float[Tensor, "frame frame_minus_1"]:
    """N of ``frames`` frames."""
    system = primitive.system(timing)
    still = torch.zeros(2, frames - 1, dtype=torch.float64)
    forces = torch.eye(frames - 1, dtype=torch.float64)
    scale = stationary_variance(system) ** 0.5
    return Response.of(system, frames).product(still, forces)[0].div(scale)


@dataclass(frozen=True)
class Sight:
    """What the seen frames of every channel say, in units of σ; unseen frames must hold 0.

    The channel axis has length 1 where all channels are seen alike.

    θ has the likelihood exp(−½ θᵀ ``precision`` θ + θᵀ ``project`` x); given θ the path is
    ``design`` θ + ``follow`` x, with variance ``variance``; ``whiten`` x is white at θ = 0.
    ``noise`` is N.
    """

    noise: Float[Tensor, "time time_minus_1"]

    precision: Float[Tensor, "*channel parameter parameter"]
    project: Float[Tensor, "*channel parameter time"]
    design: Float[Tensor, "*channel time parameter"]
    follow: Float[Tensor, "*channel time time"]
    variance: Float[Tensor, "*channel time"]
    whiten: Float[Tensor, "*channel time time"]
    log_volume: Float[Tensor, "*channel"]
    count: Float[Tensor, "*channel"]


def sight(
    design: Float[Tensor, "time parameter"],
    noise: Float[Tensor, "time time_minus_1"],
    ratio: Float[Tensor, " channel"],
    seen: Bool[Tensor, "time channel"],
) -> Sight:
    """What the seen frames of every channel say; channels seen alike are worked out once."""
    keys = torch.cat([ratio[:, None], seen.T.to(ratio)], dim=1)
    patterns, index = torch.unique(keys, dim=0, return_inverse=True)
    found = [_sight(design, noise, p[0], p[1:].bool()) for p in patterns]
    rows = slice(None) if len(found) == 1 else index
    fields = {k: torch.stack([f[k] for f in found])[rows] for k in found[0]}
    return Sight(noise=noise, **fields)


def _sight(design: Tensor, noise: Tensor, ratio: Tensor, seen: Tensor) -> dict[str, Tensor]:
    frames = len(seen)
    r, n = design[seen], noise[seen]
    eye = torch.eye(len(r), dtype=design.dtype)
    root = torch.linalg.cholesky(n @ n.T + ratio * eye)
    unroot = torch.linalg.solve_triangular(root, eye, upper=False)
    white = unroot @ r
    answer = unroot @ n @ noise.T
    follow = _spread(answer.T @ unroot, seen)
    return {
        "precision": white.T @ white,
        "project": _spread(white.T @ unroot, seen),
        "design": design - follow @ design,
        "follow": follow,
        "variance": (noise.square().sum(1) - answer.square().sum(0)).clamp_min(0),
        "whiten": torch.nn.functional.pad(_spread(unroot, seen), (0, 0, 0, frames - len(r))),
        "log_volume": root.diagonal().log().sum(),
        "count": seen.sum().to(design.dtype),
    }


def _spread(columns: Tensor, seen: Tensor) -> Tensor:
    wide = columns.new_zeros(len(columns), len(seen))
    wide[:, seen] = columns
    return wide
