"""Gaussian processes on UCI data, published splits 0–9, beside published figures.

``python -m benchmarks.uci`` reads the data from ``$MOVEZOO_DATA/uci`` and writes
``results/uci.json``. Published: networks with dropout (Gal & Ghahramani 2016), rounded, mean over
all 20 splits, of which these are the first ten.
"""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Sequence
from typing import Any, cast

import torch
import typer

import zoo
from benchmarks.harness import store
from zoo.datasets.uci import load
from zoo.errors import NoiseDivergenceWarning

PUBLISHED = {
    "concrete": {"dropout": {"rmse": 5.2, "nll": 3.0}},
    "energy": {"dropout": {"rmse": 1.7, "nll": 1.99}},
    "yacht": {"dropout": {"rmse": 1.1, "nll": 1.55}},
}
MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "gp": ("gp", {}),
    "gp, ard": ("gp", {"ard": True}),
    "fitc": ("fitc", {"compare": False}),
    "fitc, inducing learned": (
        "fitc",
        {"compare": False, "inducing": 50, "learn_inducing": True, "optimizer": "l-bfgs"},
    ),
    "vfe": ("vfe", {}),
}


def scores(run: zoo.Run, test: zoo.Pairs) -> tuple[float, float, float]:
    """RMSE and mean negative log density in the target's unit, and coverage of 90 % intervals."""
    p = run.regress(test)
    low, high = p.interval(0.9)
    covered = (low <= test.targets) & (test.targets <= high)
    error = (p.mean - test.targets).square().mean().sqrt()
    return float(error), float(-p.log_prob(test.targets).mean()), float(covered.double().mean())


def summary(values: Sequence[float]) -> dict[str, float]:
    """Mean and standard error over splits."""
    error = statistics.stdev(values) / math.sqrt(len(values))
    return {"mean": round(statistics.fmean(values), 4), "error": round(error, 4)}


def measure(data: str, label: str, splits: int) -> dict[str, Any]:
    """One model on the first ``splits`` published splits."""
    name, settings = MODELS[label]
    found, seconds = [], []
    for split in range(splits):
        train, test = cast(tuple[zoo.Pairs, zoo.Pairs], load(data, split=split))
        run = zoo.fit(zoo.create(name, train, **settings), train)
        found.append(scores(run, test))
        seconds.append(run.seconds)
    rmse, nll, coverage = (summary(column) for column in zip(*found, strict=True))
    fit = round(statistics.median(seconds), 3)
    return {"rmse": rmse, "nll": nll, "coverage_90": coverage, "seconds_a_fit": fit}


def sentence(data: str, label: str, row: dict[str, Any]) -> dict[str, str]:
    """What the model's card quotes."""
    rmse, nll, coverage = (row[k]["mean"] for k in ("rmse", "nll", "coverage_90"))
    return {
        "model": MODELS[label][0],
        "what": f"{label} on uci/{data}, mean of splits 0–9: RMSE, NLL, coverage of 90 %",
        "value": f"{rmse:.2f}, {nll:.2f}, {100 * coverage:.0f} %",
        "source": "public",
        "command": "python -m benchmarks.uci",
    }


def main(splits: int = 10) -> None:
    """Measure every model on every data set and store the table."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", NoiseDivergenceWarning)
    rows: dict[str, dict[str, Any]] = {}
    for data, published in PUBLISHED.items():
        rows[data] = {}
        for name, known in published.items():
            print(f"{data:10}{name:23}{known['rmse']:8.2f}{'':7}{known['nll']:8.2f}")
        for label in MODELS:
            row = rows[data][label] = measure(data, label, splits)
            figures = "".join(
                f"{row[k]['mean']:8.2f} ± {row[k]['error']:.2f}" for k in row if k[0] in "rnc"
            )
            print(f"{data:10}{label:23}{figures}{row['seconds_a_fit']:8.2f} s", flush=True)
    cards = [sentence(d, label, row) for d, table in rows.items() for label, row in table.items()]
    payload = {"splits": splits, "measured": rows, "published": PUBLISHED, "cards": cards}
    store("uci", payload, label="public", seed=0)


if __name__ == "__main__":
    typer.run(main)
