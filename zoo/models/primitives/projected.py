"""Whole movements whose channels show components with a movement primitive each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor

from zoo.models.primitives.kalman import PathNoise
from zoo.models.primitives.movement_law import ResidualNoise
from zoo.models.primitives.parameter_hypotheses import ParameterHypotheses, Summed
from zoo.models.primitives.population import Population
from zoo.models.primitives.projection import ComponentPaths, GivenEntries, Projection, joined
from zoo.models.primitives.rollout import Primitive, roll_out
from zoo.movement.components import alike
from zoo.movement.timing import Timing

__all__ = ["ProjectedHypotheses", "ProjectedLaw"]


class ProjectedLaw(TorchDistribution):
    """x_t ~ N(W z_t + μ, σ²I) with z ~ N(R θ, Σ) integrated out, of the entries observed.

    Entries that are not observed have no density; they are drawn all the same.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        projection: Projection,
        primitive: Primitive,
        timing: Timing,
        θ: Float[Tensor, "*batch latent parameter"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> None:
        """Movements are the last batch axis."""
        self.projection, self.primitive, self.timing = projection, primitive, timing
        self.θ, self.seen = θ, seen
        super().__init__(θ.shape[:-2], seen.shape[1:], validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> ProjectedLaw:
        """The same movements along more batch axes."""
        θ = self.θ.expand(*batch_shape, *self.θ.shape[-2:])
        return ProjectedLaw(self.projection, self.primitive, self.timing, θ, self.seen)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Components with their noise, and the channels with theirs."""
        mean = self._path.expand(*sample_shape, *self._path.shape)
        noise = PathNoise(self.primitive.system(self.timing), self.event_shape[0])
        z = mean + self.projection.draw(noise, 1, mean.flatten(0, -3)).reshape(mean.shape)
        x = self.projection.shown(z)
        return x + self.projection.noise * torch.randn_like(x)

    def log_prob(self, value: Float[Tensor, "*movement time channel"]) -> Float[Tensor, "*batch"]:
        """Log density of the entries observed."""
        residual = value - self.projection.shown(self._path)
        density = residual.new_empty(residual.shape[:-2])
        for rows, mask in alike(self.seen):
            view = _view(self.projection, self.primitive, self.timing, mask)
            sums = view.sums((residual[..., rows, :, :] * mask).flatten(0, -3))
            one = residual.new_ones(view.blocks)
            density[..., rows] = sums.log_density(one).view(density[..., rows].shape)
        return density

    @property
    def _path(self) -> Float[Tensor, "*batch time latent"]:
        path: Tensor = self.θ @ roll_out(self.primitive, self.event_shape[0], self.timing).mT
        return path.mT


@dataclass(frozen=True)
class ProjectedHypotheses(ParameterHypotheses[Summed]):
    """Timings and scales of movements seen through W, by so many blocks of components."""

    projection: Projection
    blocks: int

    @classmethod
    def of(
        cls,
        projection: Projection,
        primitive: Primitive,
        population: Population,
        information: float,
        timings: Sequence[Timing],
        scales: Float[Tensor, " scale"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> ProjectedHypotheses:
        """Blocks that the entries ``seen`` of all movements fall into."""
        blocks, one = projection.blocks(seen), torch.ones_like(projection.force)
        noise = ResidualNoise(one[:blocks], one[:blocks])
        parts = population if blocks > 1 else joined(population)
        return cls(timings, scales, primitive, parts, noise, information, projection, blocks)

    def observed_alike(
        self,
        values: Float[Tensor, "sequence time channel"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> Iterator[Summed]:
        """What the movements say of θ."""
        for part, _ in self._viewed(values, seen):
            yield part

    def latent(
        self, values: Tensor, seen: Tensor, count: int, *, fresh: bool = False
    ) -> Iterator[tuple[Int[Tensor, " some"], Tensor, ComponentPaths]]:
        """Rows, which of ``count`` components they are, and z given x; ``fresh`` only has θ so."""
        for part, views in self._viewed(values, seen):
            for timing, scale, some, which in self.picked(part, count):
                posterior = self.posterior(part, timing, scale, some)
                view, x = views[timing], part.x[some]
                if fresh:
                    view, x = self._view(self.timings[timing], view.seen & False), x * 0
                yield part.rows[some], which, view.paths(x, posterior)

    def _viewed(self, values: Tensor, seen: Tensor) -> Iterator[tuple[Summed, list[GivenEntries]]]:
        for rows, mask in alike(seen):
            x = (values[rows] - self.projection.mean) * mask
            views = [self._view(timing, mask) for timing in self.timings]
            yield Summed(rows, x, [view.sums(x) for view in views]), views

    def _view(self, timing: Timing, seen: Tensor) -> GivenEntries:
        return _view(self.projection, self.primitive, timing, seen, self.blocks)


def _view(
    projection: Projection,
    primitive: Primitive,
    timing: Timing,
    seen: Tensor,
    blocks: int | None = None,
) -> GivenEntries:
    noise = PathNoise(primitive.system(timing), len(seen))
    design = roll_out(primitive, len(seen), timing)
    return GivenEntries(projection, noise, design, seen, blocks or projection.blocks(seen))
