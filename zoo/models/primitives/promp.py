"""Probabilistic movement primitives: `promp`, `promp-rhythmic`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from pydantic import Field
from pyro import poutine
from torch import Tensor, nn
from torch.nn import functional

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Count, Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.primitives.cross_fitting import Prepared, WeightShrinkage, choose, inflation
from zoo.models.primitives.preparation import Preparation
from zoo.models.primitives.scales import student_scales
from zoo.models.primitives.weight_hypotheses import WeightHypotheses, WeightPosterior
from zoo.models.primitives.weight_learning import EntryNoise, learn_weights
from zoo.models.primitives.weights import Basis, Weights, superposed
from zoo.movement.components import Components, Paths, ramp
from zoo.movement.demonstrations import (
    extremes,
    movement_groups,
    movements_of,
    seen_entries,
    seen_movements,
)
from zoo.movement.timing import Expected, Timing
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior, Sites, Wishes

__all__ = ["Config", "ProMP"]

COMPONENTS = 16
SMOOTH = 1.0
SCALES = {"discrete": 16, "rhythmic": 4}


@settings
class Config:
    """Settings of :class:`ProMP`.

    ``kernels`` basis functions for every synergy; ``synergies`` is their number, and every channel
    is its own where that is None or not below the number of channels. ``period`` of rhythmic
    movements is in s; None finds it by autocorrelation.
    ``shrinkage`` is the share of the inverse-Wishart prior in Σ; ``information`` is the part of an
    independent observation that every entry counts, 1 for Bayes' rule. None chooses them by the
    density of held-out movements. EM ends after ``em_iterations`` or a gain of ``em_tolerance``
    nats an entry.
    """

    kind: Literal["discrete", "rhythmic"] = "discrete"
    kernels: Annotated[int, Field(ge=2)] = 15
    synergies: Count | None = None
    period: Positive | None = None
    shrinkage: Annotated[float, Field(gt=0, lt=1)] | None = None
    information: Annotated[float, Field(gt=0, le=1)] | None = None
    em_iterations: Count = 20
    em_tolerance: Positive = 1e-4


class ProMP(nn.Module):
    r"""A whole movement is a Gaussian vector of basis weights, correlated over all channels.

    timing ~ U,   s² ~ ν/χ²_ν,   w ~ N(μ, s²Σ)

    y_tc = m_c + Σ_jk S_cj φ_k(t) w_jk,   x_tc ~ N(y_tc, σ_c²)

    Paraschos et al., *Probabilistic movement primitives*, NIPS 2013, and Autonomous Robots 42
    (2018). μ, Σ and σ are point estimates, by EM under an inverse-Wishart prior whose scale has
    independent channels, as Gómez-González et al., *Using probabilistic movement primitives for
    striking movements* (2016); there, neighbouring kernels go together. Under that prior w of a new
    movement is a t: of n − 1 degrees of freedom here, as an equal mixture of 16 scales s (4 where
    movements repeat), with a further (1 + 1/n)/(1 − 1/n) in Σ for the mean of n movements. With
    ``synergies``, S and m are principal components of the frames: Colomé & Torras, *Dimensionality
    reduction for probabilistic movement primitives* (2014). The rival that chapters 5 and 6 of the
    thesis name; not one of its own models.

    ``timing`` is the whole movement's duration; of rhythmic movements one of 288 tempos and phases.
    The guide is the exact posterior of timing, s and w in this program. The program counts every
    entry as ``information`` of an independent one, since residuals go together over channels and
    time: below 1 its posterior is a generalised one, not Bayes' (Bissiri, Holmes & Walker, *A
    general framework for updating belief distributions*, JRSS B 78, 2016). Share of the prior and
    information are those under which held-out movements are most probable after their first
    quarter, alignment, synergies, mean and noise made without them; windows of one movement are
    left out together. Data are standardised before, all training movements together.

    Forecasts and filled gaps are the posterior predictive, at durations of training movements that
    last as long, resampled to 16 components. A reconstruction, and a demonstration that is to be
    changed, count every entry whole, at the likeliest timing. Another goal moves a demonstration
    along Σ and along the path of least jerk, its first frame kept: the nearest weights that end
    there (rhythmic: about another centre); bands grow with the distance. Another duration stretches
    the phase; switching blends two paths linearly, so that joint draws exist, instead of
    Paraschos' product of densities.
    ``epistemic`` is the uncertainty of the path, ``noise`` that of the observation.

    It cannot leave the span of its basis, learn from one movement, or reach a goal beyond its
    synergies. Defaults: 15 kernels, no synergies; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    mean: Tensor
    root: Tensor
    noise: Tensor
    synergies: Tensor
    offset: Tensor
    shrinkage: Tensor
    information: Tensor
    scales: Tensor
    units: Tensor
    offsets: Tensor
    reached: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.phased = config.kind == "discrete"
        self.layout, self.config = layout, config
        learned = "shrinkage information scales units offsets reached"
        for name in ("mean", "root", "noise", "synergies", "offset", *learned.split()):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    @property
    def weights(self) -> Weights:
        """p(w) of a new movement."""
        check_fitted("promp", self.mean)
        return Weights(self.mean, self.root)

    @property
    def _preparation(self) -> Preparation:
        c = self.config
        return Preparation(c.kind, c.kernels, c.synergies, c.period)

    @property
    def expected(self) -> Expected:
        """Timings that a new movement may have."""
        return Expected.stored(self.config.kind, self.units, self.offsets)

    def condition(self, data: Sequences | Pairs) -> None:
        """Learn p(w), the noise, and the durations or the period of the movements."""
        movements = movements_of("promp", data, self.dtype)
        if len(movements) < 2:
            raise ValueError("promp needs at least 2 movements to see how they differ; got 1")
        rows = zip(movements.values, movements.mask, movements.lengths.tolist(), strict=True)
        inside = [(x[:n], seen[:n]) for x, seen, n in rows]
        self.reached = extremes(movements.values, movements.mask)
        prepare = partial(self._preparation.of, inside, movements.rate)
        group, c = movement_groups(movements), self.config
        chosen = choose(prepare, inside, group, c.shrinkage, c.information)
        self._keep(prepare(range(len(inside))), chosen, len(group.unique()))

    def forward(self, batch: Batch) -> Float[Tensor, "*sample sequence frame channel"]:
        """The generative program of the whole movements of ``batch``."""
        given = self._given(self.expected.whole(batch.movements.shape[1]))
        bases = [given.basis(batch.movements.shape[1], t) for t in given.timings]
        phases, prior = torch.stack([b.phases for b in bases]), given.prior
        rows, like = torch.arange(len(batch.movements)), torch.ones_like
        with pyro.plate("movements", size=batch.total_sequences, subsample=rows):
            timing = pyro.sample("timing", dist.Categorical(like(phases[:, 0, 0])))
            scale = pyro.sample("scale", dist.Categorical(like(given.scales)))
            root = given.scales[scale][..., None, None] * prior.root
            w = pyro.sample("w", dist.MultivariateNormal(prior.mean, scale_tril=root))
            y: Tensor = self.offset + Basis(phases[timing], self.synergies).path(w)
            noise = dist.Normal(y, self.noise)
            if batch.movement_mask is not None:
                noise = noise.mask(batch.movement_mask)
            with poutine.scale(scale=given.noise.information):
                pyro.sample("x", noise.to_event(2), obs=batch.given(batch.movements))
        return y

    def posterior_sites(self, batch: Batch) -> Sites:
        """The exact posterior of timing, scale and weights given the movements of ``batch``."""
        found, size = self._posteriors(batch), batch.total_sequences
        of = {"timing": found.timing, "scale": found.scale, "w": found.weights}
        return Sites(plate="movements", size=size, rows=len(batch.movements), of=of)

    def log_evidence(self, batch: Batch) -> Float[Tensor, ""]:
        """Log p(x) of the entries observed, summed over the movements of ``batch``."""
        return self._posteriors(batch).log_evidence().sum()

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Paths of the weights that the movements have, at their likeliest timing."""
        check_fitted("promp", self.mean)
        given = self._given(self.expected.whole(batch.values.shape[1]), whole=True)
        x = batch.values - self.offset
        return self._as_predictive(given.filled(x, seen_entries(batch), 1), draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries observed."""
        check_fitted("promp", self.mean)
        given = self._given(self.expected.whole(batch.values.shape[1]))
        x = batch.values - self.offset
        return self._as_predictive(given.filled(x, seen_entries(batch), COMPONENTS), draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        check_fitted("promp", self.mean)
        pad, known = (0, 0, 0, horizon), batch.values.shape[1]
        x = functional.pad(batch.values - self.offset, pad)
        seen = functional.pad(seen_entries(batch), pad)
        parts = self._given(self.expected.lasting(known)).filled(x, seen, COMPONENTS)
        return self._as_predictive(parts.after(known), draws)

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Paths of the demonstrated weights, with other goals, durations, or switched (89).

        A switched movement keeps the tempo of ``batch``; ``goal`` is then that of ``onto``.
        """
        check_fitted("promp", self.mean)
        goal, duration, onto = wishes.goal, wishes.duration, wishes.onto
        frames = round((batch.values.shape[1] - 1) * duration) + 1
        demonstrated = self._demonstrated(batch, len(batch))
        other = None if onto is None else self._demonstrated(onto, len(batch))
        still = torch.zeros(frames, dtype=self.dtype)
        blend = still if other is None else ramp(frames + 1, wishes.start, wishes.steps)

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
        return self._preparation.basis(self.synergies, frames, timing)

    def _keep(self, all_: Prepared, chosen: WeightShrinkage, groups: int) -> None:
        c = self.config
        found = learn_weights(
            all_.single, all_.views, chosen.share, c.em_iterations, c.em_tolerance
        )
        self.synergies, self.offset = all_.synergies, all_.offset
        self.mean, self.noise = found.weights.mean, found.variance.sqrt()
        self.root = found.weights.root * inflation(groups)
        self.scales = student_scales(max(1, groups - 1), SCALES[c.kind])
        self.shrinkage = self.mean.new_tensor(chosen.share)
        self.information = self.mean.new_tensor(chosen.information)
        self.units = self.mean.new_tensor(all_.expected.units)
        self.offsets = self.mean.new_tensor(all_.expected.offsets)

    def _given(self, timings: list[Timing], *, whole: bool = False) -> WeightHypotheses:
        """What is possible before an entry was observed; ``whole`` entries count 1."""
        noise = EntryNoise(self.noise.square(), 1.0 if whole else float(self.information))
        return WeightHypotheses(timings, self.scales, self.weights, noise, self.basis)

    def _posteriors(self, batch: Batch) -> WeightPosterior:
        given = self._given(self.expected.whole(batch.movements.shape[1]))
        x = batch.movements - self.offset
        return WeightPosterior(given, x, seen_movements(batch))

    def _demonstrated(self, batch: Batch, count: int) -> list[tuple[Timing, Weights]]:
        """The likeliest timing of every movement and the posterior of its weights."""
        if len(batch) not in (1, count):
            raise ValueError(f"onto has {len(batch)} movements; 1 or {count} are needed")
        given = self._given(self.expected.whole(batch.values.shape[1]), whole=True)
        found = given.demonstrated(batch.values - self.offset, seen_entries(batch))
        return [found[i if len(batch) == count else 0] for i in range(count)]

    def _moved(self, weights: Weights, basis: Basis, goal: Tensor) -> Weights:
        if self.config.kind == "rhythmic":
            return weights.centred(basis, goal)
        return weights.moved(basis, goal, self.weights, SMOOTH)

    def _as_predictive(self, parts: Components, draws: int) -> Predictive:
        paths = parts.draws(draws)
        return Predictive(
            location=self.offset + parts.mean,
            noise=self.noise.expand_as(parts.mean),
            epistemic=parts.variance.sqrt().expand_as(parts.mean),
            draws=paths.map(lambda y: self.offset + y, paths.shape),
        )
