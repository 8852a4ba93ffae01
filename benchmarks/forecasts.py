"""Every entry that forecasts, on movements it never saw: ``python -m benchmarks.forecasts DATA``.

``walk`` is public (CMU subject 35, windows of 70 frames at 60 Hz, split by trial), ``reaching`` is
simulated. Ten frames are seen and sixty forecast; bands are recalibrated on movements of their own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from typing import Any, Literal

import zoo
from benchmarks.harness import store
from zoo.contract.strategies import Svi
from zoo.datasets.records import Sequences
from zoo.evaluation.questions import Setup

SHARES = (0.5, 0.1, 0.2, 0.2)
SETUP = Setup(seen=10, horizon=60)
SHOWN = ("rmse", "crps", "energy", "coverage_50", "coverage_90", "width_90")
STEPS = 6000


def walk() -> Sequences:
    """Real walks in windows."""
    walks: Sequences = zoo.load_data("cmu-mocap/35-walk", frames=None, rate=60.0)
    return walks.windows(70, stride=20)


def reaching() -> Sequences:
    """Simulated reaching."""
    arm: Sequences = zoo.load_data("robot-arm/reaching")
    return arm


DATA: dict[str, tuple[Callable[[], Sequences], Literal["public", "simulated"]]] = {
    "walk": (walk, "public"),
    "reaching": (reaching, "simulated"),
}


def judged(name: str, parts: Iterable[Sequences], seed: int) -> dict[str, Any]:
    """Scores of one entry before and after recalibration."""
    train, val, calib, test = parts
    began = time.monotonic()
    model = zoo.create(name, train, seed=seed)
    if isinstance(model.inference, Svi):
        model = zoo.create(name, train, seed=seed, max_steps=STEPS)
    run = zoo.fit(model, train, val=val)
    raw = zoo.evaluate(run, test, tasks=["forecast"], setup=SETUP)["forecast"]
    run.calibrate(calib, tasks=["forecast"], setup=SETUP)
    found = zoo.evaluate(run, test, tasks=["forecast"], setup=SETUP)["forecast"]
    scores = {s: [e.value, e.error] for s in SHOWN if (e := found[s]) is not None}
    before = raw["coverage_90"]
    return {
        "model": name,
        "seconds": round(time.monotonic() - began, 1),
        "scores": scores,
        "coverage_90_raw": None if before is None else [before.value, before.error],
    }


def main() -> None:
    """Judge all entries on one data set and store the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", choices=DATA)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", nargs="*", help="only these entries (default: all that can)")
    chosen = parser.parse_args()
    loader, label = DATA[chosen.data]
    parts = loader().split(by="trial", parts=SHARES, seed=chosen.seed)
    rows = []
    for name in chosen.models or zoo.list_models(can="forecast"):
        rows.append(judged(name, parts, chosen.seed))
        rmse, coverage = rows[-1]["scores"]["rmse"], rows[-1]["scores"]["coverage_90"]
        print(
            f"{name:20} RMSE {rmse[0]:.4f} ± {rmse[1]:.4f}  inside 90 % {coverage[0]:.1f} ± "
            f"{coverage[1]:.1f}  {rows[-1]['seconds']:.0f} s",
            flush=True,
        )
    named = f" --models {' '.join(chosen.models)}" if chosen.models else ""
    command = f"python -m benchmarks.forecasts {chosen.data}{named}"
    cards = [
        {
            "model": row["model"],
            "what": f"forecast of 60 frames after 10 on {chosen.data}, held out by trial",
            "value": f"RMSE {row['scores']['rmse'][0]:.3f} rad, 90 % band holds "
            f"{row['scores']['coverage_90'][0]:.0f} %",
            "source": label,
            "command": command,
        }
        for row in rows
    ]
    payload = {"command": command, "rows": rows, "cards": cards}
    store(f"forecasts_{chosen.data}", payload, label=label, seed=chosen.seed)


if __name__ == "__main__":
    main()
