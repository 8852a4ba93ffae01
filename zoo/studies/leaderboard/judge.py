"""Scores of movements that neither a model nor the correction of its bands was fitted on."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from zoo.errors import FewGroupsWarning
from zoo.evaluation.calibration.recalibration import recalibrate
from zoo.evaluation.scores import score
from zoo.prediction.prediction import Prediction
from zoo.studies.leaderboard.protocol import Fold
from zoo.studies.leaderboard.statistics import Column

__all__ = ["BLOCKS", "LEVEL", "SHOWN", "Judged", "blocks", "judged"]

SHOWN = (
    "mse",
    "rmse",
    "crps",
    "energy",
    "nll",
    "coverage_50",
    "coverage_90",
    "width_50",
    "width_90",
)
LEVEL = 0.9
BLOCKS = 6
Cube = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One value a group, in order, of every score; coverage of the 90 % bands in detail.

    ``coverage`` has ``raw`` and ``calibrated`` shares in per cent by group × channel × block of
    frames, NaN where nothing was asked.
    """

    scores: Mapping[str, Column]
    coverage: Mapping[str, Cube]

    @classmethod
    def mean(cls, seeds: Sequence[Judged]) -> Self:
        """Seeds averaged within each group."""

        def averaged(parts: Sequence[Mapping[str, NDArray[np.float64]]]) -> dict[str, Cube]:
            shared = [k for k in parts[0] if all(k in part for part in parts)]
            return {k: np.mean([part[k] for part in parts], axis=0) for k in shared}

        return cls(
            scores=averaged([s.scores for s in seeds]),
            coverage=averaged([s.coverage for s in seeds]),
        )


def judged(
    folds: Sequence[tuple[Fold, Prediction]],
    truth: Tensor,
    mask: Tensor,
    groups: Sequence[object],
) -> Judged:
    """Scores of every group, raw and with bands corrected on the fold's calibration part.

    Each prediction is of the rows of its fold's calibration part, then of those judged. A part of
    a single group corrects nothing: calibrated scores are then absent.
    """
    found: dict[object, list[_Entry]] = {}
    for fold, prediction in folds:
        for kind, answer in _answers(fold, prediction, truth, mask, groups).items():
            for group, inside in _members(fold.judged, groups).items():
                rows = torch.tensor(fold.judged)[inside]
                entry = _entry(kind, answer.rows(inside), truth[rows], mask[rows])
                found.setdefault(group, []).append(entry)
    order = [found[g] for g in dict.fromkeys(groups)]
    return Judged(
        scores=_columns([{k: v for e in each for k, v in e.scores.items()} for each in order]),
        coverage=_columns([{k: v for e in each for k, v in e.coverage.items()} for each in order]),
    )


def blocks(frames: int) -> list[tuple[int, int]]:
    """First frame and end of each of six blocks of equal length, of fewer where frames are few.

    >>> blocks(20)
    [(0, 3), (3, 7), (7, 10), (10, 13), (13, 17), (17, 20)]
    """
    count = min(BLOCKS, frames)
    edges = [round(i * frames / count) for i in range(count + 1)]
    return list(pairwise(edges))


def _answers(
    fold: Fold, prediction: Prediction, truth: Tensor, mask: Tensor, groups: Sequence[object]
) -> dict[str, Prediction]:
    """The judged rows' prediction as it is and, by the prefix ``calibrated_``, corrected."""
    place = torch.arange(len(fold.calibration) + len(fold.judged))
    known = prediction.rows(place < len(fold.calibration))
    asked = prediction.rows(place >= len(fold.calibration))
    names = [str(groups[row]) for row in fold.calibration]
    if not asked.has_spread or len(set(names)) < 2:
        return {"": asked}
    rows, frames = torch.tensor(fold.calibration), known.shape[1]
    values, asked_for = truth[rows, :frames], mask[rows, :frames]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FewGroupsWarning)
        correction = recalibrate("conformal", known, values, asked_for, {"group": names})
    return {"": asked, "calibrated_": asked.recalibrated(correction)}


@dataclass(frozen=True, kw_only=True)
class _Entry:
    scores: Mapping[str, float]
    coverage: Mapping[str, Cube]


def _entry(kind: str, prediction: Prediction, truth: Tensor, mask: Tensor) -> _Entry:
    """One group's scores and coverage, raw or with corrected bands."""
    frames = prediction.shape[1]
    truth, mask = truth[:, :frames], mask[:, :frames]
    scores = score(prediction, truth, mask, joint=not kind)
    return _Entry(
        scores={kind + k: e.value for k in SHOWN if (e := scores[k]) is not None},
        coverage={}
        if not prediction.has_spread
        else {"calibrated" if kind else "raw": _coverage(prediction, truth, mask)},
    )


def _members(rows: Sequence[int], groups: Sequence[object]) -> dict[object, Bool[Tensor, " row"]]:
    """Which of the rows belong to each group."""
    names = [groups[row] for row in rows]
    return {g: torch.tensor([n == g for n in names]) for g in dict.fromkeys(names)}


def _coverage(prediction: Prediction, truth: Tensor, mask: Tensor) -> Cube:
    """Share of the known truth inside the 90 % band in per cent, by channel and block."""
    low, high = prediction.interval(LEVEL)
    inside = (truth >= low) & (truth <= high) & mask
    parts = [
        (inside[:, a:b].sum((0, 1)), mask[:, a:b].sum((0, 1))) for a, b in blocks(len(mask[0]))
    ]
    shares = torch.stack([100 * held / asked for held, asked in parts], 1)
    return np.asarray(shares.double().numpy())


def _columns(found: Sequence[Mapping[str, float | Cube]]) -> dict[str, Cube]:
    """What every group has, stacked."""
    shared = [k for k in found[0] if all(k in each for each in found)]
    return {k: np.stack([np.asarray(each[k], dtype=np.float64) for each in found]) for k in shared}
