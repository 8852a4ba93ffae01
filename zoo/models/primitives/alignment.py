"""Durations of movements, and tempo and phase of repeated ones by a common template."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.models.primitives.weights import Basis
from zoo.movement.rollout import Timing
from zoo.movement.sufficient_statistics import Movements

__all__ = ["BasisOf", "align", "durations"]

BasisOf = Callable[[int, Timing], Basis]


def align(
    basis: BasisOf, movements: Movements, choices: Sequence[Timing], rounds: int = 3
) -> list[Timing]:
    """Timing of every movement, against the longest one first and then against all.

    The template is the least-squares path of the movements as they lie; each movement takes the
    choice whose template is nearest over the entries seen.
    """

    @lru_cache(maxsize=4)
    def all_of(frames: int) -> tuple[Tensor, Tensor]:
        bases = [basis(frames, choice) for choice in choices]
        return torch.stack([b.phases for b in bases]), bases[0].synergies

    longest = max(range(len(movements)), key=lambda i: len(movements[i][0]))
    timings, chosen = [choices[0]] * len(movements), [longest]
    for _ in range(rounds):
        pooled = [(movements[i], timings[i]) for i in chosen]
        template = _template(basis, pooled)
        near = [_nearest(*all_of(len(x)), x, seen, template) for x, seen in movements]
        timings = [choices[i] for i in near]
        chosen = list(range(len(movements)))
    return timings


def durations(found: Sequence[Timing], count: int) -> list[Timing]:
    """At most ``count`` of the durations of movements, evenly ranked.

    >>> [t.unit for t in durations([Timing(5.0), Timing(9.0), Timing(6.0)], 2)]
    [5.0, 9.0]
    """
    units = sorted({t.unit for t in found})
    ranks = torch.linspace(0, len(units) - 1, min(count, len(units))).round().int().tolist()
    return [Timing(units[rank]) for rank in ranks]


def _template(
    basis: BasisOf, pooled: Sequence[tuple[tuple[Tensor, Tensor], Timing]]
) -> Float[Tensor, " weight"]:
    parts = [(basis(len(x), timing), x, seen) for (x, seen), timing in pooled]
    total = torch.stack([b.precision(seen.to(x)) for b, x, seen in parts]).sum(0)
    linear = torch.stack([b.linear(x * seen) for b, x, seen in parts]).sum(0)
    ridge = 1e-6 * total.diagonal().mean() * torch.eye(len(total), dtype=total.dtype)
    template: Tensor = torch.linalg.solve(total + ridge, linear)
    return template


def _nearest(φ: Tensor, synergies: Tensor, x: Tensor, seen: Tensor, template: Tensor) -> int:
    """The choice that makes Σ (y² − 2xy) of the template's path y over the entries seen least."""
    table = synergies @ template.unflatten(0, (synergies.shape[1], φ.shape[2]))
    square = torch.einsum("tc,ck,cl->tkl", seen.to(x), table, table)
    own = torch.einsum("htk,tkl,htl->h", φ, square, φ)
    return int((own - 2 * torch.einsum("htk,tk->h", φ, (x * seen) @ table)).argmin())
