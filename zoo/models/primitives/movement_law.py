"""Whole movements given their parameters and timing, the path noise integrated out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor

from zoo.models.primitives.kalman import PathNoise
from zoo.models.primitives.rollout import Primitive, roll_out
from zoo.models.primitives.sufficient_statistics import sights
from zoo.movement.components import alike
from zoo.movement.timing import Timing

__all__ = ["MovementLaw", "ResidualNoise"]


@dataclass(frozen=True)
class ResidualNoise:
    """σ and ρ of every channel."""

    std: Float[Tensor, " channel"]
    ratio: Float[Tensor, " channel"]


class MovementLaw(TorchDistribution):
    """x ~ N(R θ, σ²(N Nᵀ + ρ I)) at one of some timings, of the entries observed.

    Entries that are not observed have no density; they are drawn all the same.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        primitive: Primitive,
        timings: Sequence[Timing],
        noise: ResidualNoise,
        timing: Int[Tensor, "*batch"],
        θ: Float[Tensor, "*batch channel parameter"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> None:
        """Movements are the last batch axis."""
        self.primitive, self.timings, self.noise = primitive, timings, noise
        self.timing, self.θ, self.seen = timing.expand(θ.shape[:-2]), θ, seen
        super().__init__(θ.shape[:-2], seen.shape[1:], validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> MovementLaw:
        """The same movements along more batch axes."""
        shape = torch.Size(batch_shape)
        θ = self.θ.expand(*shape, *self.θ.shape[-2:])
        timing = self.timing.expand(shape)
        return MovementLaw(self.primitive, self.timings, self.noise, timing, θ, self.seen)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Paths with their forces and their observation noise."""
        law = self.expand((*sample_shape, *self.batch_shape))
        x = self.θ.new_empty(*law.batch_shape, *self.event_shape)
        frames, σ = self.event_shape[0], self.noise.std
        for _, index, timing in law._parts():
            mean = law._mean(index, timing)
            path = PathNoise(self.primitive.system(timing), frames).draw(1, mean)[0]
            white = self.noise.ratio.sqrt() * torch.randn_like(mean)
            x[index] = mean + σ * (path + white)
        return x

    def log_prob(self, value: Float[Tensor, "*movement time channel"]) -> Float[Tensor, "*batch"]:
        """Log density of the entries observed."""
        shape = torch.broadcast_shapes(value.shape[:-2], self.batch_shape)
        law, x = self.expand(shape), value.expand(*shape, *self.event_shape)
        density = self.θ.new_empty(shape)
        for mask, index, timing in law._parts():
            (view,) = sights(self.primitive, [timing], self.noise.ratio, mask)
            errors = view.errors((x[index] - law._mean(index, timing)) * mask)
            sums = view.sums(errors, len(x[index]), len(mask))
            density[index] = sums.log_density(self.noise.std.square())
        return density

    def _mean(self, index: tuple[Tensor, ...], timing: Timing) -> Tensor:
        design = roll_out(self.primitive, self.event_shape[0], timing)
        mean: Tensor = self.θ[index] @ design.mT
        return mean.mT

    def _parts(self) -> Iterator[tuple[Tensor, tuple[Tensor, ...], Timing]]:
        """Movements with the same entries and one timing, as an index of the batch."""
        for rows, mask in alike(self.seen):
            chosen = self.timing[..., rows]
            for i in chosen.unique().tolist():
                *lead, which = (chosen == i).nonzero(as_tuple=True)
                yield mask, (*lead, rows[which]), self.timings[i]
