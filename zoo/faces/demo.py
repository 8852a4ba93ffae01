"""``python -m zoo.faces.demo``: VAE-DMP on movement data, from training to calibrated forecasts."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.faces.commands import forecast_figure, reliability_figure
from zoo.faces.terminal import said_plainly, show
from zoo.runs.fitting import fit
from zoo.runs.run import create, evaluate

__all__ = ["main"]

WALK_SHARES = (0.5, 0.1, 0.2, 0.2)
ARM_SHARES = (0.3, 0.1, 0.3, 0.3)
STEPS = 6000


def demo_data() -> tuple[Sequences, tuple[float, ...]]:
    """Data and the shares of their split.

    Real walks where ``MOVEZOO_DATA`` points at them, else the simulated robot arm. The walks are
    cut into windows of 70 frames at 60 Hz, a little more than a step each.
    """
    if os.environ.get("MOVEZOO_DATA"):
        walks: Sequences = load_data("cmu-mocap/35-walk", frames=None, rate=60.0)
        return walks.windows(70, stride=10), WALK_SHARES
    arm: Sequences = load_data("robot-arm/reaching", movements=240)
    return arm, ARM_SHARES


def main(folder: Path = Path("demo")) -> int:
    """Train, calibrate, forecast and evaluate; everything written is under ``folder``."""
    began = time.monotonic()
    data, shares = demo_data()
    train, val, calib, test = data.split(by="trial", parts=shares, seed=0)
    show(
        f"[bold]{data.name}[/] ({data.provenance}): {len(train)} movements to train on, "
        f"{len(val)} to validate, {len(calib)} to calibrate, {len(test)} held out"
    )
    assembly = create("vae-dmp", train, max_steps=STEPS)
    run = fit(assembly, train, val=val, run_dir=folder / "run", overwrite=True, progress=True)
    run.calibrate(calib)
    run.save(folder / "run")
    table = evaluate(run, test, tasks=["forecast", "reconstruct"])
    show(table)
    seen = max(2, int(test.lengths.min()) // 7)
    prediction = run.forecast(test.first(seen), horizon=int(test.lengths.min()) - seen)
    forecast_figure(prediction, test, seen, folder / "forecast.png")
    reliability_figure(run, test, folder / "reliability.png")
    show(
        f"Forecasts after {seen} frames with their bands: {folder / 'forecast.png'}; "
        f"calibration: {folder / 'reliability.png'}; {time.monotonic() - began:.0f} s in all"
    )
    return 0


if __name__ == "__main__":
    with said_plainly():
        sys.exit(main())
