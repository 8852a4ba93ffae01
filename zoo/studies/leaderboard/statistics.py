"""Means over groups with their intervals, and paired tests between models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["Column", "Interval", "holm", "interval", "paired"]

Column = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A mean over groups, the half width of its 95 % confidence interval, and the groups' SD."""

    mean: float
    half: float
    sd: float


def interval(values: Column) -> Interval:
    """Mean, Student's 95 % confidence interval and standard deviation of independent groups.

    >>> found = interval(np.array([1.0, 2.0, 3.0]))
    >>> round(found.mean, 2), round(found.half, 2), found.sd
    (2.0, 2.48, 1.0)
    """
    if len(values) < 2:
        return Interval(float(values.mean()), float("nan"), float("nan"))
    sd = float(values.std(ddof=1))
    half = float(stats.t.ppf(0.975, len(values) - 1)) * sd / np.sqrt(len(values))
    return Interval(float(values.mean()), float(half), sd)


def paired(ours: Column, theirs: Column) -> float:
    """p of Wilcoxon's signed-rank test that paired groups differ by nothing, two-sided."""
    if np.array_equal(ours, theirs):
        return 1.0
    return float(stats.wilcoxon(ours, theirs).pvalue)


def holm(p: Sequence[float]) -> list[float]:
    """Holm's adjustment of the p values of several tests.

    >>> [round(v, 3) for v in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    order = np.argsort(p)
    raised = np.maximum.accumulate([(len(p) - k) * p[i] for k, i in enumerate(order)])
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(raised, 1.0)
    return [float(v) for v in adjusted]
