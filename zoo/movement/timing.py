"""Timings of movements: durations, or tempo and phase; which are expected, and how they are found.

The one vocabulary of all movement primitives. A *timing* is a duration or a period, with the phase
at frame 0; *alignment* finds those of training movements, in turn with a template that they share;
*expected* timings are the equally likely ones of a new movement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = [
    "Expected",
    "Kind",
    "Movements",
    "Timing",
    "align",
    "aligned",
    "duration",
    "period_of",
    "phases",
    "tempos",
]

Kind = Literal["discrete", "rhythmic"]
Movements = Sequence[tuple[Float[Tensor, "_time _channel"], Bool[Tensor, "_time _channel"]]]
Template = TypeVar("Template")
Found = TypeVar("Found")

TEMPO_STD = 0.03
DURATIONS = 16
ROUNDS = 3


@dataclass(frozen=True)
class Timing:
    """Frames in a movement's unit of time (its duration or its period) and the phase at frame 0."""

    unit: float
    offset: float = 0.0


@dataclass(frozen=True)
class Expected:
    """Equally likely timings of a new movement."""

    kind: Kind
    timings: tuple[Timing, ...]

    @classmethod
    def of(cls, kind: Kind, found: Sequence[Timing], count: int, directions: int) -> Expected:
        """After those ``found`` of training movements: at most 16 durations, evenly ranked.

        Of rhythmic movements ``count`` tempos about theirs, in each of ``directions`` phases.

        >>> found = [Timing(5.0), Timing(9.0), Timing(6.0)]
        >>> [t.unit for t in Expected.of("discrete", found, 5, 16).timings]
        [5.0, 6.0, 9.0]
        """
        if kind == "rhythmic":
            middle, around = tempos(torch.tensor([t.unit for t in found]), count)
            return cls(kind, tuple(phases(middle, around.tolist(), directions)))
        units = sorted({t.unit for t in found})
        ranks = torch.linspace(0, len(units) - 1, min(DURATIONS, len(units))).round().int()
        return cls(kind, tuple(Timing(units[rank]) for rank in ranks.tolist()))

    @classmethod
    def stored(
        cls, kind: Kind, units: Float[Tensor, " timing"], offsets: Float[Tensor, " timing"]
    ) -> Expected:
        """Those kept as :attr:`units` and :attr:`offsets`."""
        return cls(kind, tuple(map(Timing, units.tolist(), offsets.tolist())))

    @property
    def units(self) -> list[float]:
        """Durations or periods in frames."""
        return [t.unit for t in self.timings]

    @property
    def offsets(self) -> list[float]:
        """Phases at frame 0 in rad."""
        return [t.offset for t in self.timings]

    def whole(self, frames: int) -> list[Timing]:
        """Those of a complete movement of ``frames`` frames."""
        return list(self.timings) if self.kind == "rhythmic" else [duration(frames)]

    def lasting(self, frames: int) -> list[Timing]:
        """Those of a movement that goes on after ``frames`` frames; the longest if none does."""
        going = [t for t in self.timings if self.kind == "rhythmic" or t.unit >= frames]
        return going or [max(self.timings, key=lambda t: t.unit)]


def duration(frames: int) -> Timing:
    """Timing of a discrete movement of ``frames`` frames."""
    return Timing(max(1.0, frames - 1.0))


def period_of(movements: Movements) -> float:
    """Period in frames by the autocorrelation, summed over movements and channels.

    The highest peak after the first zero; without one the longest movement is one period.

    >>> wave = torch.sin(2 * torch.pi * torch.arange(100.0) / 25)[:, None]
    >>> period_of([(wave, torch.ones_like(wave, dtype=torch.bool))])
    25.0
    """
    longest = max(len(x) for x, _ in movements)
    correlation, weight = torch.zeros(2, 3 * longest // 4 + 1, dtype=torch.float64)
    for x, seen in movements:
        y = torch.where(seen, x - x.sum(0) / seen.sum(0).clamp(min=1), 0.0).double()
        for lag in range(min(len(x) - 1, len(correlation))):
            correlation[lag] += (y[lag:] * y[: len(y) - lag]).sum()
            weight[lag] += (seen[lag:] & seen[: len(y) - lag]).sum()
    correlation = correlation / weight.clamp(min=1)
    negative = (correlation < 0).nonzero()
    begin = int(negative[0]) if len(negative) else len(correlation)
    tail = correlation[begin:]
    if not len(tail) or tail.max() < 0.3 * correlation[0]:
        return float(longest - 1)
    return float(begin + int(tail.argmax()))


def phases(period: float, tempos: Sequence[float], directions: int) -> list[Timing]:
    """Timings that a rhythmic movement may have: tempos around ``period``, all over the circle."""
    circle = [2 * math.pi * i / directions for i in range(directions)]
    return [Timing(period * tempo, phase) for tempo in tempos for phase in circle]


def tempos(
    periods: Float[Tensor, " movement"], count: int
) -> tuple[float, Float[Tensor, " count"]]:
    """Middle of some periods, and ``count`` equally likely tempos about it of a new movement.

    Log periods are Gaussian, about their mean; their standard deviation is that of the movements
    and the 3 % by which a tempo changes within one.

    >>> middle, around = tempos(torch.tensor([100.0, 110.0, 121.0]), 3)
    >>> round(middle, 6), around.mul(100).round().tolist()
    (110.0, [90.0, 100.0, 112.0])
    """
    log = periods.double().log()
    between = log.var(correction=1) if len(log) > 1 else log.new_zeros(())
    std = (between * (1 + 1 / len(log)) + TEMPO_STD**2).sqrt()
    levels = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    around = (std * torch.special.ndtri(levels)).exp()
    return float(log.mean().exp()), around


def aligned(
    alone: Template,
    fitted: Callable[[Found], Template],
    matched: Callable[[Template], Found],
    rounds: int = ROUNDS,
) -> Found:
    """Timings of movements, in turn with the template that they share.

    They are first ``matched`` to the template of one movement ``alone``, then to that which is
    ``fitted`` to all at the timings found.
    """
    found = matched(alone)
    for _ in range(rounds - 1):
        found = matched(fitted(found))
    return found


def align(
    movements: Movements,
    choices: Sequence[Timing],
    fitted: Callable[[Movements, list[Timing]], Template],
    nearest: Callable[[Tensor, Tensor, Template], int],
) -> list[Timing]:
    """The choice for every movement, against the longest one first and then against all.

    ``fitted`` is the template of movements at their timings, ``nearest`` the index of the choice at
    which it is nearest to the entries observed of a movement.
    """
    longest = max(movements, key=lambda movement: len(movement[0]))

    def matched(template: Template) -> list[Timing]:
        return [choices[nearest(x, seen, template)] for x, seen in movements]

    alone = fitted([longest], [choices[0]])
    return aligned(alone, lambda timings: fitted(movements, timings), matched)
