"""Dynamic movement primitives with uncertainty: `dmp`, `dmp-rhythmic`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from pyro import poutine
from torch import Tensor
from torch.nn import functional

from zoo.datasets.records import Sequences
from zoo.models.primitives.goals import aimed, recentred
from zoo.models.primitives.learned_dmp import COMPONENTS, Config, LearnedDmp
from zoo.models.primitives.learning import learn_parameters
from zoo.models.primitives.movement_law import MovementLaw, ResidualNoise
from zoo.models.primitives.parameter_hypotheses import AtTiming, ParameterPosterior
from zoo.models.primitives.population import Population
from zoo.models.primitives.rollout import roll_out
from zoo.movement.components import Components, Paths, minimum_jerk, ramp
from zoo.movement.demonstrations import extremes, seen_entries, seen_movements
from zoo.movement.timing import Timing
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Posterior, Sites, Wishes

__all__ = ["DMP", "Config"]


class DMP(LearnedDmp):
    r"""A spring to a goal driven by a learned forcing term, as a linear-Gaussian model of movement.

    For every joint::

        τ² ÿ = α (β (g − y) − τ ẏ) + Ψ(s)w + σ_f ε,   ε ~ N(0, 1)
        x_t ~ N(y_t, σ² ρ)

    so that f_target ~ N(Ψ(s)w, σ_f²), (59), and over movements::

        timing ~ U,   s² ~ ν/χ²_ν,   a, δ ~ N(0, I)
        θ = (y₁, ẏ₁, g, w) = μ + s (L a + V δ)

    ``timing`` is the duration of the whole movement, of rhythmic ones a tempo and a phase. L a is
    what joints share, V δ what each has alone; n movements make a t of ν = n − 1 degrees of
    freedom, as an equal mixture of 16 scales s (8 where movements repeat). Positions are linear in
    θ and ε: given timing and s all is Gaussian, and ε is integrated out. The guide is the exact
    posterior of timing, s, a and δ in this program.

    The program counts every entry as ``information`` of an independent one, since residuals go
    together over joints and time: below 1 its posterior is a generalised (tempered) one, not Bayes'
    (Bissiri, Holmes & Walker, *A general framework for updating belief distributions*, JRSS B 78,
    2016). What a channel has in V and not in L is the share that a ridge on the other channels
    cannot tell of held-out movements. Information and the share of independent parameters in V are
    those under which single entries of held-out movements are most probable, later ones after the
    first quarter and those of a block of channels given the others; with fewer than three movements
    information is 1 and the shares are one half. Timings, noise and that share of a channel are
    learned from all movements before.

    Forecasts and filled gaps are the posterior predictive, at durations of training movements that
    last as long, resampled to 16 components. A reconstruction, and a demonstration that is to be
    changed, take the likeliest timing and s = 1. Other goals, durations and switching (89) act on
    p(θ | x).

    Thesis §2.2.1, (53)–(62), §6.2.4, §6.2.5; Ijspeert et al., *Dynamical movement primitives*,
    Neural Computation 25 (2013); Gaussian weights over movements as Paraschos et al.,
    *Probabilistic movement primitives*, NIPS 2013. Defaults: 20 kernels (§5.3.2), α = 25, β = α/4,
    no gate on the forcing term as in (54), widths of Ijspeert's code. Prior variance of w by
    evidence maximisation, σ² and ρ by the likelihood of the residuals. ``epistemic`` is the
    uncertainty of the path y, of θ and of the forces ε; ``noise`` that of the observation.

    It cannot know how movements differ from a single one: its first state and goal then get the
    variance over time. Variances and period are point estimates. Steps must be short against the
    movement: some 17 frames at least with α = 25.
    """

    def condition(self, data: Sequences) -> None:
        """Learn p(θ), the noise, and the durations or the period of the movements."""
        period = None if self.config.period is None else self.config.period * data.rate
        found = learn_parameters(
            self.primitive, self.config.learning, period, data.values, data.mask, data.lengths
        )
        self._keep("reached", extremes(data.values, data.mask))
        self._keep_learned(found)

    def forward(self, batch: Batch) -> Float[Tensor, "*sample sequence frame channel"]:
        """The generative program of the whole movements of ``batch``; returns R θ."""
        with self.movements(batch):
            law, path = self.prior(batch)
            with poutine.scale(scale=float(self.information)):
                pyro.sample("x", law, obs=batch.given(batch.movements))
        return path

    def movements(self, batch: Batch) -> AbstractContextManager[Any]:
        """The plate of the movements."""
        rows = torch.arange(len(batch.movements))
        plate: AbstractContextManager[Any] = pyro.plate(
            "movements", size=batch.total_sequences, subsample=rows
        )
        return plate

    def prior(self, batch: Batch) -> tuple[MovementLaw, Tensor]:
        """Draw timing, scale and θ of the movements: p(x | θ, timing), and R θ."""
        frames, timings = batch.movements.shape[1], self.expected.whole(batch.movements.shape[1])
        designs = torch.stack([roll_out(self.primitive, frames, t) for t in timings])
        timing = pyro.sample("timing", dist.Categorical(torch.ones_like(designs[:, 0, 0])))
        s = self.scales[pyro.sample("scale", dist.Categorical(torch.ones_like(self.scales)))]
        δ = self._white("private", *self.mean.shape)
        deviation = torch.einsum("cpq,...cq->...cp", self.private, δ)
        if self.factors.shape[-1]:
            a = self._white("shared", self.factors.shape[-1])
            deviation = deviation + torch.einsum("cpr,...r->...cp", self.factors, a)
        θ = self.mean + s[..., None, None] * deviation
        noise = ResidualNoise(self.noise, self.ratio)
        law = MovementLaw(self.primitive, timings, noise, timing, θ, seen_movements(batch))
        path: Tensor = θ @ designs[timing].mT
        return law, path.mT

    def posterior_sites(self, batch: Batch) -> Sites:
        """p(timing, scale, θ | x), exactly, each entry counted as ``information`` of one."""
        x, seen = batch.movements, seen_movements(batch)
        given = ParameterPosterior(self._given(self.expected.whole(x.shape[1])), x, seen)
        of = {"timing": given.timing, "scale": given.scale}
        if self.factors.shape[-1]:
            of["shared"] = given.shared
        of["private"] = given.private
        return Sites(plate="movements", size=batch.total_sequences, rows=len(x), of=of)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Fresh roll-outs of the weights, goal and first state that the movements have."""
        self._check_fitted()
        frames = batch.values.shape[1]
        given = self._given(self.expected.whole(frames))
        anew = partial(self._roll_outs.anew, frames=frames)
        parts = given.mixture(batch.values, seen_entries(batch), 1, anew)
        return self._as_predictive(parts, draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries observed."""
        self._check_fitted()
        timings = self.expected.whole(batch.values.shape[1])
        parts = self._filled(batch.values, seen_entries(batch), timings)
        return self._as_predictive(parts, draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        self._check_fitted()
        pad = (0, 0, 0, horizon)
        values, seen = functional.pad(batch.values, pad), functional.pad(seen_entries(batch), pad)
        known = batch.values.shape[1]
        parts = self._filled(values, seen, self.expected.lasting(known))
        return self._as_predictive(parts.after(known), draws)

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Roll-outs of the demonstrated weights, with other goals, durations, or switched (89).

        A switched movement keeps the tempo of ``batch``; ``goal`` is then that of ``onto``. With
        goal scaling, the forcing term is scaled by (g' − y₁)/(g − y₁), of joints whose start and
        goal are close by less; the rest of the way is added as a minimum-jerk path. Bands grow with
        g' − g.
        """
        self._check_fitted()
        goal, duration, onto = wishes.goal, wishes.duration, wishes.onto
        frames = round((batch.values.shape[1] - 1) * duration) + 1
        other = None if onto is None else self._demonstrated(onto, len(batch))
        still = torch.zeros(frames - 1, dtype=self.dtype)
        blend = ramp(frames, wishes.start, wishes.steps) if other else still
        rolled = self._roll_outs

        def mix(i: int, at: AtTiming) -> Paths:
            timing = Timing(at.timing.unit * duration, at.timing.offset)
            terms = [(rolled.part(timing, 1 - blend, begin=True), at.population)]
            if other:
                phase = Timing(timing.unit, other[i].timing.offset)
                terms.append((rolled.part(phase, blend, begin=False), other[i].population))
            if goal is not None:
                moved, rest = self._moved(other[i] if other else at, goal[i])
                terms[-1] = (terms[-1][0], moved)
                terms.append((minimum_jerk(frames, wishes.start)[:, None], Population.fixed(rest)))
            return rolled.summed(terms, timing)

        parts = [mix(i, at) for i, at in enumerate(self._demonstrated(batch, len(batch)))]
        return self._as_predictive(Components.of(parts), draws)

    def _filled(self, values: Tensor, seen: Tensor, timings: list[Timing]) -> Components:
        given = self._given(timings)
        return given.mixture(values, seen, given.at_most(COMPONENTS), self._roll_outs.followed)

    def _demonstrated(self, batch: Batch, count: int) -> list[AtTiming]:
        """The likeliest timing of every movement and its posterior."""
        if len(batch) not in (1, count):
            raise ValueError(f"onto has {len(batch)} movements; 1 or {count} are needed")
        given = self._given(self.expected.whole(batch.values.shape[1]))
        found = given.demonstrated(batch.values, seen_entries(batch))
        return [found[i if len(batch) == count else 0] for i in range(count)]

    def _moved(
        self, at: AtTiming, goal: Float[Tensor, " channel"]
    ) -> tuple[Population, Float[Tensor, "1 channel parameter"]]:
        """p(θ | x) of another goal, and how far it then is from ``goal``."""
        p = at.population
        if self.config.kind == "rhythmic":
            return recentred(p, goal), torch.zeros_like(p.mean[..., 2:3])
        path = p.path(roll_out(self.primitive, at.x.shape[1], at.timing))
        least = self.config.least_amplitude * (path.amax(-1) - path.amin(-1))
        return aimed(p, goal, least, scaled=self.config.goal_scaling)

    def _as_predictive(self, parts: Components, draws: int) -> Predictive:
        noise = (self.noise * self.ratio.sqrt()).expand_as(parts.mean)
        return Predictive(
            location=parts.mean,
            noise=noise,
            epistemic=parts.variance.sqrt().expand_as(parts.mean),
            draws=parts.draws(draws),
        )

    def _white(self, name: str, *shape: int) -> Tensor:
        zero = self.mean.new_zeros(shape)
        site = dist.Normal(zero, torch.ones_like(zero)).to_event(len(shape))
        value: Tensor = pyro.sample(name, site)
        return value
