"""All that is kept of a trained model: what it predicts from, and what a folder holds of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from zoo.datasets.records.scaling import Scaler
from zoo.prediction.prediction import Recalibration
from zoo.runs.assembly import Assembly

__all__ = ["Record"]


@dataclass(kw_only=True)
class Record:
    """All that is kept of a trained model.

    ``history`` has a row per epoch or iteration; ``recalibrations`` one correction per task;
    ``trained_on`` fingerprints of the training data, so that an evaluation on them is noticed,
    as ``calibrated_on`` are of those that bands were calibrated on;
    ``made_of`` all that determined it (:mod:`zoo.runs.fingerprint`), empty where it was trained
    without a folder; ``seconds`` the wall clock of its training.
    """

    assembly: Assembly
    scaler: Scaler
    history: list[dict[str, Any]]
    seconds: float
    trained_on: dict[str, Any]
    made_of: dict[str, str] = field(default_factory=dict)
    recalibrations: dict[str, Recalibration] = field(default_factory=dict)
    calibrated_on: list[str] = field(default_factory=list)
