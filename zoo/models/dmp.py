"""Dynamic movement primitives with uncertainty: `dmp`, `dmp-rhythmic`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pyro import poutine
from torch import Tensor, nn
from torch.nn import functional

from zoo.datasets.records import Sequences
from zoo.dynamics.alignment import durations, extremes
from zoo.dynamics.cases import Case, Cases, Posteriors
from zoo.dynamics.components import Components, Paths, minimum_jerk, ramp
from zoo.dynamics.dmp import Response
from zoo.dynamics.imitation import trajectory_matrix
from zoo.dynamics.kalman import PathNoise
from zoo.dynamics.learning import Learning, learn
from zoo.dynamics.movement_law import MovementLaw, Noise
from zoo.dynamics.population import Population
from zoo.dynamics.rollout import Primitive, Timing, roll_out
from zoo.dynamics.timing import TEMPOS, expected
from zoo.errors import NotFittedError
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior, Sites

__all__ = ["DMP", "Config"]

COMPONENTS = 16


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`DMP`; times are in units of the movement's duration or period.

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
    kernels: int = 20
    alpha: float = 25.0
    beta: float | None = None
    gated: bool = False
    period: float | None = None
    goal_scaling: bool = True
    least_amplitude: float = 0.5

    def __post_init__(self) -> None:
        """Refuse settings that give no attractor or no basis."""
        if self.kernels < 2:
            raise ValueError(f"kernels must be at least 2; got {self.kernels}")
        for name in ("alpha", "beta", "period", "least_amplitude"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive; got {value}")
        if self.gated and self.kind == "rhythmic":
            raise ValueError("gated needs a phase that ends; a rhythmic movement has none")


class DMP(nn.Module):
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
    2016). Information, the share of V, and the share of independent parameters in it are those
    under which movements left out are most probable after their first quarter; with fewer than
    three movements information is 1. Timings and noise are learned from all movements before.

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

    def condition(self, data: Sequences) -> None:
        """Learn p(θ), the noise, and the durations or the period of the movements."""
        period = None if self.config.period is None else self.config.period * data.rate
        found = learn(
            self.primitive, self.config.learning, period, data.values, data.mask, data.lengths
        )
        timings = _hypotheses(self.config.kind, found.timings)
        self._keep("mean", found.population.mean)
        self._keep("factors", found.population.factors)
        self._keep("private", found.population.private)
        self._keep("noise", found.noise.sqrt())
        self._keep("reached", extremes(data.values, data.mask))
        self._keep("ratio", found.ratio)
        shares = (found.shares.alone, found.shares.independent)
        self._keep("shares", self.mean.new_tensor(shares))
        self._keep("information", self.mean.new_tensor(found.information))
        self._keep("scales", found.scales)
        self._keep("units", self.mean.new_tensor([t.unit for t in timings]))
        self._keep("offsets", self.mean.new_tensor([t.offset for t in timings]))

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
        frames, timings = batch.movements.shape[1], self._whole(batch.movements.shape[1])
        designs = torch.stack([roll_out(self.primitive, frames, t) for t in timings])
        timing = pyro.sample("timing", dist.Categorical(torch.ones_like(designs[:, 0, 0])))
        s = self.scales[pyro.sample("scale", dist.Categorical(torch.ones_like(self.scales)))]
        δ = self._white("private", *self.mean.shape)
        deviation = torch.einsum("cpq,...cq->...cp", self.private, δ)
        if self.factors.shape[-1]:
            a = self._white("shared", self.factors.shape[-1])
            deviation = deviation + torch.einsum("cpr,...r->...cp", self.factors, a)
        θ = self.mean + s[..., None, None] * deviation
        noise = Noise(self.noise, self.ratio)
        law = MovementLaw(self.primitive, timings, noise, timing, θ, _seen_whole(batch))
        path: Tensor = θ @ designs[timing].mT
        return law, path.mT

    def posterior_sites(self, batch: Batch) -> Sites:
        """p(timing, scale, θ | x), exactly, each entry counted as ``information`` of one."""
        x, seen = batch.movements, _seen_whole(batch)
        given = Posteriors(self._given(self._whole(x.shape[1])), x, seen)
        of = {"timing": given.timing, "scale": given.scale}
        if self.factors.shape[-1]:
            of["shared"] = given.shared
        of["private"] = given.private
        return Sites(plate="movements", size=batch.total_sequences, rows=len(x), of=of)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Fresh roll-outs of the weights, goal and first state that the movements have."""
        self._check_fitted()
        frames = batch.values.shape[1]

        def render(case: Case) -> Paths:
            design = roll_out(self.primitive, frames, case.timing)
            return self._paths([(design, case.population)], self._noise(frames, case.timing))

        parts = self._mixture(batch.values, _seen(batch), self._whole(frames), 1, render)
        return self._as_predictive(parts, draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries seen."""
        self._check_fitted()
        timings = self._whole(batch.values.shape[1])
        parts = self._filled(batch.values, _seen(batch), timings)
        return self._as_predictive(parts, draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        self._check_fitted()
        pad = (0, 0, 0, horizon)
        values, seen = functional.pad(batch.values, pad), functional.pad(_seen(batch), pad)
        known = batch.values.shape[1]
        parts = self._filled(values, seen, self._timings(known))
        return self._as_predictive(parts.after(known), draws)

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
        """Roll-outs of the demonstrated weights, with other goals, durations, or switched (89).

        A switched movement keeps the tempo of ``batch``; ``goal`` is then that of ``onto``. With
        goal scaling, the forcing term is scaled by (g' − y₁)/(g − y₁), of joints whose start and
        goal are close by less; the rest of the way is added as a minimum-jerk path. Bands grow with
        g' − g.
        """
        self._check_fitted()
        frames = round((batch.values.shape[1] - 1) * duration) + 1
        other = None if onto is None else self._demonstrated(onto, len(batch))
        blend = ramp(frames, start, steps) if other else torch.zeros(frames - 1, dtype=self.dtype)

        def mix(i: int, case: Case) -> Paths:
            timing = Timing(case.timing.unit * duration, case.timing.offset)
            terms = [(self._part(frames, timing, 1 - blend, begin=True), case.population)]
            if other:
                phase = Timing(timing.unit, other[i].timing.offset)
                terms.append((self._part(frames, phase, blend, begin=False), other[i].population))
            if goal is not None:
                moved, rest = self._moved(other[i] if other else case, goal[i])
                terms[-1] = (terms[-1][0], moved)
                terms.append((minimum_jerk(frames, start)[:, None], Population.fixed(rest)))
            return self._paths(terms, self._noise(frames, timing))

        parts = [mix(i, case) for i, case in enumerate(self._demonstrated(batch, len(batch)))]
        return self._as_predictive(Components.of(parts), draws)

    def _filled(self, values: Tensor, seen: Tensor, timings: list[Timing]) -> Components:
        alone = len(timings) * len(self.scales) == 1
        return self._mixture(values, seen, timings, 1 if alone else COMPONENTS, self._follow)

    def _mixture(
        self,
        values: Tensor,
        seen: Tensor,
        timings: list[Timing],
        count: int,
        render: Callable[[Case], Paths],
    ) -> Components:
        """A mixture over timings and scales, resampled to ``count`` components."""
        given = self._given(timings)
        parts = Components.empty(count, values)
        for rows, which, case in given.chosen(values, seen, count):
            parts.put(rows, which, render(case))
        return parts

    def _given(self, timings: Sequence[Timing]) -> Cases:
        noise, information = Noise(self.noise, self.ratio), float(self.information)
        return Cases(self.primitive, self.population, noise, information, timings, self.scales)

    def _demonstrated(self, batch: Batch, count: int) -> list[Case]:
        """The likeliest timing of every movement and its posterior."""
        if len(batch) not in (1, count):
            raise ValueError(f"onto has {len(batch)} movements; 1 or {count} are needed")
        given, cases = self._given(self._whole(batch.values.shape[1])), dict[int, Case]()
        for group in given.groups(batch.values, _seen(batch)):
            best = given.likeliest(group).tolist()
            for j, (row, i) in enumerate(zip(group.rows.tolist(), best, strict=True)):
                cases[row] = given.case(group, i, self.noise.new_ones(()), torch.tensor([j]))
        return [cases[i if len(batch) == count else 0] for i in range(count)]

    def _follow(self, case: Case) -> Paths:
        """The paths given the entries observed; draws by Matheron."""
        view, σ, root = case.sight, self.noise, self.ratio.sqrt()
        noise, seen = self._noise(case.x.shape[1], case.timing), view.smoother.seen.mT

        def residual(count: int) -> Tensor:
            force = noise.draw(count, case.x)
            pseudo = (force + root * torch.randn_like(force)) * seen
            return view.follow(case.x) + σ * (force - view.follow(pseudo))

        mean, variance, draw = _sum([(view.given, case.population)])
        spread = view.smoother.variance.mT * σ.square()
        return Paths(mean + view.follow(case.x), variance + spread, lambda n: draw(n) + residual(n))

    def _paths(self, terms: list[tuple[Tensor, Population]], noise: PathNoise) -> Paths:
        """Sum of design θ over ``terms``, with new forces."""
        mean, variance, draw = _sum(terms)
        spread = noise.variance[:, None] * self.noise.square()
        return Paths(mean, variance + spread, lambda n: draw(n) + self.noise * noise.draw(n, mean))

    def _noise(self, frames: int, timing: Timing) -> PathNoise:
        return PathNoise(self.primitive.system(timing), frames)

    def _part(self, frames: int, timing: Timing, weight: Tensor, *, begin: bool) -> Tensor:
        """R of a movement whose goal and weights count ``weight`` at every step."""
        response = Response.of(self.primitive.system(timing), frames)
        basis = self.primitive.basis(frames, timing)[:-1]
        return trajectory_matrix(response, basis, weight=weight, begin=begin)

    def _moved(
        self, case: Case, goal: Float[Tensor, " channel"]
    ) -> tuple[Population, Float[Tensor, "1 channel parameter"]]:
        """p(θ | x) scaled about y₁ by κ, and how far its goal then is from ``goal``.

        How forces go with goals is not known: half of what κ could change them, in either
        direction, is a standard deviation of all joints together.
        """
        p, first, fitted = case.population, *case.population.mean[..., [0, 2]].unbind(-1)
        if self.config.kind == "rhythmic":
            none = torch.zeros_like(fitted)
            return self._scaled(p, none + 1, goal), none[..., None]
        path = p.path(roll_out(self.primitive, case.x.shape[1], case.timing))
        least = self.config.least_amplitude * (path.amax(-1) - path.amin(-1))
        reach = fitted - first
        size = torch.maximum(reach.abs(), least).clamp_min(torch.finfo(least.dtype).tiny)
        change = (goal - fitted) / size
        κ = 1 + change * reach / size if self.config.goal_scaling else torch.ones_like(change)
        aim = first + κ * reach
        doubt = p.mean * change[..., None] / 2
        doubt[..., :3] = 0
        moved = self._scaled(p, κ, aim)
        doubtful = doubt[..., None].expand(*moved.factors.shape[:-1], 1)
        factors = torch.cat([moved.factors, doubtful], -1)
        return replace(moved, factors=factors), (goal - aim)[..., None]

    def _scaled(self, p: Population, κ: Tensor, goal: Tensor) -> Population:
        """Weights scaled by κ, and another goal."""
        scale = κ[..., None].expand_as(p.mean).clone()
        scale[..., :2], scale[..., 2] = 1, 0
        shift = torch.zeros_like(scale)
        shift[..., 2] = goal
        return p.affine(scale, shift)

    def _whole(self, frames: int) -> list[Timing]:
        """Possible timings of a complete movement of ``frames`` frames."""
        return [Timing(frames - 1.0)] if self.config.kind == "discrete" else self._timings(frames)

    def _timings(self, frames: int) -> list[Timing]:
        """Possible timings of a movement whose first ``frames`` frames are known."""
        pairs = zip(self.units.tolist(), self.offsets.tolist(), strict=True)
        timings = [Timing(unit, offset) for unit, offset in pairs]
        going = [t for t in timings if self.config.kind == "rhythmic" or t.unit >= frames]
        return going or [max(timings, key=lambda t: t.unit)]

    def _as_predictive(self, parts: Components, draws: int) -> Predictive:
        noise = (self.noise * self.ratio.sqrt()).expand_as(parts.mean)
        return Predictive(
            location=parts.mean,
            noise=noise,
            epistemic=parts.variance.sqrt(),
            draws=parts.draws(draws),
        )

    def _white(self, name: str, *shape: int) -> Tensor:
        zero = self.mean.new_zeros(shape)
        site = dist.Normal(zero, torch.ones_like(zero)).to_event(len(shape))
        value: Tensor = pyro.sample(name, site)
        return value

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.detach().to(self.dtype).clone())

    def _check_fitted(self) -> None:
        if not len(self.units):
            raise NotFittedError("dmp has not been trained: zoo.fit(model, train) comes first")


def _sum(
    terms: list[tuple[Tensor, Population]],
) -> tuple[Tensor, Tensor, Callable[[int], Tensor]]:
    """Mean and variance of the sum of design θ over ``terms``, and its draws."""
    moments = [population.moments(design) for design, population in terms]

    def draw(count: int) -> Tensor:
        parts = [(d @ p.sample(count)[..., None])[..., 0].mT for d, p in terms]
        return torch.stack(parts).sum(0)

    mean, variance = (torch.stack(m).sum(0) for m in zip(*moments, strict=True))
    return mean, variance, draw


def _seen(batch: Batch) -> Bool[Tensor, "sequence time channel"]:
    if batch.mask is None:
        return torch.ones_like(batch.values, dtype=torch.bool)
    return batch.mask


def _seen_whole(batch: Batch) -> Bool[Tensor, "sequence frame channel"]:
    if batch.movement_mask is None:
        return torch.ones_like(batch.movements, dtype=torch.bool)
    return batch.movement_mask


def _hypotheses(kind: str, timings: Sequence[Timing]) -> list[Timing]:
    """Timings that a new movement may have: durations seen, or tempos about those seen."""
    return expected(timings, len(TEMPOS)) if kind == "rhythmic" else durations(timings, COMPONENTS)
