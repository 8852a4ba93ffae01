"""Movements brought onto a common basis, with all that is learned of them before Σ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.models.primitives.alignment import basis_timings
from zoo.models.primitives.cross_fitting import Prepared
from zoo.models.primitives.rollout import kernel_values
from zoo.models.primitives.synergies import synergies_of
from zoo.models.primitives.weight_learning import Single, similarity, views_of
from zoo.models.primitives.weights import Basis
from zoo.movement.timing import Expected, Kind, Movements, Timing, duration, period_of, phases

__all__ = ["Preparation"]

TEMPOS, DIRECTIONS = 9, 32
CHOICES = (1.0, *(1.25 ** (k / 10) for k in range(-10, 11) if k))


@dataclass(frozen=True)
class Preparation:
    """Kind and number of kernels, number of synergies, and the period in s where it is known."""

    kind: Kind
    kernels: int
    synergies: int | None
    period: float | None

    def basis(
        self, synergies: Float[Tensor, "channel synergy"], frames: int, timing: Timing
    ) -> Basis:
        """φ and S of ``frames`` frames."""
        return Basis(kernel_values(self.kind, self.kernels, frames, timing), synergies)

    def of(self, movements: Movements, rate: float | None, rows: Sequence[int]) -> Prepared:
        """Some of the movements; nothing of the others is used."""
        some, rhythmic = [movements[i] for i in rows], self.kind == "rhythmic"
        values, mask = (torch.cat([m[j] for m in some])[None] for j in (0, 1))
        synergies, offset = synergies_of(values, mask, self.synergies)
        basis = partial(self.basis, synergies)
        inside = [((x - offset) * seen, seen) for x, seen in some]
        choices = self._choices(inside, rate)
        timings = basis_timings(basis, inside, choices) if rhythmic else choices
        views = views_of(basis, inside, timings)
        single = Single.of(views, similarity(self.kernels, circular=rhythmic))
        expected = Expected.of(self.kind, timings, TEMPOS, DIRECTIONS)
        return Prepared(basis, synergies, offset, views, single, expected)

    def _choices(self, movements: Movements, rate: float | None) -> list[Timing]:
        """Durations of discrete movements; all tempos and phases of rhythmic ones."""
        if self.kind == "discrete":
            return [duration(len(x)) for x, _ in movements]
        middle = period_of(movements) if self.period is None else self.period * (rate or 1.0)
        return phases(middle, CHOICES, DIRECTIONS)
