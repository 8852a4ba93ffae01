"""The README's figure: a walk forecast with its bands, on a trial that nothing was fitted to."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from zoo.datasets.cmu_mocap import load
from zoo.datasets.records import Sequences
from zoo.evaluation.calibration.promise import promised
from zoo.evaluation.questions import Setup
from zoo.prediction.prediction import Prediction
from zoo.runs.run import create
from zoo.studies.kept import trained
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["run"]

MODEL = "promp-rhythmic"
SEEN, FRAMES = 100, 300
PARTS = (0.5, 0.25, 0.25)
JOINTS = {
    "rfemur_rx": "right hip",
    "rtibia_rx": "right knee",
    "rfoot_rx": "right ankle",
    "rhumerus_ry": "right shoulder",
}
SEED = 0


def run(*, quick: bool, progress: bool) -> Result:
    """Eight trials train, four calibrate, four are judged; the first of these is drawn."""
    data = load("35-walk", frames=None).frames(0, FRAMES)
    train, calib, test = data.split(by="trial", parts=PARTS, seed=SEED)
    if quick:
        train = train[:3]
    model = trained(create(MODEL, train, seed=SEED), train, "readme", "walk", progress=progress)
    setup = Setup(seen=SEEN, horizon=FRAMES - SEEN)
    model.calibrate(calib, tasks=["forecast"], setup=setup)
    prediction = model.forecast(test.first(SEEN), horizon=FRAMES - SEEN)
    return _result(prediction, train, calib, test)


def _result(prediction: Prediction, train: Sequences, calib: Sequences, test: Sequences) -> Result:
    truth = test.values[:, SEEN:]
    rows = [_row(name, prediction, truth, i) for i, name in enumerate(test.groups["trial"])]
    error = sum(row[1] for row in rows) / len(rows)
    held = torch.tensor([row[2:] for row in rows]).mean(0).tolist()
    return Result(
        title=f"a walk forecast by {MODEL}: {SEEN} frames observed, {FRAMES - SEEN} forecast",
        source="public",
        columns=(
            "trial",
            "MSE / deg²",
            "50 % band holds, raw",
            "50 %, calibrated",
            "90 % band holds, raw",
            "90 %, calibrated",
        ),
        rows=tuple(
            (row[0], row[1], *(f"{100 * share:.1f} %" for share in row[2:])) for row in rows
        ),
        findings=_findings(rows[0][0], held, len(train), len(calib)),
        seed=SEED,
        details={
            "trained on": list(train.groups["trial"]),
            "calibrated on": list(calib.groups["trial"]),
            "held out": list(test.groups["trial"]),
            "joints drawn": list(JOINTS),
        },
        cards=(
            {
                "model": MODEL,
                "what": f"four walks held out, {FRAMES - SEEN} frames forecast after {SEEN}, MSE",
                "value": f"{error:.2g} deg², calibrated 90 % band holds {100 * held[3]:.0f} %",
            },
        ),
        figure=_figure(prediction, test),
    )


def _findings(trial: str, held: list[float], trained: int, calibrated: int) -> tuple[str, ...]:
    """What the figure shows, what the bands held, and what they promise."""
    raw_50, calibrated_50, raw_90, calibrated_90 = (f"{100 * share:.1f} %" for share in held)
    return (
        f"The figure shows trial {trial}, the first of those held out in the split of seed {SEED}, "
        f"and {len(JOINTS)} of its joint angles.",
        f"Of all angles of all trials held out the calibrated 90 % bands hold {calibrated_90} (raw "
        f"{raw_90}), the 50 % bands {calibrated_50} (raw {raw_50}).",
        f"{trained} trials train, {calibrated} calibrate. So few exchangeable trials promise a new "
        f"one at most {100 * promised(0.9, calibrated):.0f} %; what the 90 % band holds is "
        "measured here.",
    )


def _row(
    name: str, prediction: Prediction, truth: Tensor, item: int
) -> tuple[str, float, float, float, float, float]:
    """Squared error and what the bands hold, over all channels and frames of a trial."""
    error = prediction.mean[item] - truth[item]
    held = [
        _held(p, truth, item, level) for level in (0.5, 0.9) for p in (prediction.raw, prediction)
    ]
    return name, degrees(degrees(float(error.square().mean()))), held[0], held[1], held[2], held[3]


def _held(prediction: Prediction, truth: Tensor, item: int, level: float) -> float:
    low, high = (end[item] for end in prediction.interval(level))
    return float(((low <= truth[item]) & (truth[item] <= high)).double().mean())


def _figure(prediction: Prediction, test: Sequences) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5.2), layout="constrained")
    panels = list(figure.subplots(2, 2, sharex=True).flat)
    for axes, channel in zip(panels, JOINTS, strict=True):
        _bands(axes, prediction, test, channel)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside upper center", ncols=5, frameon=False)
    figure.supxlabel(f"time / s, trial {test.groups['trial'][0]}", fontsize=10)
    return figure


def _bands(axes: Axes, prediction: Prediction, test: Sequences, channel: str) -> None:
    """Observed part, truth, mean, and 50 and 90 % bands of one joint, in degrees."""
    index = prediction.channel(channel)
    path = torch.rad2deg(test.values[0, :, index])
    time = torch.arange(FRAMES) / test.rate
    ahead = time[SEEN:]
    for level, alpha in ((0.9, 0.22), (0.5, 0.38)):
        low, high = (torch.rad2deg(end[0, :, index]) for end in prediction.interval(level))
        label = f"{level:.0%} band".replace("%", " %")
        axes.fill_between(ahead, low, high, color="C0", alpha=alpha, lw=0, label=label)
    mean = torch.rad2deg(prediction.mean[0, :, index])
    axes.plot(ahead, mean, color="C0", lw=1.8, label="forecast, mean")
    axes.plot(ahead, path[SEEN:], color="black", lw=1.2, ls="--", label="truth, hidden")
    axes.plot(time[:SEEN], path[:SEEN], color="black", lw=2, label="observed")
    axes.axvline(SEEN / test.rate, color="0.6", lw=0.8, ls=":")
    axes.set_title(f"{JOINTS[channel]} ({channel})", fontsize=10, loc="left")
    axes.set_ylabel("angle / °")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", lw=0.6)
