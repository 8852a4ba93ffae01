"""VAE-DMP with the rhythmic transition (57), (58), for movements that repeat themselves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.settings import Positive, settings
from zoo.datasets.records import Sequences
from zoo.errors import NotFittedError
from zoo.models.filters import latent_dmp
from zoo.models.filters.cycles import CyclePrior
from zoo.models.filters.latent_path_prior import PRIOR_DRAWS
from zoo.models.filters.vae_dmp import VaeDmp
from zoo.movement.demonstrations import extremes, seen_entries
from zoo.movement.lengths import checked_span
from zoo.movement.plan import Latents, Plan
from zoo.movement.response import ALPHA_FRAME, Response, rhythmic_basis
from zoo.movement.timing import period_of, tempos
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "RhythmicVaeDmp"]

GRID, COARSE = (48, 9), (16, 5)
SETTLING = 40.0


@settings
class Config(latent_dmp.Config):
    """As of :class:`~zoo.models.filters.vae_dmp.VaeDmp`, but α is 0.4 a frame where it is None.

    ``kernels`` lie on the circle; ``period`` is in s, None finds it by autocorrelation; the log of
    a movement's tempo over the usual one has the prior N(0, ``tempo_scale``²).
    """

    kernels: Annotated[int, Field(ge=2)] = 12
    period: Positive | None = None
    tempo_scale: Positive = 0.1

    def __post_init__(self) -> None:
        """Refuse what belongs to discrete movements."""
        super().__post_init__()
        if self.goal_scaling:
            raise ValueError("goal_scaling is for movements with an end; rhythmic ones have none")


class RhythmicVaeDmp(VaeDmp):
    r"""Movements as latent limit cycles with process noise, decoded frame by frame.

    As :class:`~zoo.models.filters.vae_dmp.VaeDmp`, with the rhythmic canonical system in place of
    (55)::

        φ ~ U(−π, π),  λ ~ N(0, σ_λ²),   s_t = φ + 2π e^λ t / P
        f_t = αβ σ_w Ψ(s_t) w,   Ψ_i(s) ∝ exp(h (cos(s − c_i) − 1))         (57), (58)

    φ is the phase at a movement's first frame, λ the log of its tempo over the usual one of a
    period P, and z^goal the centre it swings about. Thesis §2.2.1 gives the rhythmic primitive,
    §6.2 the model; the two together are a choice of this package, after Ijspeert et al.,
    *Dynamical movement primitives*, Neural Computation 25 (2013).

    Forecasts and imputation are those of a latent path prior, not of the program's p(w), p(φ): they
    condition a mixture over limit cycles, the weights and centres of the training movements, at
    every phase and at tempos like those found, with what their cycles leave as a stationary process
    (:class:`~zoo.models.filters.cycles.CyclePrior`). Another goal is another centre; another
    duration stretches the period. Movements may last unlike long; a forecast may start in any
    phase, and go on for any time.
    """

    config_class: ClassVar[type] = Config
    label: ClassVar[str] = "vae-dmp-rhythmic"
    phased: ClassVar[bool] = False
    config: Config

    period: Tensor
    prior_timings: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """A model of the movements of ``layout``, however long each of them lasts."""
        shortest, frames = checked_span(self.label, layout)
        alpha = ALPHA_FRAME * (frames - 1) if config.alpha is None else config.alpha
        one_length = replace(layout, frames=frames, span=None)
        super().__init__(one_length, replace(config, alpha=alpha))
        self.shortest, self.is_ragged = shortest, shortest < frames
        period = self.frames - 1.0 if config.period is None else config.period * (layout.rate or 1)
        self.register_buffer("period", torch.tensor(period))
        self.register_buffer("prior_timings", torch.empty(0))

    def prepare(self, data: Sequences) -> None:
        """Find the period of the training movements, unless it is a setting."""
        if self.config.period is None:
            ends = zip(data.values, data.mask, data.lengths.tolist(), strict=True)
            found = period_of([(x[:n].cpu(), seen[:n].cpu()) for x, seen, n in ends])
            self.period.fill_(found)

    def rhythm(
        self,
        phase: Float[Tensor, " sequence"],
        tempo: Float[Tensor, " sequence"],
        frames: int,
        *,
        duration: float = 1.0,
        before: int = 0,
    ) -> Float[Tensor, "sequence frame kernel"]:
        """Ψ of every frame, from ``before`` frames before the first one on."""
        time = torch.arange(-before, frames, dtype=phase.dtype, device=phase.device)
        period = self.period.to(phase) * duration * (-tempo).exp()
        return rhythmic_basis(
            time, kernels=self.kernels, period=period[:, None], offset=phase[:, None]
        )

    def plan(self, rows: int) -> Plan:
        """The sites of ``rows`` movements."""
        zero = self.basis.new_zeros(rows)
        circle = dist.Uniform(zero - math.pi, zero + math.pi, validate_args=False)
        tempo = dist.Normal(zero, zero + self.config.tempo_scale, validate_args=False)
        unit = dist.Normal(self.basis.new_zeros(rows, self.latent_dim), 1.0, validate_args=False)
        return Plan(
            phase=pyro.sample("phase", circle),
            tempo=pyro.sample("tempo", tempo),
            w=pyro.sample("w", self.forcing_prior(rows)),
            goal=pyro.sample("goal", unit.to_event(1)),
        )

    def lengths(self, batch: Batch) -> None:
        """None: all go by the clock of one period, however long they last."""

    def pace(self, frames: int) -> float:
        """1, of any movement."""
        return 1.0

    def forcing(
        self, w: Float[Tensor, "sequence kernel latent"], plan: Plan, batch: Batch
    ) -> Float[Tensor, "step sequence latent"]:
        """f_t in units of αβ of every step of whole movements, time-major."""
        phase, tempo = timed(plan)
        Ψ = self.config.w_scale * self.rhythm(phase, tempo, batch.movements.shape[1] - 1)
        return torch.einsum("utk,ukl->tul", Ψ, w)

    def learn_prior(self, batch: Batch, posterior: Posterior) -> None:
        """Keep weights, centres and timings of the training movements, and what they leave.

        What shorter ones leave is scaled, as the process is estimated per frame of the longest.
        """
        self.reached = extremes(batch.values, seen_entries(batch))
        drawn = posterior.draw(batch, PRIOR_DRAWS)
        found = self._latents(drawn)
        rows = torch.cat([found.w, found.goal.unsqueeze(2)], dim=2)
        self.prior_movements = rows.mean(0).detach()
        self.prior_timings = torch.stack([drawn["phase"][0], drawn["tempo"][0]], dim=1).detach()
        frames = self._observe(batch, posterior)
        seen, timings = self._frames_seen(batch), self.prior_timings.double()
        cycles = self._cycles(timings, self.frames) @ self.prior_movements.double()
        share = (batch.frames / self.frames).double()[:, None, None]
        residuals = (frames.double() - cycles) * seen[..., None] / share.sqrt()
        self.prior_residuals = residuals.to(frames).detach()
        self.prior_shape = frames.new_empty(0)
        end, lengths = self.shortest, (self.shortest // 7, self.shortest // 3)
        prior, readout = self._prior(end, COARSE), self._readout(frames[:, :end])
        truth = cycles[:, :end] + ((frames - cycles) * seen[..., None])[:, :end]
        tuned = prior.tuned(truth, lengths, readout, self.prior_without)
        self.prior_shape = frames.new_tensor(tuned.shape)

    def prior_without(self, row: int) -> CyclePrior:  # type: ignore[override]
        """The mixture over limit cycles of all training movements but one."""
        return self._prior(self.shortest, COARSE, torch.arange(len(self.prior_movements)) != row)

    def _prior(  # type: ignore[override]
        self, length: int, grid: tuple[int, int] = GRID, rows: Tensor | None = None
    ) -> CyclePrior:
        """The mixture over limit cycles of ``length`` frames, phases and tempos, in float64."""
        if not self.prior_movements.numel():
            raise NotFittedError(f"{self.label} knows no movements yet; train it by zoo.fit first")
        movements, residuals, observation = self._known(rows)
        tempo = self.prior_timings[slice(None) if rows is None else rows, 1]
        middle, around = tempos(tempo.double().neg().exp(), grid[1])
        λ = -(middle * around).log()
        φ = torch.arange(grid[0], dtype=torch.float64) * (2 * math.pi / grid[0])
        timings = torch.cartesian_prod(φ, λ)
        return CyclePrior(
            self._cycles(timings, length),
            movements.double(),
            residuals.double(),
            observation.double().mean(0),
        ).shaped(self.prior_shape.tolist())

    def _cycles(
        self, timings: Float[Tensor, "timing 2"], length: int
    ) -> Float[Tensor, "timing frame row"]:
        """Φ: answers to each kernel's force and to the goal, long after the beginning."""
        before = math.ceil(SETTLING * (self.frames - 1) / self.system.alpha)
        Ψ = self.rhythm(timings[:, 0], timings[:, 1], length - 1, before=before)
        force = nn.functional.pad(self.config.w_scale * Ψ, (0, 1), value=1.0).movedim(1, 0)
        response = Response.of(self.system, length + before, torch.float64, timings.device)
        rest = force.new_zeros(2, force[0].numel())
        states = response.product(rest, self.system.stiffness * force.flatten(1))[0]
        cycles: Tensor = states[before:].unflatten(1, force.shape[1:]).movedim(0, 1)
        return cycles

    def _pull(
        self, found: Latents, steps: int, τ: float
    ) -> Float[Tensor, "sample sequence step d"]:
        """z^goal + σ_w Ψ w at every step: the forces in units of αβ."""
        phase, tempo = (v.flatten() for v in timed(found.plan))
        Ψ = self.rhythm(phase, tempo, steps, duration=τ).unflatten(0, found.w.shape[:2])
        pull: Tensor = found.goal.unsqueeze(2) + self.config.w_scale * Ψ @ found.w
        return pull

    def _aimed(self, found: Latents, goal: Float[Tensor, "sample sequence d"]) -> Latents:
        """Another centre."""
        return replace(found, goal=goal)


def timed(plan: Plan) -> tuple[Tensor, Tensor]:
    """Phase and tempo of a plan that has them."""
    if plan.phase is None or plan.tempo is None:
        raise ValueError("a rhythmic movement needs its phase and tempo; the plan has none")
    return plan.phase, plan.tempo
