"""Dynamic movement primitives with uncertainty: `dmp`, `dmp-rhythmic`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from zoo.datasets.records import Sequences
from zoo.dynamics.alignment import durations
from zoo.dynamics.components import Components, Paths, alike, ramp, resample
from zoo.dynamics.dmp import Response
from zoo.dynamics.imitation import trajectory_matrix
from zoo.dynamics.kalman import PathNoise
from zoo.dynamics.learning import Learning, learn
from zoo.dynamics.population import Population
from zoo.dynamics.rollout import Primitive, Timing, roll_out
from zoo.dynamics.sums import Sight, Sums, sights
from zoo.dynamics.timing import TEMPOS, expected
from zoo.errors import NotFittedError
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["DMP", "Config"]

COMPONENTS = 16


@dataclass(frozen=True)
class Case:
    """Movements with the same entries seen and one timing: p(θ | x) of each."""

    population: Population
    sight: Sight
    timing: Timing
    x: Float[Tensor, "sequence time channel"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`DMP`; times are in units of the movement's duration or period.

    ``learning`` is ``path``, the conjugate posterior of w under white noise of the path; ``force``,
    that under white noise of f_target; or ``lwr``, locally weighted regression (61). ``beta`` None
    is α/4, critical damping. ``gated`` multiplies the forcing term by the phase s. ``period`` of
    rhythmic movements is in s; None finds it by autocorrelation. ``goal_scaling`` scales the
    forcing term by (g − y₁) when the goal is changed; joints whose fitted |g − y₁| is below
    ``least_amplitude`` (scaled units) are scaled less.
    """

    kind: Literal["discrete", "rhythmic"] = "discrete"
    learning: Learning = "path"
    kernels: int = 20
    alpha: float = 25.0
    beta: float | None = None
    gated: bool = False
    period: float | None = None
    goal_scaling: bool = True
    least_amplitude: float = 0.1

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

    so that f_target ~ N(Ψ(s)w, σ_f²), (59). θ = (y₁, ẏ₁, g, w) is Gaussian over movements, with
    factors that joints share and a part of each joint alone; how much is shared is chosen by the
    density of movements left out. As positions are linear in θ and ε, forecasts, filled gaps, other
    goals, durations and switching (89) are exact Gaussians given the timing. A forecast conditions
    weights, goal and first state on the frames seen. Where training movements differ in duration,
    and for rhythmic movements in tempo and phase, it is a mixture over these timings.

    Thesis §2.2.1, (53)–(62), §6.2.4, §6.2.5; Ijspeert et al., *Dynamical movement primitives*,
    Neural Computation 25 (2013); Gaussian weights over movements as Paraschos et al.,
    *Probabilistic movement primitives*, NIPS 2013. Defaults: 20 kernels (§5.3.2), α = 25, β = α/4,
    no gate on the forcing term as in (54), widths of Ijspeert's code. Prior variance of w by
    evidence maximisation, σ² and ρ by the likelihood of the residuals. ``epistemic`` is the spread
    of the path y, of θ and of the forces ε; ``noise`` that of the observation.

    It cannot know spread over movements from a single one: its first state and goal then get the
    spread over time. Variances and period are point estimates. Steps must be short against the
    movement: some 17 frames at least with α = 25.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    mean: Tensor
    factors: Tensor
    private: Tensor
    noise: Tensor
    ratio: Tensor
    shrinkage: Tensor
    units: Tensor
    offsets: Tensor

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
        for name in ("shrinkage", "units", "offsets"):
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
        self._keep("ratio", found.ratio)
        self._keep("shrinkage", self.mean.new_tensor(found.shrinkage))
        self._keep("units", self.mean.new_tensor([t.unit for t in timings]))
        self._keep("offsets", self.mean.new_tensor([t.offset for t in timings]))

    def forward(self, batch: Batch) -> Float[Tensor, "sequence frame channel"]:
        """The generative program of the whole movements of ``batch``."""
        frames, channels = batch.movements.shape[1:]
        timing = self._whole(frames)[0]
        rows = torch.arange(len(batch.movements))
        with pyro.plate("movements", size=batch.total_sequences, subsample=rows):
            a = self._white("shared", self.factors.shape[-1])
            δ = self._white("private", channels, self.primitive.kernels + 3)
            ε = self._white("force", frames - 1, channels)
            shared = torch.einsum("cpr,sr->scp", self.factors, a)
            θ = self.mean + shared + torch.einsum("cpq,scq->scp", self.private, δ)
            path = θ @ roll_out(self.primitive, frames, timing).mT
            y = path.mT + self.noise * self._noise(frames, timing).paths(ε)
            noise = dist.Normal(y, self.noise * self.ratio.sqrt())
            if batch.movement_mask is not None:
                noise = noise.mask(batch.movement_mask)
            pyro.sample("x", noise.to_event(2), obs=batch.movements)
        return y

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Fresh roll-outs of the weights, goal and first state that the movements have."""
        frames = batch.values.shape[1]

        def render(case: Case) -> Paths:
            design = roll_out(self.primitive, frames, case.timing)
            return self._paths([(design, case.population)], self._noise(frames, case.timing))

        parts = self._mixture(batch.values, _seen(batch), self._whole(frames), 1, render)
        return self._as_predictive(parts, draws)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries seen."""
        timings = self._whole(batch.values.shape[1])
        count = 1 if len(timings) == 1 else COMPONENTS
        return self._as_predictive(self._filled(batch.values, _seen(batch), timings, count), draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        self._check_fitted()
        pad = (0, 0, 0, horizon)
        values, seen = functional.pad(batch.values, pad), functional.pad(_seen(batch), pad)
        known = batch.values.shape[1]
        count = 1 if len(self.units) == 1 else COMPONENTS
        parts = self._filled(values, seen, self._timings(known), count)
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
        goal scaling, the forcing term is scaled by (g' − y₁)/(g − y₁).
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
                terms[-1] = (terms[-1][0], self._moved(terms[-1][1], goal[i : i + 1]))
            return self._paths(terms, self._noise(frames, timing))

        parts = [mix(i, case) for i, case in enumerate(self._demonstrated(batch, len(batch)))]
        return self._as_predictive(Components.of(parts), draws)

    def _filled(
        self, values: Tensor, seen: Tensor, timings: list[Timing], count: int
    ) -> Components:
        return self._mixture(values, seen, timings, count, self._follow)

    def _mixture(
        self,
        values: Tensor,
        seen: Tensor,
        timings: list[Timing],
        count: int,
        render: Callable[[Case], Paths],
    ) -> Components:
        """A mixture over timings, resampled to ``count`` components (1: the likeliest timing).

        Residuals of joints go together, so that all joints count as one: evidence a joint.
        """
        self._check_fitted()
        parts = Components.empty(count, values)
        for rows, mask in alike(seen):
            x = values[rows] * mask
            views = sights(self.primitive, timings, self.ratio, mask)
            sums = self._sums(views, timings, x)
            evidence = torch.stack([self._evidence(s) for s in sums])
            picks = resample(evidence / len(self.noise), count)
            for i in picks.unique().tolist():
                some = (picks == i).any(0)
                case = self._case(views[i], timings[i], x[some], sums[i].of_movements(some))
                parts.put(rows[some], picks[:, some] == i, render(case))
        return parts

    def _sums(self, views: list[Sight], timings: list[Timing], x: Tensor) -> list[Sums]:
        """What the movements say of θ in the light of every timing."""
        errors: dict[float, Tensor] = {}
        for view, timing in zip(views, timings, strict=True):
            if timing.unit not in errors:
                errors[timing.unit] = view.errors(x)
        pairs = zip(views, timings, strict=True)
        return [v.sums(errors[t.unit], len(x), x.shape[1]) for v, t in pairs]

    def _case(self, view: Sight, timing: Timing, x: Tensor, sums: Sums) -> Case:
        population = self.population.condition(*self._likelihood(sums))
        return Case(population, view, timing, x)

    def _demonstrated(self, batch: Batch, count: int) -> list[Case]:
        """The likeliest timing of every movement and its posterior."""
        if len(batch) not in (1, count):
            raise ValueError(f"onto has {len(batch)} movements; 1 or {count} are needed")
        timings, cases = self._whole(batch.values.shape[1]), dict[int, Case]()
        for rows, mask in alike(_seen(batch)):
            x = batch.values[rows] * mask
            views = sights(self.primitive, timings, self.ratio, mask)
            sums = self._sums(views, timings, x)
            best = torch.stack([self._evidence(s) for s in sums]).argmax(0)
            for j, (row, i) in enumerate(zip(rows.tolist(), best.tolist(), strict=True)):
                one = torch.tensor([j])
                cases[row] = self._case(views[i], timings[i], x[one], sums[i].of_movements(one))
        return [cases[i if len(batch) == count else 0] for i in range(count)]

    def _likelihood(self, sums: Sums) -> tuple[Tensor, Tensor]:
        variance = self.noise.square()
        return sums.precision / variance[:, None, None], sums.linear / variance[:, None]

    def _evidence(self, sums: Sums) -> Float[Tensor, " sequence"]:
        """log p(x) of the entries observed, given the timing."""
        variance = self.noise.square()
        white = -(sums.square / variance + sums.count * (2 * math.pi * variance).log()) / 2
        at_zero = (white - sums.log_volume).sum(-1)
        return at_zero + self.population.log_evidence(*self._likelihood(sums))

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

    def _moved(self, population: Population, goal: Float[Tensor, "1 channel"]) -> Population:
        """The population with another goal, its forcing term scaled along."""
        fitted = population.mean[..., 2]
        reach = fitted - population.mean[..., 0]
        least = self.config.least_amplitude**2
        κ = 1 + (goal - fitted) * reach / reach.square().clamp_min(least)
        if self.config.kind == "rhythmic" or not self.config.goal_scaling:
            κ = torch.ones_like(κ)
        scale = κ[..., None].repeat(1, 1, population.mean.shape[-1])
        scale[..., :2], scale[..., 2] = 1, 0
        shift = torch.zeros_like(scale)
        shift[..., 2] = goal
        return population.affine(scale, shift)

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


def _hypotheses(kind: str, timings: Sequence[Timing]) -> list[Timing]:
    """Timings that a new movement may have: durations seen, or tempos about those seen."""
    return expected(timings, len(TEMPOS)) if kind == "rhythmic" else durations(timings, COMPONENTS)
