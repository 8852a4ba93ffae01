"""What `dmp` has learned: p(θ) of a new movement, the noise, and the timings that it may have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.settings import Positive, settings
from zoo.errors import NotFittedError
from zoo.models.primitives.alignment import DIRECTIONS, TEMPOS
from zoo.models.primitives.learning import LearnedParameters, Learning
from zoo.models.primitives.movement_law import ResidualNoise
from zoo.models.primitives.movement_paths import RollOuts
from zoo.models.primitives.parameter_hypotheses import DirectHypotheses
from zoo.models.primitives.population import Population
from zoo.models.primitives.rollout import Primitive
from zoo.movement.timing import Expected, Timing
from zoo.types import Layout

__all__ = ["COMPONENTS", "Config", "LearnedDmp"]

COMPONENTS = 16


@settings
class Config:
    """Settings of :class:`~zoo.models.primitives.dmp.DMP`.

    Times are in units of the movement's duration or period.
    ``learning`` is ``path``, the conjugate posterior of w under white noise of the path; ``force``,
    that under white noise of f_target; or ``lwr``, locally weighted regression (61). ``beta`` None
    is α/4, critical damping. ``gated`` multiplies the forcing term by the phase s. ``period`` of
    rhythmic movements is in s; None finds it by autocorrelation. ``goal_scaling`` scales the
    forcing term by (g − y₁) when the goal is changed; joints whose |g − y₁| is below the share
    ``least_amplitude`` of the range of their path are scaled less: (g − y₁) says little of their
    size, as Ijspeert et al. (2013) discuss.
    """

    kind: Literal["discrete", "rhythmic"] = "discrete"
    learning: Learning = "path"
    kernels: Annotated[int, Field(ge=2)] = 20
    alpha: Positive = 25.0
    beta: Positive | None = None
    gated: bool = False
    period: Positive | None = None
    goal_scaling: bool = True
    least_amplitude: Positive = 0.5

    def __post_init__(self) -> None:
        """Refuse a gate without a phase that ends."""
        if self.gated and self.kind == "rhythmic":
            raise ValueError("gated needs a phase that ends; a rhythmic movement has none")


class LearnedDmp(nn.Module):
    """Parameters of :class:`~zoo.models.primitives.dmp.DMP`, and what is possible under them."""

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    mean: Tensor
    factors: Tensor
    private: Tensor
    noise: Tensor
    ratio: Tensor
    shares: Tensor
    information: Tensor
    scales: Tensor
    units: Tensor
    offsets: Tensor
    reached: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """A model without data: θ ~ N(0, I)."""
        super().__init__()
        self.phased = config.kind == "discrete"
        self.layout, self.config = layout, config
        beta = config.alpha / 4 if config.beta is None else config.beta
        self.primitive = Primitive(config.kind, config.kernels, config.alpha, beta, config.gated)
        channels, parameters = len(layout.channels), config.kernels + 3
        eye = torch.eye(parameters, dtype=self.dtype)
        self._keep("mean", torch.zeros(channels, parameters))
        self._keep("factors", torch.zeros(channels, parameters, 0))
        self._keep("private", eye.repeat(channels, 1, 1))
        self._keep("noise", torch.ones(channels))
        self._keep("ratio", torch.full((channels,), 1e-2))
        self._keep("information", torch.ones(()))
        self._keep("scales", torch.ones(1))
        for name in ("shares", "units", "offsets", "reached"):
            self._keep(name, torch.empty(0))

    @property
    def population(self) -> Population:
        """p(θ) of a new movement."""
        return Population(self.mean, self.factors, self.private)

    @property
    def expected(self) -> Expected:
        """Timings that a new movement may have."""
        return Expected.stored(self.config.kind, self.units, self.offsets)

    @property
    def _roll_outs(self) -> RollOuts:
        return RollOuts(self.primitive, ResidualNoise(self.noise, self.ratio))

    def _given(self, timings: Sequence[Timing]) -> DirectHypotheses:
        noise = ResidualNoise(self.noise, self.ratio)
        return DirectHypotheses(
            timings, self.scales, self.primitive, self.population, noise, float(self.information)
        )

    def _keep_learned(self, found: LearnedParameters) -> None:
        """Keep p(θ), the noise, and the durations or the period of the movements."""
        expected = Expected.of(self.config.kind, found.timings, len(TEMPOS), DIRECTIONS)
        self._keep("mean", found.population.mean)
        self._keep("factors", found.population.loadings)
        self._keep("private", found.population.private)
        self._keep("noise", found.noise.sqrt())
        self._keep("ratio", found.ratio)
        alone = torch.as_tensor(found.shrinkage.alone, dtype=self.dtype).expand(len(self.mean))
        independent = torch.full_like(alone, found.shrinkage.independent)
        self._keep("shares", torch.stack([alone, independent]))
        self._keep("information", self.mean.new_tensor(found.shrinkage.information))
        self._keep("scales", found.scales)
        self._keep("units", self.mean.new_tensor(expected.units))
        self._keep("offsets", self.mean.new_tensor(expected.offsets))

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.detach().to(self.dtype).clone())

    def _check_fitted(self) -> None:
        if not len(self.units):
            raise NotFittedError("dmp has not been trained: zoo.fit(model, train) comes first")
