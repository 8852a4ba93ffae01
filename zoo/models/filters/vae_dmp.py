"""Dynamic movement primitives in the latent space of a time-dependent variational autoencoder."""

from __future__ import annotations

from dataclasses import replace

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor

from zoo.contract.readiness import need
from zoo.inference.laplace import laplace
from zoo.models.filters.latent_dmp import Config
from zoo.models.filters.latent_path_prior import PRIOR_DRAWS, LatentPathPrior, observed
from zoo.movement.components import ramp
from zoo.movement.lengths import check_whole
from zoo.movement.plan import Latents, Plan
from zoo.movement.response import Response
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Posterior, Wishes

__all__ = ["Config", "VaeDmp"]

GOAL_SLACK = 1e-2


class VaeDmp(LatentPathPrior):
    r"""Movements as latent DMPs with process noise, decoded frame by frame (thesis §6.2).

    With s = (z*, ż), β = α/4 and dt = 1/(n − 1)::

        w ~ N(0, I),  z^goal, z_t ~ N(0, I),  ż_1 = σ_ż v,  v ~ N(0, I),  z* = g(z)
        s_{t+1} = A s_t + [dt, 1]ᵀ (αβ z*^goal + f_t + ε_{t+1}) dt,       (74)–(77)
        f_t = αβ σ_w Ψ(s_t) w,  ε = αβ ε̂ w_ε,  ε̂ ~ N(0, I)
        x_t ~ N(μ(z*_t), diag σ²),  σ constant in time                    (82), (83)

    Every window is observed twice, with z*_t rolled out (81) and with z*_t = g(z_t) of its own
    (80). Choices where the thesis is silent: g(z) = z + MLP(z); ż_1 has a Gaussian prior of its own
    and is recognised from the first two frames; σ = s² + floor.

    The program gives reconstructions, new goals, durations and switches. Forecasts and imputation
    are not those of its p(w), p(z^goal), (76)–(78), which know neither w nor goal of a new
    movement: they are those of a model of its own, the *latent path prior*. After training, the
    latents of the training movements become a mixture over latent paths, with what the paths leave
    of the encoded frames as a stationary process in place of ε; it is conditioned exactly on the
    frames observed (:class:`~zoo.movement.paths.PathPrior`). ``python -m
    benchmarks.latent_path_prior`` takes the two apart. A frame observed in part is a Gaussian at
    the mode of p(z | x_seen), which the decoder gives. σ is estimated again on movements that the
    networks were not trained on, where there are any (:meth:`learn_noise`). Movements must have one
    common length, and end there.
    N. Chen, M. Karl, P. van der Smagt, *Dynamic movement primitives in latent space of
    time-dependent variational autoencoders*, Humanoids 2016.
    """

    def forward(self, batch: Batch) -> None:
        """The Pyro program: both sub-sequence lengths, (80) and (81), observe the window (82)."""
        windows, time = batch.values.shape[:2]
        latent = self.latent_dim
        unit = dist.Normal(self.basis.new_zeros(()), self.basis.new_ones(()), validate_args=False)
        rows = len(batch.movements)
        with pyro.plate("movements", batch.total_sequences, subsample=torch.arange(rows)):
            plan = self.plan(rows)
        with pyro.plate("windows", batch.total, subsample=torch.arange(windows)):
            z = pyro.sample("z", unit.expand([windows, time, latent]).to_event(2))
            velocity = pyro.sample("velocity", unit.expand([windows, latent]).to_event(1))
            ε = pyro.sample("epsilon", unit.expand([windows, time - 1, latent]).to_event(2))
            path = self.paths(z, velocity, plan, ε, batch)
            if self.config.flatness:
                pyro.factor("flatness", self.flatness_prior(path))
            mean = self.decoder(torch.stack([path, self.embed(z)]))
            for name, frames in zip(("x", "x_single"), mean, strict=True):
                x = dist.Normal(frames, self.output_std, validate_args=False)
                if batch.mask is not None:
                    x = x.mask(batch.mask)
                pyro.sample(name, x.to_event(2), obs=batch.given(batch.values))

    def plan(self, rows: int) -> Plan:
        """The sites of ``rows`` movements."""
        zero = self.basis.new_zeros(rows, self.latent_dim)
        unit = dist.Normal(zero, 1.0, validate_args=False).to_event(1)
        return Plan(
            w=pyro.sample("w", self.forcing_prior(rows)),
            goal=pyro.sample("goal", unit),
            start=pyro.sample("start", unit) if self.goal_scaling else None,
        )

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Paths z* with the recognised noise."""
        return Predictive(location=self._posterior_paths(batch, posterior, draws), joint=True)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Whole movements through the DMP with the recognised w, goal, start and noise."""
        return self.decode(self._posterior_paths(batch, posterior, draws))

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Joint draws of the future, given the encoded frames seen; phase 0 is the first frame."""
        seen = batch.values.shape[1]
        paths = self._conditioned(batch, need(posterior), seen + horizon).sample(draws)
        return self.decode(paths[:, :, seen:])

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Joint draws of whole movements given the entries seen."""
        paths = self._conditioned(batch, need(posterior), batch.values.shape[1]).sample(draws)
        return self.decode(paths)

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Goal changes (§6.2.5), other durations and switching (89), with noise from its prior."""
        guide, goal, duration = need(posterior), wishes.goal, wishes.duration
        here = self._latents(guide.draw(batch, draws))
        if goal is not None:
            here = self._aimed(here, self._goal(goal, guide, draws))
        pull, position, velocity = self._pull(here, duration), here.position, here.velocity
        if goal is not None and self.phased:
            pull = self._ended(here, pull, duration)
        if wishes.onto is not None:
            there = self._pull(self._latents(guide.draw(wishes.onto, draws)), duration)
            η = ramp(pull.shape[-2] + 1, wishes.start, wishes.steps)[:, None]
            pull = torch.lerp(pull, there, η.to(pull))
        noise = torch.randn_like(pull) @ self.w_noise
        system = replace(self.system, tau=duration)
        response = Response.of(system, pull.shape[-2] + 1, pull.dtype, pull.device)
        rest = torch.zeros_like(position)
        force = system.stiffness * (pull + noise)
        return self.decode(response.states(position, velocity / duration, rest, force)[0])

    def learn_noise(self, batch: Batch, posterior: Posterior) -> None:
        """σ of movements that no network was trained on, never below what training found.

        σ² = E_q (x − μ(g(z)))² is what maximises their bound (80); a decoder fits the frames that
        it was trained on better than others.
        """
        z = posterior.encode(batch.values, batch.mask).sample((PRIOR_DRAWS,))
        error = (self.decoder(self.embed(z)) - batch.values).square().mean(0)
        mask = observed(batch)
        mean = (error * mask).sum((0, 1)) / mask.sum((0, 1)).clamp(min=1)
        std = torch.maximum(mean.sqrt(), self.output_std)
        self.output_root.copy_((std - self.config.output_floor).sqrt())

    def _pull(self, found: Latents, duration: float) -> Float[Tensor, "sample sequence step d"]:
        """z^goal + σ_w Ψ w at every step: the forces in units of αβ."""
        steps = round((self.frames - 1) * duration)
        basis = self.config.w_scale * self.kernels_at(steps, duration).to(found.w)
        return found.goal.unsqueeze(2) + basis @ found.w

    def _goal(self, x: Tensor, guide: Posterior, draws: int) -> Tensor:
        """z* of frames to end at, by the decoder: an encoder knows only frames like its own."""
        start = guide.encode(x).mean
        known = laplace(lambda z: self.decoder(self.embed(z)), start, x, self.output_std)
        return self.embed(known.sample((draws,)))

    def _aimed(self, found: Latents, goal: Float[Tensor, "sample sequence d"]) -> Latents:
        """Another goal, the forcing term multiplied by (g − y_0)/(g_fit − y_0), §6.2.5."""
        if self.goal_scaling:
            return replace(found, w=self.scaled(found.plan.w, goal, found.position), goal=goal)
        old, new = found.goal - found.position, goal - found.position
        ratio = (new * old + GOAL_SLACK) / (old.square() + GOAL_SLACK)
        return replace(found, w=found.w * ratio.unsqueeze(2), goal=goal)

    def _ended(
        self, found: Latents, pull: Float[Tensor, "sample sequence step d"], duration: float
    ) -> Float[Tensor, "sample sequence step d"]:
        """The attractor moved so that the path without noise ends at the goal, not on its way."""
        system = replace(self.system, tau=duration)
        response = Response.of(system, pull.shape[-2] + 1, pull.dtype, pull.device)
        rest, force = torch.zeros_like(found.position), system.stiffness * pull
        path = response.states(found.position, found.velocity / duration, rest, force)[0]
        ones = system.stiffness * pull.new_ones(pull.shape[-2], 1)
        gain = response.product(pull.new_zeros(2, 1), ones)[0][-1]
        return pull + ((found.goal - path[..., -1, :]) / gain).unsqueeze(2)

    def _paths(self, drawn: dict[str, Tensor], batch: Batch, draws: int) -> Tensor:
        flat = {name: value.flatten(0, 1) for name, value in drawn.items()}
        first, velocity, ε = flat["z"][:, 0], flat["velocity"], flat["epsilon"]
        path = self.path(first, velocity, Plan.of(flat), ε, batch.repeat(draws))
        split: Tensor = path.unflatten(0, (draws, len(batch)))
        return split

    def _posterior_paths(self, batch: Batch, posterior: Posterior | None, draws: int) -> Tensor:
        check_whole(self.label, self.frames, batch.values.shape[1])
        return self._paths(need(posterior).draw(batch, draws), batch, draws)

    def decode(self, paths: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z*_t)."""
        location = self.decoder(paths.to(self.output_root))
        return Predictive(location=location, noise=self.output_std, joint=True)
