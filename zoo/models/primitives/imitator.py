"""Movement primitives of one length in a latent space, regressed on whole paths at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from zoo.movement.forcing import target_force, trajectory_matrix
from zoo.movement.paths import PathPrior
from zoo.movement.response import Response, Transformation, critical_system, discrete_basis

__all__ = ["GOAL", "Imitator"]

GOAL, WEIGHTS = 2, 3
SCALES = (1.0, 10.0, 1.0, 3.0)
RIDGE, FLOOR = 1e-4, 1e-3


@dataclass(frozen=True)
class Imitator:
    """A critically damped DMP of movements of ``frames`` frames: y = R θ, θ = (y₁, ẏ₁, g, w).

    θ is in units of the prior N(0, I): latent positions for y₁ and g, 10 movement lengths for ẏ₁,
    and 3 for w, whose forces are in units of αβ. None for α is 25 a movement, or 0.4 a frame for
    movements under 64 frames, whose Euler steps are unstable otherwise. Movements that last unlike
    long share θ and α: time counts in durations, so that the τ of each is its number of frames.

    >>> imitator = Imitator(frames=70, kernels=20)
    >>> path = torch.linspace(0, 1, 70)[:, None].sin()
    >>> bool((imitator.roll_out(imitator.fit(path)) - path).abs().max() < 1e-2)
    True
    """

    frames: int
    kernels: int = 20
    alpha: float | None = None

    def __post_init__(self) -> None:
        """Refuse constants whose Euler steps are no attractor."""
        _ = self.system

    @property
    def system(self) -> Transformation:
        """The transformation system, a movement long in its unit of time; β = α/4."""
        return critical_system(self.alpha, self.frames)

    def design(
        self,
        length: int | None = None,
        *,
        duration: float = 1.0,
        weight: Float[Tensor, " time_minus_1"] | None = None,
        begin: bool = True,
    ) -> Float[Tensor, "time parameter"]:
        """R of ``length`` frames of a movement ``duration`` times as long, in float64.

        ``weight`` is the share of goal and forces at every step, (89); without ``begin`` the first
        state does not count.
        """
        steps = self.frames if length is None else length
        response = Response.of(replace(self.system, tau=duration), steps)
        basis = self.system.stiffness * SCALES[3] * self.kernels_at(steps - 1, duration)
        matrix = trajectory_matrix(response, basis, weight=weight, begin=begin)
        matrix[:, 1] *= SCALES[1] / duration
        return matrix

    def kernels_at(self, steps: int, duration: float = 1.0) -> Float[Tensor, "step kernel"]:
        """Ψ/ΣΨ of the first ``steps`` steps."""
        time = torch.arange(steps, dtype=torch.float64)
        whole = (self.frames - 1) * duration
        return discrete_basis(time, kernels=self.kernels, duration=whole)

    def lasting(self, frames: int) -> Imitator:
        """The same primitive, with the same α, for movements of ``frames`` frames."""
        if frames == self.frames:
            return self
        return Imitator(frames, self.kernels, self.system.alpha)

    def share(self, longest: int) -> float:
        """τ beside movements of ``longest`` frames."""
        return (self.frames - 1) / (longest - 1)

    def fits(
        self,
        path: Float[Tensor, "window time latent"],
        seen: Bool[Tensor, "window time"] | None,
        lengths: Int[Tensor, " window"] | None,
    ) -> Float[Tensor, "window parameter latent"]:
        """θ of movements that last unlike long, padded to the longest; None: all are whole."""
        if lengths is None:
            return self.fit(path, seen)
        parts = [
            own.fit(path[rows, : own.frames], _observed(seen, rows, own.frames))
            for own, rows in self._alike(lengths)
        ]
        return _ordered(parts, lengths)

    def roll_outs(
        self,
        theta: Float[Tensor, "*sample window parameter latent"],
        lengths: Int[Tensor, " window"] | None,
        time: int,
    ) -> Float[Tensor, "*sample window time latent"]:
        """y = R θ of every movement, 0 after its end up to ``time`` frames."""
        if lengths is None:
            return self.roll_out(theta)
        parts = [
            pad(own.roll_out(theta[..., rows, :, :]), (0, 0, 0, time - own.frames))
            for own, rows in self._alike(lengths)
        ]
        return _ordered(parts, lengths)

    def all_forces(
        self,
        path: Float[Tensor, "*sample window time latent"],
        theta: Float[Tensor, "*sample window parameter latent"],
        lengths: Int[Tensor, " window"] | None,
    ) -> tuple[
        Float[Tensor, "*sample window step latent"], Float[Tensor, "*sample window step latent"]
    ]:
        """:meth:`forces` of every movement, 0 after its end."""
        if lengths is None:
            return self.forces(path, theta)
        time = path.shape[-2]
        parts = [
            pad(torch.stack(own.forces(y[..., : own.frames, :], θ)), (0, 0, 0, time - own.frames))
            for own, rows in self._alike(lengths)
            for y, θ in [(path[..., rows, :, :], theta[..., rows, :, :])]
        ]
        force, target = _ordered(parts, lengths)
        return force, target

    def _alike(self, lengths: Int[Tensor, " window"]) -> Iterator[tuple[Imitator, Tensor]]:
        """The primitive of every length, with the movements that have it."""
        for n in lengths.unique().tolist():
            yield self.lasting(n), (lengths == n).nonzero()[:, 0]

    def fit(
        self,
        path: Float[Tensor, "*batch time latent"],
        seen: Bool[Tensor, "*batch time"] | None = None,
    ) -> Float[Tensor, "*batch parameter latent"]:
        """θ of the roll-outs nearest to ``path`` where it was observed, by ridge regression."""
        if seen is None:
            return _gain(self).to(path) @ path
        design, weight = self.design().to(path.device), seen.double()[..., None]
        gram = design.mT @ (weight * design) + RIDGE * _eye(design)
        theta: Tensor = torch.linalg.solve(gram, design.mT @ (weight * path.double()))
        return theta.to(path)

    def roll_out(
        self, theta: Float[Tensor, "*batch parameter latent"]
    ) -> Float[Tensor, "*batch time latent"]:
        """y = R θ."""
        return _design(self).to(theta) @ theta

    def forces(
        self,
        path: Float[Tensor, "*batch time latent"],
        theta: Float[Tensor, "*batch parameter latent"],
    ) -> tuple[Float[Tensor, "*batch step latent"], Float[Tensor, "*batch step latent"]]:
        """f of θ and f_target of ``path`` (59), of every step, in units of αβ."""
        force = _forcing(self).to(theta) @ theta[..., WEIGHTS:, :]
        _, target = target_force(path, theta[..., GOAL, :], self.system)
        return force, target / self.system.stiffness

    def aimed(
        self,
        theta: Float[Tensor, "*batch parameter latent"],
        goal: Float[Tensor, "*batch latent"],
    ) -> Float[Tensor, "*batch parameter latent"]:
        """The goal attractor moved so that the path ends at ``goal``; forces stay, §5.3.6.

        >>> imitator = Imitator(frames=70, kernels=20)
        >>> θ = imitator.aimed(torch.randn(23, 2), torch.tensor([1.0, -2.0]))
        >>> imitator.roll_out(θ)[-1].round(decimals=4)
        tensor([ 1., -2.])
        """
        end = _design(self)[-1].to(theta)
        moved = theta.clone()
        moved[..., GOAL, :] += (goal - end @ theta) / end[GOAL]
        return moved

    def prior(
        self,
        theta: Float[Tensor, "movement parameter latent"],
        residuals: Float[Tensor, "movement time latent"],
        length: int,
        shape: Sequence[float],
    ) -> PathPrior:
        """The mixture over paths of ``length`` frames around the roll-outs of known movements.

        ``residuals`` are what the roll-outs leave of whole movements; ``shape`` is h, λ and ν where
        these are known.
        """
        one = len(theta) == 1
        size = theta.square().mean((0, 1)).expand_as(theta[0]) if one else theta.var(0)
        return PathPrior.of_responses(
            self.design(length).to(theta.device),
            theta,
            size,
            pad(residuals, (0, 0, 0, length - self.frames)),
            FLOOR**2 * torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device),
            shape,
        )


def _observed(seen: Tensor | None, rows: Tensor, frames: int) -> Tensor | None:
    """Which frames were seen; None where all were."""
    some = None if seen is None else seen[rows, :frames]
    return None if some is None or bool(some.all()) else some


def _ordered(parts: list[Tensor], lengths: Int[Tensor, " window"]) -> Tensor:
    """Parts of each length in turn, in the order of the movements."""
    found = torch.cat(parts, dim=-3)
    return found.index_select(found.ndim - 3, lengths.argsort(stable=True).argsort())


@lru_cache(maxsize=256)
def _design(imitator: Imitator) -> Tensor:
    return imitator.design()


@lru_cache(maxsize=256)
def _forcing(imitator: Imitator) -> Tensor:
    return SCALES[3] * imitator.kernels_at(imitator.frames - 1)


@lru_cache(maxsize=256)
def _gain(imitator: Imitator) -> Tensor:
    design = imitator.design()
    gain: Tensor = torch.linalg.solve(design.mT @ design + RIDGE * _eye(design), design.mT)
    return gain


def _eye(design: Tensor) -> Tensor:
    return torch.eye(design.shape[-1], dtype=design.dtype, device=design.device)
