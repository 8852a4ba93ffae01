"""Radians or degrees: every entry gives the same answers, up to the unit."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from support import assembly_of, data_of, movements, pairs, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.datasets.records import Pairs, Sequences
from zoo.evaluation.questions import hide_joints
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run

DEGREE = 180 / math.pi
CLOSE = {torch.float32: 1e-3, torch.float64: 1e-6}


def in_degrees(data: Sequences | Pairs) -> Sequences | Pairs:
    """The same data in a unit 57 times as small."""
    if isinstance(data, Pairs):
        return replace(data, targets=data.targets * DEGREE, units=("mN",) * len(data.units))
    return replace(data, values=data.values * DEGREE, units=("deg",) * len(data.units))


def answers(run: Run, known: Sequences | Pairs) -> dict[str, Prediction]:
    """One answer for every task."""
    if isinstance(known, Pairs):
        return {"regress": run.regress(known, draws=20)}
    asked = {
        "reconstruct": lambda: run.reconstruct(known, draws=20),
        "forecast": lambda: run.forecast(known.first(10), horizon=6, draws=20),
        "impute": lambda: run.impute(hide_joints(known, 0.3), draws=20),
        "generate": lambda: run.generate(known, duration=1.5, draws=20),
    }
    return {task: ask() for task, ask in asked.items() if task in run.capabilities}


@pytest.mark.parametrize("name", [entry.name for entry in CATALOGUE])
def test_another_unit_is_another_factor(name: str) -> None:
    entry = CATALOGUE[name]
    data, some = data_of(entry), (pairs() if entry.data == "pairs" else movements())[:3]
    assembly = replace(assembly_of(entry), layout=in_degrees(data).layout)
    other = answers(zoo.fit(assembly, in_degrees(data)), in_degrees(some))
    for task, prediction in answers(run_of(name), some).items():
        close = CLOSE[assembly.dtype]
        size = float(prediction.mean.std())
        mean, std = (getattr(other[task], part) / DEGREE for part in ("mean", "std"))
        torch.testing.assert_close(mean, prediction.mean, rtol=0, atol=close * size, msg=task)
        torch.testing.assert_close(std, prediction.std, rtol=close, atol=close * size, msg=task)
