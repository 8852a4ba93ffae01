"""The guide of a filter over limit cycles: timing by a template, frames folded onto a circle."""

from __future__ import annotations

from typing import Protocol

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.guides.filtering import Config, FilteringGuide, LatentDynamics, normal
from zoo.guides.template import ROWS, learn_template, match
from zoo.movement.plan import Plan
from zoo.types import Batch, Layout

__all__ = ["Config", "RhythmicDynamics", "RhythmicGuide"]


class RhythmicDynamics(LatentDynamics, Protocol):
    """A latent state whose forcing term has a phase and a tempo."""

    period: Tensor

    def rhythm(
        self, phase: Float[Tensor, " sequence"], tempo: Float[Tensor, " sequence"], frames: int
    ) -> Float[Tensor, "sequence frame kernel"]:
        """Kernels of the phase at every frame."""
        ...


class RhythmicGuide(FilteringGuide):
    """As :class:`~zoo.guides.filtering.FilteringGuide`, with phase and tempo of every movement.

    Both are points: where a template of one period, learned from the training movements before all
    else, is nearest to the movement (:mod:`zoo.guides.template`). w is (88) of frames folded onto
    the circle, g_2(Σ_t Ψ_k(s_t) g_1(x_t) / Σ_t Ψ_k(s_t)), so that neither where a movement begins
    nor how fast it is matters; the centre is encoded from the mean of the frames' encodings.
    """

    template: Tensor

    def __init__(self, layout: Layout, model: RhythmicDynamics, config: Config) -> None:
        """Networks for ``layout``'s channels and the latent state of ``model``."""
        super().__init__(layout, model, config)
        self.register_buffer("template", torch.zeros(ROWS, len(layout.channels)))

    def prepare(self, data: Sequences) -> None:
        """Learn the template."""
        values, period = data.values.double(), float(self._rhythmic.period)
        self.template.copy_(learn_template(values, data.mask, period))

    def plan(self, batch: Batch) -> Plan:
        """What is recognised of whole movements."""
        x, mask = batch.movements, batch.movement_mask
        with torch.no_grad():
            φ, λ = match(x, mask, self.template, float(self._rhythmic.period)).unbind(1)
        return Plan(
            phase=pyro.sample("phase", dist.Delta(φ)),
            tempo=pyro.sample("tempo", dist.Delta(λ)),
            w=pyro.sample("w", self.forcing(self._folded(x, mask, φ, λ))),
            goal=pyro.sample("goal", normal(self._centre(x, mask), 1)),
        )

    @property
    def places(self) -> int:
        """Kernels on the circle."""
        return self._dynamics.kernels

    @property
    def _rhythmic(self) -> RhythmicDynamics:
        model: RhythmicDynamics = self.__dict__["_model"]
        return model

    def _folded(
        self,
        x: Float[Tensor, "sequence frame channel"],
        mask: Bool[Tensor, "sequence frame channel"] | None,
        phase: Tensor,
        tempo: Tensor,
    ) -> Float[Tensor, "sequence kernel feature"]:
        Ψ = self._rhythmic.rhythm(phase, tempo, x.shape[1])
        if mask is not None:
            Ψ = Ψ * mask.any(-1, keepdim=True)
        share = Ψ / Ψ.sum(1, keepdim=True).clamp_min(torch.finfo(Ψ.dtype).tiny)
        folded: Tensor = share.mT @ self.g_1(x)
        return folded

    def _centre(
        self,
        x: Float[Tensor, "sequence frame channel"],
        mask: Bool[Tensor, "sequence frame channel"] | None,
    ) -> tuple[Tensor, Tensor]:
        """Mean over the frames of the encodings' moments."""
        seen = x.new_ones(*x.shape[:2], 1) if mask is None else mask.any(-1, keepdim=True).to(x)
        share = seen / seen.sum(1, keepdim=True).clamp_min(1)
        mean, std = (share * moment for moment in self._encode(x))
        return mean.sum(1), std.sum(1)
