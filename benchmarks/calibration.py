"""``python -m benchmarks.calibration``: what bands cover on walks held out, by recalibration.

Simulated forecasts that are too narrow, with errors that are smooth in time and differ by walk,
channel and lead time; 3, 4, 12 or 24 walks to calibrate, 200 others to check, repeated. The width
of 90 % bands is given as a multiple of the raw one's: the one that holds 90 % is about 2.
"""

from __future__ import annotations

import statistics
import time
import warnings
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import store
from zoo.errors import FewGroupsWarning
from zoo.evaluation.calibration.recalibration import RECALIBRATIONS, recalibrate
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

FRAMES, CHANNELS, REPEATS, CHECKED = 60, 6, 30, 200
COUNTS = (3, 4, 12, 24)
LEVELS = (0.5, 0.9, 0.95)


def main() -> None:
    """Print and store mean and standard deviation over repetitions of the coverage."""
    began = time.monotonic()
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FewGroupsWarning)
        rows = [row for count in COUNTS for row in coverages(count)]
    for row in rows:
        shares = "  ".join(
            f"{level}: {row[level]['mean']:5.1f} ± {row[level]['sd']:3.1f}" for level in names()
        )
        width = "× {mean:.2f} ± {sd:.2f}".format(**row["width of 90 %"])
        print(f"{row['walks']:3} walks  {row['recalibration']:10} {row['by']:14} {shares}  {width}")
    print(store("calibration", {"rows": rows}, label="simulated", seed=0, started=began))


def names() -> list[str]:
    """The levels as they are printed."""
    return [f"{100 * level:g} %" for level in LEVELS]


def coverages(count: int) -> list[dict[str, Any]]:
    """Coverage in per cent and width of every recalibration fitted on ``count`` walks."""
    found: dict[tuple[str, str], list[list[float]]] = {}
    for seed in range(REPEATS):
        generator = torch.Generator().manual_seed(seed)
        channel = (0.4 * torch.randn(CHANNELS, generator=generator)).exp()
        calib, known = walks(count, channel, generator)
        raw, truth = walks(CHECKED, channel, generator)
        whole = width(raw)
        found.setdefault(("none", ""), []).append([*shares(raw, truth), 1.0])
        for kind in RECALIBRATIONS:
            common = raw.recalibrated(recalibrate(kind, calib, known, by=()))
            full = raw.recalibrated(recalibrate(kind, calib, known))
            for by, mended in (("one factor", common), ("channel × time", full)):
                row = [*shares(mended, truth), width(mended) / whole]
                found.setdefault((kind, by), []).append(row)
    return [
        {"walks": count, "recalibration": kind, "by": by, **summary(values)}
        for (kind, by), values in found.items()
    ]


def walks(count: int, channel: Tensor, generator: torch.Generator) -> tuple[Prediction, Tensor]:
    """Forecasts with unit spread, and truths 1.7 times as far off on a typical walk."""
    noise = torch.randn(count, FRAMES, CHANNELS, generator=generator)
    steps = [noise[:, 0]]
    for t in range(1, FRAMES):
        steps.append(0.95 * steps[-1] + (1 - 0.95**2) ** 0.5 * noise[:, t])
    walk = (0.3 * torch.randn(count, 1, 1, generator=generator)).exp()
    lead = (0.4 * torch.linspace(-1, 1, FRAMES)).exp()[:, None]
    truth = 1.7 * walk * lead * channel * torch.stack(steps, 1)
    prediction = Prediction(
        predictive=Predictive(location=torch.zeros(1, *truth.shape), noise=torch.ones(1)),
        axes=("sequence", "time", "channel"),
        names=tuple(f"joint_{i}" for i in range(CHANNELS)),
        units=("rad",) * CHANNELS,
        task="forecast",
    )
    return prediction, truth


def shares(prediction: Prediction, truth: Tensor) -> list[float]:
    """Truths inside the central intervals, in per cent."""
    found = []
    for level in LEVELS:
        low, high = prediction.interval(level)
        found.append(100 * float(((truth >= low) & (truth <= high)).double().mean()))
    return found


def width(prediction: Prediction) -> float:
    """Mean width of the 90 % bands."""
    low, high = prediction.interval(0.9)
    return float((high - low).mean())


def summary(values: list[list[float]]) -> dict[str, dict[str, float]]:
    """Mean and standard deviation over the repetitions of every level and of the width."""
    columns = zip(*values, strict=True)
    return {
        name: {"mean": statistics.mean(column), "sd": statistics.stdev(column)}
        for name, column in zip([*names(), "width of 90 %"], columns, strict=True)
    }


if __name__ == "__main__":
    main()
