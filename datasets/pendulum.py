"""A simulated pendulum under a random policy, observed as states or as blurred images (§4.3.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor

from zoo.datasets.records import Sequences

__all__ = ["Pendulum", "load", "load_images", "render"]

PIXELS = 20
VIEW = 1.2
SUBSTEPS = 10


@dataclass(frozen=True, kw_only=True)
class Pendulum:
    r"""m l² θ̈ = m g l sin θ − k θ̇ + a, a point mass on a rod; θ = 0 is upright, in rad.

    ``length`` in m, ``mass`` in kg, ``friction`` k in N m s, ``torque`` the largest |a| in N m,
    ``noise`` the standard deviation of the disturbance added to a, ``step`` in s. A point mass
    needs m g l = 49 N m to be held level, so that 30 N m cannot swing it up directly.
    """

    length: float = 0.5
    mass: float = 10.0
    friction: float = 0.25
    torque: float = 30.0
    noise: float = 4.5
    step: float = 0.05
    gravity: float = 9.81

    @property
    def inertia(self) -> float:
        """m l² in kg m²."""
        return self.mass * self.length**2

    def energy(self, state: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Kinetic and potential energy in J, 0 at rest at the height of the pivot."""
        theta, omega = state.unbind(-1)
        height = self.length * theta.cos()
        return self.inertia * omega**2 / 2 + self.mass * self.gravity * height

    def advance(
        self, state: Float[Tensor, "*batch 2"], torque: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 2"]:
        """The state (θ in rad, θ̇ in rad/s) one step later under a constant ``torque`` in N m.

        >>> hanging = torch.tensor([math.pi, 0.0], dtype=torch.float64)
        >>> bool(torch.allclose(Pendulum().advance(hanging, torch.tensor(0.0)), hanging))
        True
        """
        h = self.step / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = self._rate(state, torque)
            k2 = self._rate(state + h / 2 * k1, torque)
            k3 = self._rate(state + h / 2 * k2, torque)
            k4 = self._rate(state + h * k3, torque)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return state

    def _rate(self, state: Tensor, torque: Tensor) -> Tensor:
        theta, omega = state.unbind(-1)
        turning = self.mass * self.gravity * self.length * theta.sin()
        return torch.stack([omega, (turning - self.friction * omega + torque) / self.inertia], -1)


def load(*, rollouts: int = 30, seed: int = 0) -> Sequences:
    """Roll-outs of an exploratory policy: states (θ, θ̇) in rad and rad/s at 20 Hz, torque in N m.

    Each starts hanging (θ = π ± 0.1 rad, at rest) and ends after every step with probability
    0.02. The policy holds a torque drawn uniformly from ±30 N m and draws anew with probability
    0.2 a step; ``controls`` are these commanded torques, before the disturbance of 4.5 N m.
    θ runs on through full turns; it is not wrapped.

    >>> data = load(rollouts=3)
    >>> len(data), data.channels, data.control_names
    (3, ('angle', 'velocity'), ('torque',))
    """
    states, torques = _roll_out(Pendulum(), rollouts, np.random.default_rng(seed))
    return _record(states, torques, ("angle", "velocity"), ("rad", "rad/s"), "pendulum")


def load_images(*, rollouts: int = 30, seed: int = 0) -> Sequences:
    """The roll-outs of :func:`load` as 20×20 images and their differences: 800 features a frame.

    Pixels row by row of the image, then of its difference to the previous image (0 in the first
    frame: the pendulum starts at rest). Brightness has no unit; see :func:`render`.

    >>> data = load_images(rollouts=2)
    >>> data.values.shape[2], data.channels[0], data.channels[400]
    (800, 'image_00_00', 'difference_00_00')
    """
    states, torques = _roll_out(Pendulum(), rollouts, np.random.default_rng(seed))
    names = tuple(
        f"{what}_{row:02d}_{column:02d}"
        for what in ("image", "difference")
        for row in range(PIXELS)
        for column in range(PIXELS)
    )
    frames = [_features(state[:, 0]) for state in states]
    return _record(frames, torques, names, ("",) * len(names), "pendulum/images")


def render(
    theta: Float[Tensor, "*batch"], *, length: float = 0.5, view: float = VIEW, blur: float = 0.2
) -> Float[Tensor, "*batch row column"]:
    """Images of the rod at angle ``theta`` (rad), blurred by a Gaussian of sd ``blur`` × width.

    The blurred line is the exact convolution of a segment with the Gaussian, so that there is no
    resolution to choose: N(v; 0, σ²)·(Φ((l−u)/σ) − Φ(−u/σ)) at u along and v across the rod. The
    field of view is ``view`` m wide around the pivot; brightness 1 is an endless rod's centre.

    >>> image = render(torch.tensor(0.0))
    >>> image.shape, bool(image[:10].sum() > image[10:].sum())
    (torch.Size([20, 20]), True)
    """
    sigma = blur * view
    axis = (torch.arange(PIXELS, dtype=theta.dtype) + 0.5) / PIXELS * view - view / 2
    x, y = axis[None, :], -axis[:, None]
    s, c = theta.sin()[..., None, None], theta.cos()[..., None, None]
    u, v = x * s + y * c, x * c - y * s
    ndtr = torch.special.ndtr
    along: Tensor = ndtr((length - u) / sigma) - ndtr(-u / sigma)
    return along * torch.exp(-0.5 * (v / sigma) ** 2)


def _record(
    frames: list[Tensor],
    torques: list[Tensor],
    channels: tuple[str, ...],
    units: tuple[str, ...],
    name: str,
) -> Sequences:
    return Sequences.from_arrays(
        [f.numpy() for f in frames],
        rate=1 / Pendulum().step,
        channels=channels,
        units=units,
        groups={"rollout": [f"rollout_{i:03d}" for i in range(len(frames))]},
        controls=[a.numpy() for a in torques],
        control_names=("torque",),
        control_units="N m",
        name=name,
        provenance="simulated",
    )


def _features(theta: Float[Tensor, " time"]) -> Float[Tensor, "time feature"]:
    image = render(theta).flatten(1)
    difference = torch.diff(image, dim=0, prepend=image[:1])
    return torch.cat([image, difference], 1)


def _roll_out(
    pendulum: Pendulum, rollouts: int, rng: Generator
) -> tuple[list[Tensor], list[Tensor]]:
    if rollouts < 1:
        raise ValueError(f"rollouts must be at least 1; got {rollouts}")
    lengths = 1 + rng.geometric(0.02, rollouts)
    commanded = _explore(pendulum, rng, rollouts, int(lengths.max()))
    applied = commanded + pendulum.noise * torch.from_numpy(rng.normal(size=commanded.shape))
    state = torch.zeros(rollouts, 2, dtype=torch.float64)
    state[:, 0] = math.pi + 0.1 * torch.from_numpy(rng.normal(size=rollouts))
    states = [state]
    for t in range(commanded.shape[1] - 1):
        states.append(pendulum.advance(states[-1], applied[:, t]))
    path = torch.stack(states, 1)
    kept = [(path[i, :n], commanded[i, :n, None]) for i, n in enumerate(lengths)]
    return [p for p, _ in kept], [a for _, a in kept]


def _explore(pendulum: Pendulum, rng: Generator, rollouts: int, frames: int) -> Tensor:
    drawn = rng.uniform(-pendulum.torque, pendulum.torque, (rollouts, frames))
    anew = rng.random((rollouts, frames)) < 0.2
    anew[:, 0] = True
    last = np.maximum.accumulate(np.where(anew, np.arange(frames), 0), axis=1)
    return torch.from_numpy(np.take_along_axis(drawn, last, axis=1))
