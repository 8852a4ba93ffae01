"""Scores of every movement held out, its bands calibrated on all the others, and paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from zoo.evaluation.calibration import recalibrate
from zoo.evaluation.scores import score
from zoo.prediction import Prediction, Predictive

__all__ = ["SHOWN", "Interval", "holm", "interval", "judged", "paired"]

SHOWN = ("mse", "rmse", "crps", "energy", "nll", "coverage_50", "coverage_90", "width_90")
Column = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A mean over groups and the half width of its 95 % confidence interval (Student's t)."""

    mean: float
    half: float


def interval(values: Column) -> Interval:
    """Mean and confidence interval of values of independent groups.

    >>> found = interval(np.array([1.0, 2.0, 3.0]))
    >>> round(found.mean, 2), round(found.half, 2)
    (2.0, 2.48)
    """
    if len(values) < 2:
        return Interval(float(values.mean()), float("nan"))
    error = values.std(ddof=1) / np.sqrt(len(values))
    return Interval(float(values.mean()), float(stats.t.ppf(0.975, len(values) - 1) * error))


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


def judged(
    predictions: Sequence[tuple[Sequence[int], Prediction]],
    truth: Tensor,
    mask: Tensor,
    groups: Sequence[object],
) -> Mapping[str, Column]:
    """Scores by name, of every group in order, raw and with bands calibrated on the others.

    ``predictions`` are of the rows of each fold. No prediction is of a movement that its model
    saw, and no band is calibrated on the group that it is judged by.
    """
    whole = _joined(predictions)
    order = list(dict.fromkeys(groups))
    columns: dict[str, list[float]] = {}
    for group in order:
        here = torch.tensor([g == group for g in groups])
        found = _scores(whole, truth, mask, [str(g) for g in groups], here)
        for name, value in found.items():
            columns.setdefault(name, []).append(value)
    return {k: np.array(v) for k, v in columns.items() if len(v) == len(order)}


def _scores(
    whole: Prediction, truth: Tensor, mask: Tensor, groups: Sequence[str], here: Tensor
) -> dict[str, float]:
    own, others = _rows(whole, here), _rows(whole, ~here)
    found = score(own, truth[here], mask[here])
    values = {k: e.value for k in SHOWN if (e := found[k]) is not None}
    if not own.has_spread:
        return values
    rest = {"group": [g for g, inside in zip(groups, here.tolist(), strict=True) if not inside]}
    correction = recalibrate("conformal", others, truth[~here], mask[~here], rest)
    mended = score(own.recalibrated(correction), truth[here], mask[here])
    return values | {f"calibrated_{k}": e.value for k in SHOWN if (e := mended[k]) is not None}


def _rows(prediction: Prediction, rows: Tensor) -> Prediction:
    p = prediction.predictive

    def picked(part: Tensor | None) -> Tensor | None:
        return None if part is None else part.expand(part.shape[0], *p.location.shape[1:])[:, rows]

    chosen = replace(
        p,
        location=p.location[:, rows],
        noise=picked(p.noise),
        epistemic=picked(p.epistemic),
        draws=picked(p.draws),
    )
    return replace(prediction, predictive=chosen)


def _joined(predictions: Sequence[tuple[Sequence[int], Prediction]]) -> Prediction:
    """Predictions of all folds as one, rows in their own order."""
    order = torch.tensor([row for rows, _ in predictions for row in rows]).argsort()
    parts = [p.predictive for _, p in predictions]

    def joined(name: str) -> Tensor | None:
        full = [_full(p, name) for p in parts]
        known = [part for part in full if part is not None]
        return torch.cat(known, 1)[:, order] if len(known) == len(full) else None

    location = joined("location")
    assert location is not None
    whole = Predictive(
        location=location,
        noise=joined("noise"),
        epistemic=joined("epistemic"),
        joint=parts[0].joint,
        draws=joined("draws"),
    )
    return replace(predictions[0][1], predictive=whole, lengths=None)


def _full(p: Predictive, name: str) -> Tensor | None:
    part: Tensor | None = getattr(p, name)
    if part is None or name == "draws":
        return part
    return part.expand_as(p.location)
