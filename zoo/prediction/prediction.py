"""One predictive distribution for every model: a Gaussian mixture with named axes and units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, Literal, Protocol, Self

import torch
from torch import Tensor

from zoo.arguments import level_of, seed_of, whole_number
from zoo.display import facts
from zoo.errors import NoDensityError, NoJointSamplesError, NoSpreadError
from zoo.prediction import handing, mixtures
from zoo.prediction.drawing import marginals, picks, rows_among, tensor_of, with_noise
from zoo.prediction.predictive import Predictive

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes as Panel
    from matplotlib.figure import Figure

__all__ = ["Prediction", "Recalibration"]

Axes = tuple[str, ...]


class Recalibration(Protocol):
    """A correction of a predictive distribution, fitted on held-out data."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Corrected quantile of every coordinate."""
        ...

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Corrected distribution function of every coordinate at ``value``."""
        ...

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws of the raw marginals, moved to the corrected marginals."""
        ...

    def predictive(self, raw: Prediction) -> Predictive | None:
        """The corrected distribution where it is still a Gaussian mixture, else None."""
        ...

    def rows(self, index: slice | Tensor) -> Recalibration:
        """The correction of some sequences or items."""
        ...


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """A predictive distribution over named axes, in the data's own units.

    ``axes`` is ``("sequence", "time", "channel")`` or ``("item", "target")``; ``names`` and
    ``units`` label the last axis; ``task`` says which question was answered and ``offset`` at
    which frame a forecast begins. Deterministic predictions raise
    :class:`~zoo.errors.NoSpreadError` wherever a standard deviation is needed.
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
        for what in ("names", "units"):
            if len(getattr(self, what)) != shape[-1]:
                raise ValueError(
                    f"{len(getattr(self, what))} {what} for {shape[-1]} {self.axes[-1]}s"
                )
        if self.lengths is not None and tuple(self.lengths.shape) != shape[:1]:
            raise ValueError(f"{len(self.lengths)} lengths for {shape[0]} {self.axes[0]}s")

    def __repr__(self) -> str:
        """Task, named sizes, units and recalibration in one line."""
        sizes = ", ".join(f"{a} {n}" for a, n in zip(self.axes, self.shape, strict=True))
        units = "/".join(dict.fromkeys(u for u in self.units if u)) or "no unit"
        spread = "with spread" if self.has_spread else "without spread"
        kind = "" if self.recalibration is None else ", calibrated"
        return f"Prediction of {self.task}: {sizes}; in {units}, {spread}{kind}"

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
    def seconds(self) -> Tensor | None:
        """Time of every frame in s from the start of the movement; None without a rate."""
        if self.rate is None or "time" not in self.axes:
            return None
        frames = self.shape[self.axes.index("time")]
        return torch.arange(self.offset, self.offset + frames, dtype=torch.float64) / self.rate

    @cached_property
    def effective(self) -> Predictive | None:
        """The mixture after recalibration; None where only its quantiles are known."""
        return (
            self.predictive
            if self.recalibration is None
            else self.recalibration.predictive(self.raw)
        )

    @cached_property
    def raw(self) -> Prediction:
        """This prediction as the model gave it, without recalibration."""
        return self if self.recalibration is None else replace(self, recalibration=None)

    @cached_property
    def mean(self) -> Tensor:
        """Predictive mean."""
        return self.predictive.location.mean(0)

    @cached_property
    def aleatoric(self) -> Tensor:
        """Standard deviation of the observation noise."""
        self._need_spread()
        p = self._mixture()
        if p.noise is None:
            return torch.zeros_like(self.mean)
        return p.noise.expand_as(p.location).square().mean(0).sqrt()

    @cached_property
    def epistemic(self) -> Tensor:
        """Standard deviation of the noise-free value."""
        self._need_spread()
        p = self._mixture()
        variance = (p.location - p.location.mean(0)).square().mean(0)
        if p.epistemic is not None:
            variance = variance + p.epistemic.expand_as(p.location).square().mean(0)
        return variance.sqrt()

    @cached_property
    def std(self) -> Tensor:
        """Predictive standard deviation; of a recalibrated prediction its calibrated one."""
        self._need_spread()
        if self.effective is None:
            low, high = self.interval(math.erf(1 / math.sqrt(2)))
            return (high - low) / 2
        return (self.aleatoric.square() + self.epistemic.square()).sqrt()

    def quantile(self, level: float) -> Tensor:
        """Quantile of every coordinate's marginal, ``0 < level < 1``."""
        level = level_of(level)
        self._need_spread()
        if self.recalibration is not None:
            return self.recalibration.quantile(self.raw, level)
        return self.quantile_at(NormalDist().inv_cdf(level))

    def quantile_at(self, score: float) -> Tensor:
        """Quantile at the level Φ(``score``), which reaches further into the tails."""
        self._need_spread()
        p = self._mixture()
        return mixtures.quantile(p.location, p.spread, score)

    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Central interval that holds ``level`` of the probability, ``0 < level < 1``."""
        level = level_of(level)
        return self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)

    def cdf(self, value: Tensor) -> Tensor:
        """Predictive distribution function of every coordinate at ``value``.

        ``value`` broadcasts to the prediction, or holds draws with a leading ``sample`` axis.
        """
        self._need_spread()
        value = self._expand(value)
        if self.recalibration is not None:
            return self.recalibration.cdf(self.raw, value)
        p = self._mixture()
        return mixtures.cdf(p.location, p.spread, value)

    def normal_score(self, value: Tensor) -> Tensor:
        """Φ⁻¹ of :meth:`cdf`, exact far out in both tails: (y − mean) / std for a Gaussian."""
        self._need_spread()
        p = self._mixture()
        return mixtures.normal_score(p.location, p.spread, self._expand(value))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log marginal density of every coordinate at ``value``."""
        self._need_spread()
        p = self._mixture()
        scale = p.spread
        if scale is None:
            raise NoDensityError("this prediction is a set of draws without noise: no density")
        return mixtures.log_density(p.location, scale, self._expand(value))

    def sample(self, count: int, *, seed: int = 0, joint: bool = True) -> Tensor:
        """``count`` draws with their noise; joint trajectories unless ``joint=False``."""
        self._need_spread()
        count = whole_number(count, "count")
        generator = torch.Generator(device=self.mean.device).manual_seed(seed_of(seed))
        draws = (
            self._paths(count, generator) if joint else marginals(self.predictive, count, generator)
        )
        if self.recalibration is None:
            return draws
        return self.recalibration.transport(self.raw, draws)

    def channel(self, name: str) -> int:
        """Index of a channel or target by name."""
        if not isinstance(name, str) or name not in self.names:
            raise ValueError(
                f"no {self.axes[-1]} {name!r}; there are {', '.join(self.names[:8])}, …"
            )
        return self.names.index(name)

    def rows(self, index: Tensor | Sequence[int]) -> Self:
        """The prediction of some sequences or items, by their numbers or by a boolean each."""
        where = rows_among(index, self.shape[0], f"{self.axes[0]}s of a prediction")
        return replace(
            self,
            predictive=self.predictive.rows(where),
            lengths=None if self.lengths is None else self.lengths[where],
            recalibration=None if self.recalibration is None else self.recalibration.rows(where),
        )

    def recalibrated(self, recalibration: Recalibration) -> Self:
        """This prediction with its bands corrected."""
        self._need_spread()
        return replace(self, recalibration=recalibration)

    def to_pandas(self, level: float = 0.9) -> pandas.DataFrame:
        """A row for every movement, time and channel: mean, std and the ends of the band.

        A deterministic answer has a mean alone. Raises ModuleNotFoundError without pandas.
        """
        return handing.as_frame(self, level)

    def to_xarray(self, level: float = 0.9) -> xarray.Dataset:
        """The same over named axes, NaN after a movement's end, units as a coordinate."""
        return handing.as_xarray(self, level)

    def plot(
        self,
        ax: Panel | None = None,
        *,
        sequence: int = 0,
        channels: str | Sequence[str] | None = None,
    ) -> Figure:
        """Mean with 50 % and 90 % bands of one movement: channels named, or those that move most.

        With ``ax`` one channel is drawn there. The figure is returned, to show or to save.
        """
        return handing.picture(self, ax, sequence, channels)

    def _repr_html_(self) -> str:
        """Sizes, units and spread, for a notebook."""
        rows = handing.told(self, calibrated=self.recalibration is not None)
        return facts(f"Prediction of {self.task}", rows)

    def _need_spread(self) -> None:
        if not self.has_spread:
            raise NoSpreadError(
                f"this {self.task} prediction is deterministic: it has no standard deviation"
            )

    def _mixture(self) -> Predictive:
        mixture = self.effective
        if mixture is None:
            raise NoDensityError(
                f"recalibration by {type(self.recalibration).__name__} corrects quantiles only; "
                "ask for quantile, interval or sample, or recalibrate by scale"
            )
        return mixture

    def _expand(self, value: Tensor) -> Tensor:
        value = tensor_of(value, "value")
        leading = value.shape[:1] if value.ndim == len(self.shape) + 1 else ()
        try:
            return value.to(self.predictive.location).expand(*leading, *self.shape)
        except RuntimeError:
            raise ValueError(
                f"value has shape {tuple(value.shape)}; the prediction has {self.shape}"
            ) from None

    def _paths(self, count: int, generator: torch.Generator) -> Tensor:
        p = self.predictive
        if p.draws is not None:
            path = p.draws[picks(count, p.draws, generator)]
            noise = None if p.noise is None else self.raw.aleatoric
            return with_noise(path, noise, generator)
        if not p.joint or p.epistemic is not None:
            raise NoJointSamplesError(
                "this prediction knows the marginals only; ask for sample(count, joint=False)"
            )
        pick = picks(count, p.location, generator)
        noise = None if p.noise is None else p.noise.expand_as(p.location)[pick]
        return with_noise(p.location[pick], noise, generator)
