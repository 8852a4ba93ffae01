"""Schedules of a training: tempering (87), warm-up of the KL, step size."""

from __future__ import annotations

import math
from collections.abc import Callable

from zoo.contract.strategies import Svi

__all__ = ["learning_rate", "ramp"]


def ramp(epoch: int, epochs: int) -> float:
    """c = min(1, 0.01 + t/T) of (87) after ``epoch`` of ``epochs`` epochs; 1 where T is 0.

    The thesis prints max for min. The same ramp serves the warm-up of the KL.

    >>> [ramp(t, 4) for t in (0, 2, 4)], ramp(0, 0)
    ([0.01, 0.51, 1.0], 1.0)
    """
    return min(1.0, 0.01 + epoch / epochs) if epochs else 1.0


def learning_rate(strategy: Svi, done: float) -> float:
    """Step size when the fraction ``done`` of all steps is behind.

    >>> learning_rate(Svi(learning_rate=0.1, schedule="cosine"), 0.5)
    0.05
    """
    return strategy.learning_rate * _SCHEDULES[strategy.schedule](done)


_SCHEDULES: dict[str, Callable[[float], float]] = {
    "constant": lambda done: 1.0,
    "cosine": lambda done: (1.0 + math.cos(math.pi * done)) / 2.0,
}
