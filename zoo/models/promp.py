"""Probabilistic movement primitives: `promp`, `promp-rhythmic`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from zoo.datasets.records import Pairs, Sequences
from zoo.dynamics.alignment import align, durations
from zoo.dynamics.components import Components, Paths, alike, ramp, resample
from zoo.dynamics.dmp import discrete_basis, rhythmic_basis
from zoo.dynamics.rollout import Timing
from zoo.dynamics.sums import Movements
from zoo.dynamics.synergies import synergies_of
from zoo.dynamics.timing import FINE, expected, period_of, phases
from zoo.dynamics.weight_learning import View, learn, views_of
from zoo.dynamics.weights import Basis, Weights, superposed
from zoo.models.baseline import check_fitted, movement_groups, movements_of, seen_entries
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "ProMP"]

COMPONENTS = 16
TEMPOS, PHASES = 9, 32


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`ProMP`.

    ``kernels`` basis functions for every synergy; ``synergies`` is their number, and every channel
    is its own where that is None or not below the number of channels. ``period`` of rhythmic
    movements is in s; None finds it by autocorrelation.
    ``shrinkage`` is the share of the inverse-Wishart prior in Σ; None chooses it by the density of
    movements left out. EM ends after ``em_iterations`` or a gain of ``em_tolerance`` nats an entry.
    """

    kind: Literal["discrete", "rhythmic"] = "discrete"
    kernels: int = 15
    synergies: int | None = None
    period: float | None = None
    shrinkage: float | None = None
    em_iterations: int = 20
    em_tolerance: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse settings without a meaning."""
        if self.kind not in ("discrete", "rhythmic"):
            raise ValueError(f"kind must be discrete or rhythmic; got {self.kind!r}")
        for name, least in (("kernels", 2), ("synergies", 1), ("em_iterations", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}; got {value}")
        for name in ("period", "em_tolerance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive; got {value}")
        if self.shrinkage is not None and not 0 < self.shrinkage < 1:
            raise ValueError(f"shrinkage must be between 0 and 1; got {self.shrinkage}")


class ProMP(nn.Module):
    r"""A whole movement is a Gaussian vector of basis weights, correlated over all channels.

    w ~ N(μ, Σ),   y_tc = m_c + Σ_jk S_cj φ_k(t) w_jk,   x_tc ~ N(y_tc, σ_c²)

    Paraschos et al., *Probabilistic movement primitives*, NIPS 2013, and Autonomous Robots 42
    (2018). μ, Σ and σ by EM under an inverse-Wishart prior whose scale is of independent channels,
    as Gómez-González et al., *Using probabilistic movement primitives for striking movements*
    (2016); its weight is the one under which movements left out are foretold best, windows of one
    movement left out together. With ``synergies``, S and m are principal components of the frames:
    Colomé & Torras, *Dimensionality reduction for probabilistic movement primitives* (2014). The
    rival that chapters 5 and 6 of the thesis name; not one of its own models.

    Forecast, filled gaps and reconstruction are the exact Gaussian given the entries seen and the
    timing; where training movements differ in duration, and for rhythmic movements in tempo and
    phase, a mixture over these timings. Another goal moves a demonstration along Σ, its first frame
    kept: the nearest weights that end there (rhythmic: about another centre). Another duration
    stretches the phase; switching blends two paths linearly, so that joint draws exist, instead of
    Paraschos' product of densities.
    ``epistemic`` is the spread of the path, ``noise`` that of the observation.

    It cannot leave the span of its basis, learn from one movement, or reach a goal beyond its
    synergies. Σ has a further (1 + 1/n)/(1 − 1/n) for the estimated mean of n movements; its other
    uncertainty is not in the bands. Defaults: 15 kernels, no synergies; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    mean: Tensor
    root: Tensor
    noise: Tensor
    synergies: Tensor
    offset: Tensor
    shrinkage: Tensor
    units: Tensor
    offsets: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.phased = config.kind == "discrete"
        self.layout, self.config = layout, config
        names = ("mean", "root", "noise", "synergies", "offset", "shrinkage", "units", "offsets")
        for name in names:
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    @property
    def weights(self) -> Weights:
        """p(w) of a new movement."""
        check_fitted("promp", self.mean)
        return Weights(self.mean, self.root)

    def condition(self, data: Sequences | Pairs) -> None:
        """Learn p(w), the noise, and the durations or the period of the movements."""
        movements = movements_of("promp", data, self.dtype)
        if len(movements) < 2:
            raise ValueError("promp needs at least 2 movements for their spread; got 1")
        self.synergies, self.offset = synergies_of(
            movements.values, movements.mask, self.config.synergies
        )
        rows = zip(movements.values, movements.mask, movements.lengths.tolist(), strict=True)
        inside = [(((x - self.offset) * seen)[:n], seen[:n]) for x, seen, n in rows]
        choices = self._choices(inside, movements.rate)
        rhythmic = self.config.kind == "rhythmic"
        timings = align(self.basis, inside, choices) if rhythmic else choices
        self._keep(views_of(self.basis, inside, timings), movement_groups(movements))
        kept = expected(timings, TEMPOS, PHASES) if rhythmic else durations(timings, COMPONENTS)
        self.units = self.mean.new_tensor([t.unit for t in kept])
        self.offsets = self.mean.new_tensor([t.offset for t in kept])

    def forward(self, batch: Batch) -> Float[Tensor, "sequence frame channel"]:
        """The generative program of the whole movements of ``batch``."""
        frames = batch.movements.shape[1]
        prior, basis = self.weights, self.basis(frames, self._whole(frames)[0])
        rows = torch.arange(len(batch.movements))
        with pyro.plate("movements", size=batch.total_sequences, subsample=rows):
            w = pyro.sample("w", dist.MultivariateNormal(prior.mean, scale_tril=prior.root))
            y: Tensor = self.offset + basis.path(w)
            noise = dist.Normal(y, self.noise)
            if batch.movement_mask is not None:
                noise = noise.mask(batch.movement_mask)
            pyro.sample("x", noise.to_event(2), obs=batch.movements)
        return y

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Paths of the weights that the movements have, at their likeliest timing."""
        check_fitted("promp", self.mean)
        timings = self._whole(batch.values.shape[1])
        return self._filled(batch.values, seen_entries(batch), timings, 1, draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries seen."""
        check_fitted("promp", self.mean)
        timings = self._whole(batch.values.shape[1])
        count = 1 if len(timings) == 1 else COMPONENTS
        return self._filled(batch.values, seen_entries(batch), timings, count, draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        check_fitted("promp", self.mean)
        pad, known = (0, 0, 0, horizon), batch.values.shape[1]
        values, seen = functional.pad(batch.values, pad), functional.pad(seen_entries(batch), pad)
        timings = self._timings(known)
        count = 1 if len(timings) == 1 else COMPONENTS
        return self._filled(values, seen, timings, count, draws, after=known)

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        goal: Float[Tensor, "sequence channel"] | None,
        duration: float,
        onto: Batch | None,
        start: int,
        steps: int,
        draws: int,
    ) -> Predictive:
        """Paths of the demonstrated weights, with other goals, durations, or switched (89).

        A switched movement keeps the tempo of ``batch``; ``goal`` is then that of ``onto``.
        """
        check_fitted("promp", self.mean)
        frames = round((batch.values.shape[1] - 1) * duration) + 1
        demonstrated = self._demonstrated(batch, len(batch))
        other = None if onto is None else self._demonstrated(onto, len(batch))
        still = torch.zeros(frames, dtype=self.dtype)
        blend = still if other is None else ramp(frames + 1, start, steps)

        def mix(i: int) -> Paths:
            timing = Timing(demonstrated[i][0].unit * duration, demonstrated[i][0].offset)
            terms = [(self.basis(frames, timing), demonstrated[i][1], 1 - blend)]
            if other:
                phase = Timing(timing.unit, other[i][0].offset)
                terms.append((self.basis(frames, phase), other[i][1], blend))
            if goal is not None:
                basis, weights, part = terms.pop()
                terms.append((basis, self._moved(weights, basis, goal[i] - self.offset), part))
            return superposed(terms)

        return self._as_predictive(Components.of([mix(i) for i in range(len(batch))]), draws)

    def basis(self, frames: int, timing: Timing) -> Basis:
        """φ and S of ``frames`` frames."""
        time, kernels = torch.arange(frames, dtype=self.dtype), self.config.kernels
        if self.config.kind == "discrete":
            φ = discrete_basis(time, kernels=kernels, duration=timing.unit)
        else:
            φ = rhythmic_basis(time, kernels=kernels, period=timing.unit, offset=timing.offset)
        return Basis(φ, self.synergies)

    def _choices(self, movements: Movements, rate: float | None) -> list[Timing]:
        """Durations of discrete movements; all tempos and phases of rhythmic ones."""
        if self.config.kind == "discrete":
            return [Timing(max(1.0, len(x) - 1.0)) for x, _ in movements]
        period = self.config.period
        middle = period_of(movements) if period is None else period * (rate or 1.0)
        return phases(middle, FINE, PHASES)

    def _keep(self, views: list[View], group: Tensor) -> None:
        c, n = self.config, max(2, len(group.unique()))
        found = learn(
            views, group, c.shrinkage, iterations=c.em_iterations, tolerance=c.em_tolerance
        )
        self.mean, self.noise = found.weights.mean, found.variance.sqrt()
        self.root = found.weights.root * ((n + 1) / (n - 1)) ** 0.5
        self.shrinkage = self.mean.new_tensor(found.shrinkage)

    def _filled(
        self,
        values: Tensor,
        seen: Tensor,
        timings: list[Timing],
        count: int,
        draws: int,
        *,
        after: int = 0,
    ) -> Predictive:
        """A mixture over timings, resampled to ``count`` components (1: the likeliest timing).

        Residuals of channels go together, so that all channels count as one: evidence a channel.
        """
        parts = Components.empty(count, values)
        for views in self._sights(values, seen, timings):
            for i, some, chosen in self._chosen(views, count):
                view, whole = views[i].only(some), torch.ones(len(views[i].seen), dtype=self.dtype)
                posterior = view.posterior(self.weights, self.noise.square())
                parts.put(view.rows, chosen, superposed([(view.basis, posterior, whole)]))
        return self._as_predictive(parts.after(after), draws)

    def _sights(self, values: Tensor, seen: Tensor, timings: list[Timing]) -> Iterator[list[View]]:
        """Movements with the same entries seen, in the light of every timing."""
        for rows, mask in alike(seen):
            x = (values[rows] - self.offset) * mask
            yield [View(rows, self.basis(len(mask), t), mask, x) for t in timings]

    def _chosen(self, views: list[View], count: int) -> list[tuple[int, Tensor, Tensor]]:
        """Timings that are components, the movements that have them, and as which components."""
        evidence = views[0].x.new_zeros(1, len(views[0].rows))
        if len(views) > 1:
            variance = self.noise.square()
            evidence = torch.stack([v.log_density(self.weights, variance) for v in views])
        picks = resample(evidence / len(self.noise), count)
        rows = [(i, (picks == i).any(0)) for i in picks.unique().tolist()]
        return [(i, some, picks[:, some] == i) for i, some in rows]

    def _demonstrated(self, batch: Batch, count: int) -> list[tuple[Timing, Weights]]:
        """The likeliest timing of every movement and the posterior of its weights."""
        if len(batch) not in (1, count):
            raise ValueError(f"onto has {len(batch)} movements; 1 or {count} are needed")
        timings, found = self._whole(batch.values.shape[1]), dict[int, tuple[Timing, Weights]]()
        for views in self._sights(batch.values, seen_entries(batch), timings):
            for i, some, _ in self._chosen(views, 1):
                view = views[i].only(some)
                posterior = view.posterior(self.weights, self.noise.square())
                for row, mean in zip(view.rows.tolist(), posterior.mean, strict=True):
                    found[row] = (timings[i], Weights(mean[None], posterior.root))
        return [found[i if len(batch) == count else 0] for i in range(count)]

    def _moved(self, weights: Weights, basis: Basis, goal: Tensor) -> Weights:
        if self.config.kind == "rhythmic":
            return weights.centred(basis, goal)
        return weights.moved(basis, goal, self.weights.covariance)

    def _whole(self, frames: int) -> list[Timing]:
        """Possible timings of a complete movement of ``frames`` frames."""
        if self.config.kind == "discrete":
            return [Timing(max(1.0, frames - 1.0))]
        return self._timings(frames)

    def _timings(self, frames: int) -> list[Timing]:
        """Possible timings of a movement whose first ``frames`` frames are known."""
        pairs = zip(self.units.tolist(), self.offsets.tolist(), strict=True)
        timings = [Timing(unit, offset) for unit, offset in pairs]
        going = [t for t in timings if self.config.kind == "rhythmic" or t.unit >= frames]
        return going or timings[-1:]

    def _as_predictive(self, parts: Components, draws: int) -> Predictive:
        paths = parts.draws(draws)
        return Predictive(
            location=self.offset + parts.mean,
            noise=self.noise.expand_as(parts.mean),
            epistemic=parts.variance.sqrt(),
            draws=paths.map(lambda y: self.offset + y, paths.shape),
        )
