"""What every entry takes and what an answer costs: ``python -m benchmarks.chooser``.

Each entry is fitted to small simulated movements or pairs that have one property at a time. What
it refuses, it refuses in its own words. Entries of gradient steps train for two epochs: what they
take and how long they answer does not depend on more. An answer that is not finite so early is
left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

import zoo
from benchmarks.harness import interleave, store
from zoo.catalogue import CATALOGUE
from zoo.registry import Entry
from zoo.strategies import Svi

FRAMES, RATE, SEEN = 60, 30.0, 20
TASKS = ("forecast", "impute", "reconstruct", "represent", "regress")


def movements(count: int = 16, *, ragged: bool = False, gaps: bool = False) -> zoo.Sequences:
    """Smooth movements of six joints, in rad at 30 Hz, each of its own phase and tempo."""
    rng = np.random.default_rng(0)
    mixing, arrays = rng.normal(size=(4, 6)), []
    for number in range(count):
        frames = FRAMES - 6 * (number % 3) if ragged else FRAMES
        turns = 2 * np.pi * np.arange(frames)[:, None] / RATE * rng.normal(1.0, 0.05)
        phase = turns + rng.normal(scale=0.2)
        waves = np.concatenate(
            [np.sin(phase), np.cos(phase), np.sin(2 * phase), np.cos(2 * phase)], 1
        )
        arrays.append(0.3 * waves @ mixing + 0.01 * rng.normal(size=(frames, 6)))
        if gaps:
            arrays[-1][rng.random(arrays[-1].shape) < 0.05] = np.nan
    return zoo.Sequences.from_arrays(arrays, rate=RATE, units="rad", provenance="simulated")


def pairs(count: int = 200, *, gaps: bool = False) -> zoo.Pairs:
    """A smooth function of three features, two forces in N."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 3))
    y = np.stack([np.sin(x[:, 0]) + x[:, 1], x[:, 2] ** 2], 1) + 0.05 * rng.normal(size=(count, 2))
    if gaps:
        y[rng.random(y.shape) < 0.05] = np.nan
    return zoo.Pairs.from_arrays(x, y, units="N", provenance="simulated")


def fitted(entry: Entry, data: Any) -> zoo.Run:
    """The entry trained on data, for two epochs where it trains by gradient steps."""
    settings = {"epochs": 2} if isinstance(entry.inference, Svi) else {}
    return zoo.fit(zoo.create(entry.name, data, **settings), data)


def answers(entry: Entry, run: zoo.Run, data: Any) -> dict[str, Callable[[], zoo.Prediction]]:
    """One movement forecast, imputed, …, or a hundred items regressed."""
    if entry.data == "pairs":
        return {"regress": lambda: run.regress(data[:100])}
    one = data[:1]
    asked = {
        "forecast": lambda: run.forecast(one.first(SEEN), horizon=FRAMES - SEEN),
        "impute": lambda: run.impute(one),
        "reconstruct": lambda: run.reconstruct(one),
        "represent": lambda: run.represent(one),
    }
    return {task: call for task, call in asked.items() if task in run.capabilities}


def probes(entry: Entry) -> Iterator[tuple[str, Callable[[], object]]]:
    """Named trials of what the entry takes."""
    if entry.data == "pairs":
        yield "missing entries", lambda: fitted(entry, pairs(gaps=True))
        return
    yield "unequal lengths", lambda: fitted(entry, movements(ragged=True))
    yield "missing entries", lambda: fitted(entry, movements(gaps=True))
    yield "a single movement", lambda: fitted(entry, movements(1))
    if "forecast" in entry.capabilities:
        yield (
            "beyond the last frame",
            lambda: fitted(entry, movements()).forecast(
                movements(1).first(SEEN), horizon=2 * FRAMES
            ),
        )


def tried(call: Callable[[], object]) -> str:
    """``""`` where it works, else the words of the refusal."""
    try:
        call()
    except (ValueError, TypeError, RuntimeError, FloatingPointError) as error:
        return str(error)
    return ""


def row(entry: Entry) -> dict[str, Any]:
    """Refusals by property, processor milliseconds by task, and whether answers have bands."""
    data = pairs() if entry.data == "pairs" else movements()
    run = fitted(entry, data)
    asked = {t: call for t, call in answers(entry, run, data).items() if not tried(call)}
    timings = interleave(asked, rounds=5, warmup=1)
    return {
        "model": entry.name,
        "refused": {name: tried(call) for name, call in probes(entry)},
        "milliseconds": {t: round(1e3 * v["processor_median"], 2) for t, v in timings.items()},
        "bands": {task: call().has_spread for task, call in asked.items() if task != "represent"},
    }


def main() -> None:
    """Try every entry of the catalogue and store what was found."""
    torch.set_num_threads(1)
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for entry in CATALOGUE:
            rows.append(row(entry))
            print(rows[-1])
    frames = {"movements": 16, "frames": FRAMES, "channels": 6, "rate": RATE, "observed": SEEN}
    payload = {"command": "python -m benchmarks.chooser", "data": frames, "rows": rows}
    store("chooser", payload, label="simulated", seed=0)


if __name__ == "__main__":
    main()
