"""``python -m benchmarks.coverage``: what bands cover, by question, person, channel and lead time.

Walks of subjects 07, 08 and 35 at 30 Hz: of three folds each leaves a person out. Of the other two
half of the trials train, a quarter calibrates, a quarter is judged as the *same* people; the person
left out is *another*. LASA's shapes (seven demonstrations: four train, two calibrate, one is
judged, in turn) and reaches of a simulated arm are judged as the same. Bands are raw, calibrated
over the default grid, and calibrated with adaptation to the errors in the frames observed. No
observed length asked here is one that was calibrated after. The method was chosen on walks of 35
and 08 and runs of 35; 07 was first looked at in the stored result.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import zoo
from benchmarks.harness import store
from zoo.datasets.store import listed
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run

PEOPLE = ("07", "08", "35-walk")
FRAMES, LEVELS, BLOCKS = 69, (0.5, 0.8, 0.9, 0.95), 4
WALKERS = ("kernel-ridge", "nearest-neighbour", "ar", "dmp", "promp", "vae-dmp-rhythmic")
REACHERS = ("kernel-ridge", "dmp", "promp")


@dataclass(frozen=True, kw_only=True)
class Fold:
    """What to train and calibrate on, what is judged as whom, and after how many frames."""

    data: str
    left_out: str
    train: zoo.Sequences
    calibration: zoo.Sequences
    judged: dict[str, zoo.Sequences]
    seen: tuple[int, ...]
    models: tuple[str, ...]


def walks() -> Iterator[Fold]:
    """Three folds of people."""
    every = {}
    for name in PEOPLE:
        whole = zoo.load_data(f"cmu-mocap/{name}", frames=None).resampled(rate=30.0)
        every[name] = whole.frames(0, FRAMES)
    for other in PEOPLE:
        parts = [every[p].split(by="trial", parts=(0.5, 0.25, 0.25)) for p in PEOPLE if p != other]
        train, calibration, same = (zoo.concatenate(part) for part in zip(*parts, strict=True))
        yield Fold(
            data="walks",
            left_out=other.partition("-")[0],
            train=train,
            calibration=calibration,
            judged={"same": same, "another": every[other]},
            seen=(15, 30, 45),
            models=WALKERS,
        )


def shapes() -> Iterator[Fold]:
    """LASA's shapes, each demonstration judged once."""
    from scipy.io import loadmat

    for file in listed("lasa/*.mat", dataset="LASA"):
        demos = loadmat(file)["demos"][0]
        arrays = [np.asarray(d["pos"][0, 0]).T[::10] for d in demos]
        data = zoo.Sequences.from_arrays(
            arrays, rate=100.0, channels=["x", "y"], units="mm", name=file.stem
        )
        for k in range(len(data)):
            order = [(k + i) % len(data) for i in range(len(data))]
            judged, calibration, train = order[:1], order[1:3], order[3:]
            yield Fold(
                data="LASA",
                left_out=f"{file.stem} {k}",
                train=data[train],
                calibration=data[calibration],
                judged={"same": data[judged]},
                seen=(30, 60),
                models=REACHERS,
            )


def reaches() -> Iterator[Fold]:
    """Reaches of a simulated arm."""
    data = zoo.load_data("robot-arm/reaching")
    for seed in range(3):
        train, calibration, judged, _ = data.split(
            by="trial", parts=(0.3, 0.2, 0.3, 0.2), seed=seed
        )
        frames = int(data.lengths.min())
        yield Fold(
            data="arm",
            left_out=f"split {seed}",
            train=train,
            calibration=calibration,
            judged={"same": judged},
            seen=(frames // 5, frames // 3, 3 * frames // 5),
            models=REACHERS,
        )


def measured(fold: Fold, model: str, root: Path) -> Iterator[dict[str, Any]]:
    """Rows of one model trained on one fold."""
    folder = root / f"{fold.data}-{fold.left_out}-{model}".replace(" ", "-")
    run = zoo.fit(zoo.create(model, fold.train), fold.train, run_dir=folder, resume="auto")
    for kind in ("raw", "calibrated", "adapted"):
        run = zoo.fit(zoo.create(model, fold.train), fold.train, run_dir=folder, resume="must")
        if kind != "raw":
            run.calibrate(fold.calibration, tasks=["forecast"], adapt=kind == "adapted")
        for whom, data in fold.judged.items():
            for seen in fold.seen:
                yield {
                    "data": fold.data,
                    "left_out": fold.left_out,
                    "model": model,
                    "bands": kind,
                    "who": whom,
                    "seen": seen,
                    "groups": len(fold.calibration),
                    **covered(run, data, seen),
                }


def covered(run: Run, data: zoo.Sequences, seen: int) -> dict[str, Any]:
    """Shares inside in per cent: at every level, and of the 90 % band by channel and lead block."""
    frames = int(data.lengths.min())
    prediction = run.forecast(data.first(seen), horizon=frames - seen)
    truth = data.values[:, seen:frames]
    inside = {level: _inside(prediction, truth, level) for level in LEVELS}
    low, high = prediction.interval(0.9)
    at90 = 100 * inside[0.9].double()
    blocks = at90.tensor_split(BLOCKS, 1)
    each = at90.mean((1, 2))
    return {
        "coverage": {f"{100 * k:.0f}": _round(100 * v.double().mean()) for k, v in inside.items()},
        "sd_over_movements": _round(each.std()) if len(each) > 1 else None,
        "channels": [_round(v) for v in at90.mean((0, 1))],
        "blocks": [_round(b.mean()) for b in blocks],
        "width": float(f"{float((high - low).mean()):.4g}"),
        "movements": len(data),
    }


def _inside(prediction: Prediction, truth: torch.Tensor, level: float) -> torch.Tensor:
    low, high = prediction.interval(level)
    return (truth >= low) & (truth <= high)


def _round(value: Any) -> float:
    return round(float(value), 1)


def table(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means of the 90 % bands over folds and questions, beside the extremes."""
    keys = dict.fromkeys((r["data"], r["model"], r["who"], r["bands"]) for r in rows)
    found = []
    for key in keys:
        here = [r for r in rows if (r["data"], r["model"], r["who"], r["bands"]) == key]
        values = [r["coverage"]["90"] for r in here]
        found.append(
            dict(zip(("data", "model", "who", "bands"), key, strict=True))
            | {
                "mean": round(sum(values) / len(values), 1),
                "least": min(values),
                "most": max(values),
                "worst_channel": min(min(r["channels"]) for r in here),
                "worst_block": min(min(r["blocks"]) for r in here),
                "width": float(f"{sum(r['width'] for r in here) / len(here):.4g}"),
            }
        )
    return found


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """What 90 % bands of walks hold, for the same people and for another."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    titles = {"same": "held-out trials of the same people", "another": "another person"}
    for axis, (who, title) in zip(axes, titles.items(), strict=True):
        for i, kind in enumerate(("raw", "calibrated", "adapted")):
            for j, model in enumerate(WALKERS):
                here = [
                    r["coverage"]["90"]
                    for r in rows
                    if (r["data"], r["who"], r["bands"], r["model"]) == ("walks", who, kind, model)
                ]
                place = [j + 0.25 * (i - 1)] * len(here)
                label = kind if not j else None
                axis.plot(place, here, "o", color=f"C{i}", alpha=0.6, label=label)
        axis.axhspan(85, 95, color="0.9", zorder=0)
        axis.axhline(90, color="0.4", linewidth=0.8)
        axis.set_xticks(range(len(WALKERS)), WALKERS, rotation=25, ha="right")
        axis.set_title(title)
    axes[0].set_ylabel("90 % band holds, %")
    axes[0].legend(loc="lower left")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    """Measure, print, draw and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/coverage"))
    root, began = parser.parse_args().runs, time.monotonic()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for fold in (*walks(), *shapes(), *reaches()):
            for model in fold.models:
                rows += measured(fold, model, root)
                last = rows[-1]
                print(fold.data, fold.left_out, model, last["coverage"], flush=True)
    summary = table(rows)
    for row in summary:
        print(row)
    payload = {"command": "python -m benchmarks.coverage", "summary": summary, "rows": rows}
    stored = store("coverage", payload, label="public", seed=0, started=began)
    draw(rows, stored.with_suffix(".png"))
    print(stored)


if __name__ == "__main__":
    main()
