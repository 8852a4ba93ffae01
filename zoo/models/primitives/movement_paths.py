"""Gaussian paths of primitives: rolled out anew, in sums, or given what was observed of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.models.primitives.kalman import PathNoise
from zoo.models.primitives.movement_law import ResidualNoise
from zoo.models.primitives.parameter_hypotheses import AtTiming
from zoo.models.primitives.population import Population
from zoo.models.primitives.rollout import Primitive, roll_out
from zoo.movement.components import Draw, Paths
from zoo.movement.forcing import trajectory_matrix
from zoo.movement.response import Response
from zoo.movement.timing import Timing

__all__ = ["RollOuts", "Term"]

Term = tuple[Tensor, Population]


@dataclass(frozen=True)
class RollOuts:
    """Paths y = Σ R θ + σ N ε of a primitive, θ Gaussian in every term."""

    primitive: Primitive
    noise: ResidualNoise

    def anew(self, at: AtTiming, frames: int) -> Paths:
        """p(θ | x) rolled out over ``frames`` frames, with new forces."""
        design = roll_out(self.primitive, frames, at.timing)
        return self.summed([(design, at.population)], at.timing)

    def summed(self, terms: Sequence[Term], timing: Timing) -> Paths:
        """Sum of design θ over ``terms``, with new forces."""
        mean, variance, draw = _sum(terms)
        noise, σ = self._noise(len(terms[0][0]), timing), self.noise.std
        forces = noise.variance[:, None] * σ.square()
        return Paths(mean, variance + forces, lambda n: draw(n) + σ * noise.draw(n, mean))

    def followed(self, at: AtTiming) -> Paths:
        """The paths given the entries observed; draws by Matheron."""
        view, σ, root = at.sight, self.noise.std, self.noise.ratio.sqrt()
        noise, seen = self._noise(at.x.shape[1], at.timing), view.smoother.seen.mT

        def residual(count: int) -> Tensor:
            force = noise.draw(count, at.x)
            pseudo = (force + root * torch.randn_like(force)) * seen
            return view.follow(at.x) + σ * (force - view.follow(pseudo))

        mean, variance, draw = _sum([(view.given, at.population)])
        left = view.smoother.variance.mT * σ.square()
        return Paths(mean + view.follow(at.x), variance + left, lambda n: draw(n) + residual(n))

    def part(
        self, timing: Timing, share: Float[Tensor, " step"], *, begin: bool
    ) -> Float[Tensor, "frame parameter"]:
        """R of a movement whose goal and weights count their ``share`` at every step, (89)."""
        frames = len(share) + 1
        response = Response.of(self.primitive.system(timing), frames)
        basis = self.primitive.basis(frames, timing)[:-1]
        return trajectory_matrix(response, basis, weight=share, begin=begin)

    def _noise(self, frames: int, timing: Timing) -> PathNoise:
        return PathNoise(self.primitive.system(timing), frames)


def _sum(terms: Sequence[Term]) -> tuple[Tensor, Tensor, Draw]:
    """Mean and variance of the sum of design θ over ``terms``, and its draws."""
    moments = [population.moments(design) for design, population in terms]

    def draw(count: int) -> Tensor:
        parts = [(d @ p.sample(count)[..., None])[..., 0].mT for d, p in terms]
        return torch.stack(parts).sum(0)

    mean, variance = (reduce(torch.add, m) for m in zip(*moments, strict=True))
    return mean, variance, draw
