"""Demonstrations of a latent DMP changed: other goals and durations, and switching (89)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.contract.readiness import need
from zoo.inference.laplace import laplace
from zoo.models.filters.latent_dmp import LatentDmp
from zoo.movement.components import ramp
from zoo.movement.plan import Latents
from zoo.movement.response import Response
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Posterior, Wishes

__all__ = ["LatentChanges"]

GOAL_SLACK = 1e-2


class LatentChanges(LatentDmp):
    """What ``VaeDmp`` generates: its path by (75), under forces that are not those recognised."""

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
        frames = self._whole(batch)
        τ, steps = duration * self.pace(frames), round((frames - 1) * duration)
        here = self._latents(guide.draw(batch, draws))
        if goal is not None:
            here = self._aimed(here, self._goal(goal, guide, draws))
        pull, position, velocity = self._pull(here, steps, τ), here.position, here.velocity
        if goal is not None and self.phased:
            pull = self._ended(here, pull, τ)
        if wishes.onto is not None:
            there = self._pull(self._latents(guide.draw(wishes.onto, draws)), steps, τ)
            η = ramp(pull.shape[-2] + 1, wishes.start, wishes.steps)[:, None]
            pull = torch.lerp(pull, there, η.to(pull))
        noise = torch.randn_like(pull) @ self.w_noise
        system = replace(self.system, tau=τ)
        response = Response.of(system, pull.shape[-2] + 1, pull.dtype, pull.device)
        rest = torch.zeros_like(position)
        force = system.stiffness * (pull + noise)
        return self.decode(response.states(position, velocity / τ, rest, force)[0])

    def _pull(
        self, found: Latents, steps: int, τ: float
    ) -> Float[Tensor, "sample sequence step d"]:
        """z^goal + σ_w Ψ w at every step: the forces in units of αβ."""
        basis = self.config.w_scale * self.kernels_at(steps, τ).to(found.w)
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
        self, found: Latents, pull: Float[Tensor, "sample sequence step d"], τ: float
    ) -> Float[Tensor, "sample sequence step d"]:
        """The attractor moved so that the path without noise ends at the goal, not on its way."""
        system = replace(self.system, tau=τ)
        response = Response.of(system, pull.shape[-2] + 1, pull.dtype, pull.device)
        rest, force = torch.zeros_like(found.position), system.stiffness * pull
        path = response.states(found.position, found.velocity / τ, rest, force)[0]
        ones = system.stiffness * pull.new_ones(pull.shape[-2], 1)
        gain = response.product(pull.new_zeros(2, 1), ones)[0][-1]
        return pull + ((found.goal - path[..., -1, :]) / gain).unsqueeze(2)
