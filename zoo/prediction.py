"""One predictive distribution for every model: a Gaussian mixture with named axes and units."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.errors import NoDensityError, NoJointSamplesError, NoSpreadError

__all__ = ["Prediction", "Predictive", "Recalibration"]

Axes = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Predictive:
    r"""What a model returns: p(y) = 1/K Σ_k N(y; location_k, noise² + epistemic²).

    ``location`` has a leading ``component`` axis (1 for a Gaussian or a deterministic model).
    ``noise`` is the aleatoric standard deviation, broadcastable to ``location``; None says that
    the model has none to give. ``epistemic`` is a further standard deviation of the mean where a
    model knows it in closed form; the spread of the components counts as epistemic too.
    ``joint`` says that each component is one joint trajectory; ``draws`` are joint draws of the
    noise-free path where the moments themselves are exact.
    """

    location: Float[Tensor, "component *shape"]
    noise: Tensor | None = None
    epistemic: Tensor | None = None
    joint: bool = False
    draws: Float[Tensor, "sample *shape"] | None = None

    def affine(self, scale: Tensor, shift: Tensor) -> Predictive:
        """The same distribution of ``scale * y + shift`` (both broadcast over the last axis)."""
        return Predictive(
            location=self.location * scale + shift,
            noise=None if self.noise is None else self.noise * scale.abs(),
            epistemic=None if self.epistemic is None else self.epistemic * scale.abs(),
            joint=self.joint,
            draws=None if self.draws is None else self.draws * scale + shift,
        )


class Recalibration(Protocol):
    """A correction of a predictive distribution, fitted on data that the model never saw."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Corrected quantile of every coordinate."""
        ...

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws of the raw marginals, moved to the corrected marginals."""
        ...

    def predictive(self, raw: Prediction) -> Predictive | None:
        """The corrected distribution where it is still a Gaussian mixture, else None."""
        ...


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """A predictive distribution over named axes, in the data's own units.

    ``axes`` is ``("sequence", "time", "channel")`` or ``("item", "target")``; ``names`` and
    ``units`` label the last axis; ``task`` says which question was answered and ``offset`` at
    which frame a forecast begins. Deterministic predictions raise
    :class:`~zoo.errors.NoSpreadError` wherever a spread is needed.
    """

    predictive: Predictive
    axes: Axes
    names: tuple[str, ...]
    units: tuple[str, ...]
    task: Literal["regress", "represent", "reconstruct", "forecast", "impute", "generate"]
    rate: float | None = None
    offset: int = 0
    lengths: Tensor | None = None
    recalibration: Recalibration | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Refuse labels that do not fit the tensor."""
        shape = tuple(self.predictive.location.shape[1:])
        if len(shape) != len(self.axes):
            raise ValueError(f"prediction has shape {shape}; axes are {self.axes}")
        if len(self.names) != shape[-1]:
            raise ValueError(f"{len(self.names)} names for {shape[-1]} {self.axes[-1]}s")

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes."""
        return tuple(self.predictive.location.shape[1:])

    @property
    def has_spread(self) -> bool:
        """Whether the model gives any uncertainty."""
        p = self.predictive
        return p.noise is not None or p.epistemic is not None or p.location.shape[0] > 1

    @property
    def effective(self) -> Predictive | None:
        """The mixture after recalibration; None where only its quantiles are known."""
        return (
            self.predictive
            if self.recalibration is None
            else self.recalibration.predictive(self.raw)
        )

    @property
    def raw(self) -> Prediction:
        """This prediction as the model gave it, without recalibration."""
        return replace(self, recalibration=None)

    @property
    def mean(self) -> Tensor:
        """Predictive mean."""
        return self.predictive.location.mean(0)

    @property
    def aleatoric(self) -> Tensor:
        """Standard deviation of the observation noise."""
        self._need_spread()
        p = self._mixture()
        if p.noise is None:
            return torch.zeros_like(self.mean)
        return p.noise.expand_as(p.location).square().mean(0).sqrt()

    @property
    def epistemic(self) -> Tensor:
        """Standard deviation of the noise-free value."""
        self._need_spread()
        p = self._mixture()
        variance = p.location.var(0, unbiased=False)
        if p.epistemic is not None:
            variance = variance + p.epistemic.square()
        return variance.sqrt()

    @property
    def std(self) -> Tensor:
        """Predictive standard deviation; of a recalibrated prediction its calibrated one."""
        self._need_spread()
        if self.effective is None:
            low, high = self.interval(math.erf(1 / math.sqrt(2)))
            return (high - low) / 2
        return (self.aleatoric.square() + self.epistemic.square()).sqrt()

    def quantile(self, level: float) -> Tensor:
        """Quantile of every coordinate's marginal, ``0 < level < 1``."""
        if not 0 < level < 1:
            raise ValueError(f"level must be between 0 and 1; got {level}")
        self._need_spread()
        if self.recalibration is not None:
            return self.recalibration.quantile(self.raw, level)
        return _mixture_quantile(self._mixture(), level)

    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Central interval that holds ``level`` of the probability."""
        return self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)

    def cdf(self, value: Tensor) -> Tensor:
        """Predictive distribution function of every coordinate at ``value``."""
        self._need_spread()
        return _mixture_cdf(self._mixture(), value)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log marginal density of every coordinate at ``value``."""
        self._need_spread()
        p = self._mixture()
        scale = _component_scale(p)
        log_density = torch.distributions.Normal(p.location, scale).log_prob(value)
        return log_density.logsumexp(0) - math.log(p.location.shape[0])

    def sample(self, count: int, *, seed: int = 0, joint: bool = True) -> Tensor:
        """``count`` draws with their noise; joint trajectories unless ``joint=False``."""
        self._need_spread()
        generator = torch.Generator(device=self.mean.device).manual_seed(seed)
        draws = self._draw(count, generator, joint)
        return (
            draws if self.recalibration is None else self.recalibration.transport(self.raw, draws)
        )

    def channel(self, name: str) -> int:
        """Index of a channel or target by name."""
        if name not in self.names:
            raise ValueError(
                f"no {self.axes[-1]} {name!r}; there are {', '.join(self.names[:8])}, …"
            )
        return self.names.index(name)

    def recalibrated(self, recalibration: Recalibration) -> Self:
        """This prediction with its spread corrected."""
        self._need_spread()
        return replace(self, recalibration=recalibration)

    def _need_spread(self) -> None:
        if not self.has_spread:
            raise NoSpreadError(f"this {self.task} prediction is deterministic: it has no spread")

    def _mixture(self) -> Predictive:
        mixture = self.effective
        if mixture is None:
            raise NoDensityError(
                f"recalibration by {type(self.recalibration).__name__} corrects quantiles only; "
                "ask for quantile, interval or sample, or recalibrate by scale"
            )
        return mixture

    def _draw(self, count: int, generator: torch.Generator, joint: bool) -> Tensor:
        p = self.predictive
        paths = p.location if p.draws is None else p.draws
        if joint and not (p.joint or p.draws is not None):
            raise NoJointSamplesError(
                "this prediction knows the marginals only; ask for sample(count, joint=False)"
            )
        if joint:
            pick = torch.randint(paths.shape[0], (count,), generator=generator, device=paths.device)
            path, scale = paths[pick], p.noise
            scale = (
                scale.expand_as(p.location)[pick if p.draws is None else [0] * count]
                if scale is not None
                else None
            )
        else:
            shape = (count, *self.shape)
            pick = torch.randint(
                p.location.shape[0], shape, generator=generator, device=paths.device
            )
            path = p.location.gather(0, pick)
            scale = _component_scale(p).expand_as(p.location).gather(0, pick)
        if scale is None:
            return path
        return path + scale * torch.randn(
            path.shape, generator=generator, dtype=path.dtype, device=path.device
        )


def _component_scale(p: Predictive) -> Tensor:
    variance = torch.zeros_like(p.location)
    for part in (p.noise, p.epistemic):
        if part is not None:
            variance = variance + part.square()
    if p.noise is None and p.epistemic is None:
        raise NoDensityError("this prediction is a set of draws without noise: it has no density")
    return variance.sqrt()


def _mixture_cdf(p: Predictive, value: Tensor) -> Tensor:
    if p.noise is None and p.epistemic is None:
        return (p.location <= value).to(p.location.dtype).mean(0)
    below: Tensor = torch.special.ndtr((value - p.location) / _component_scale(p))
    return below.mean(0)


def _mixture_quantile(p: Predictive, level: float) -> Tensor:
    if p.noise is None and p.epistemic is None:
        return p.location.quantile(level, dim=0)
    scale = _component_scale(p)
    standard = torch.special.ndtri(torch.tensor(level, dtype=scale.dtype, device=scale.device))
    ends = p.location + scale * standard
    low, high = ends.amin(0), ends.amax(0)
    if p.location.shape[0] == 1:
        return low
    return _bisect(lambda x: _mixture_cdf(p, x), level, low, high)


def _bisect(cdf: Callable[[Tensor], Tensor], level: float, low: Tensor, high: Tensor) -> Tensor:
    for _ in range(40):
        middle = (low + high) / 2
        below = cdf(middle) < level
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2
