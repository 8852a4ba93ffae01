"""E5.6: punching to other goals (§5.3.6, Fig. 41)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.evaluation.figures.postures import posture_strips
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run, create
from zoo.studies.chapter5 import e5_1
from zoo.studies.kept import trained
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["run"]

SHARES = (0.6, 0.8, 1.0, 1.2, 1.4)
SEED = 0

Column = NDArray[np.float64]


def run(*, quick: bool, progress: bool) -> Result:
    """Punching, its last posture moved along the way from the first, by AE-DMP and VAE-DMP."""
    data = load_data("thesis-movements")
    row = list(data.groups["movement"]).index("punching")
    punch = data[row : row + 1]
    runs = {
        "ae-dmp": e5_1.fitted("ae-dmp", punch, "punching", quick, progress),
        "vae-dmp-single": _single(punch, quick, progress),
    }
    first, last = punch.values[0, 0].double(), punch.values[0, -1].double()
    goals = [first + share * (last - first) for share in SHARES]
    found = {
        name: [r.generate(punch, goal=g.numpy(), draws=200) for g in goals]
        for name, r in runs.items()
    }
    return _result(punch, runs, goals, found)


def _single(data: Sequences, quick: bool, progress: bool) -> Run:
    settings: dict[str, Any] = {"epochs": 5} if quick else {}
    assembly = create("vae-dmp-single", data, seed=SEED, latent_dim=5, **settings)
    return trained(assembly, data, "E5.6", "punching", progress=progress)


def _result(
    punch: Sequences, runs: dict[str, Run], goals: list[Tensor], found: dict[str, list[Prediction]]
) -> Result:
    first = punch.values[0, 0].double()
    rows: list[tuple[object, ...]] = []
    kept: dict[str, list[float]] = {}
    for name, predictions in found.items():
        for share, goal, prediction in zip(SHARES, goals, predictions, strict=True):
            mean = prediction.mean[0].double()
            end, begin = _rms(mean[-1] - goal), _rms(mean[0] - first)
            asked = _rms(goal - punch.values[0, -1].double())
            kept.setdefault(name, []).append(end)
            rows.append((name, share, asked, end, begin, float(prediction.std[0, -1].mean())))
    return Result(
        title="punching to other goals: the last posture moved along the way from the first",
        source="thesis",
        columns=(
            "model",
            "share of the way",
            "goal moved by, RMS / rad",
            "end from the goal",
            "begin from the demonstration's",
            "predicted SD at the end",
        ),
        rows=tuple(rows),
        findings=(
            *(
                f"{name}: the end is {np.mean(ends):.3f} rad from the goal on average "
                f"(RMS of 50 joints), at worst {max(ends):.3f}."
                for name, ends in kept.items()
            ),
            "All movements start where the demonstration does, and only the goal attractor "
            "changes (Fig. 41). A goal off the manifold of the one punch that was trained on can "
            "be reached only as far as the decoder goes. The thesis gives no numbers.",
        ),
        seed=SEED,
        figure=_figure(punch, runs["ae-dmp"], goals, found),
    )


def _rms(apart: Tensor) -> float:
    return float(apart.square().mean().sqrt())


def _latent(run: Run, punch: Sequences, angles: Tensor) -> Tensor:
    """Codes of frames that are like those of ``punch``, (time, latent)."""
    frames = angles.view(1, -1, angles.shape[-1])
    given = replace(
        punch[:1],
        values=frames,
        mask=torch.ones_like(frames, dtype=torch.bool),
        lengths=torch.tensor([frames.shape[1]]),
    )
    return run.encode(given)[0][0]


def _figure(
    punch: Sequences, run: Run, goals: list[Tensor], found: dict[str, list[Prediction]]
) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    spec = figure.add_gridspec(4, 2, height_ratios=(2.2, 1, 1, 1))
    _plane(figure.add_subplot(spec[0, 0]), run, punch, goals, found["ae-dmp"])
    _joint(figure.add_subplot(spec[0, 1]), punch, found["vae-dmp-single"])
    strips = {
        f"ae-dmp, goal at {SHARES[k]:.0%} of the way": found["ae-dmp"][k].mean[0] for k in (0, 2, 4)
    }
    posture_strips([figure.add_subplot(spec[k, :]) for k in (1, 2, 3)], strips, punch.channels)
    return figure


def _plane(
    axes: Axes, run: Run, punch: Sequences, goals: list[Tensor], found: list[Prediction]
) -> None:
    """Encoded paths in the two neurons of the largest variance."""
    paths = [_latent(run, punch, p.mean[0].double()) for p in found]
    own = _latent(run, punch, punch.values[0].double())
    wide = own.var(0).argsort(descending=True)[:2].tolist()
    for share, goal, path in zip(SHARES, goals, paths, strict=True):
        (line,) = axes.plot(path[:, wide[0]], path[:, wide[1]], label=f"{share:.0%}")
        end = _latent(run, punch, goal)[0]
        axes.plot(end[wide[0]], end[wide[1]], "x", color=line.get_color())
    axes.plot(*paths[0][0, wide], "o", color="black")
    axes.legend(title="goal (x)", fontsize=8, frameon=False)
    axes.set(
        xlabel=f"hidden neuron {wide[0] + 1}",
        ylabel=f"hidden neuron {wide[1] + 1}",
        title="ae-dmp: paths to other goals",
    )
    axes.spines[["top", "right"]].set_visible(False)


def _joint(axes: Axes, punch: Sequences, found: list[Prediction]) -> None:
    """The joint that moves most, with its band."""
    moved = (punch.values[0, -1] - punch.values[0, 0]).abs()
    channel = int(moved.argmax())
    for share, prediction in zip(SHARES, found, strict=True):
        low, high = (q[0, :, channel] for q in prediction.interval(0.9))
        (line,) = axes.plot(prediction.mean[0, :, channel], label=f"{share:.0%}")
        frames = np.arange(len(low))
        axes.fill_between(frames, low, high, color=line.get_color(), alpha=0.2, lw=0)
    axes.plot(punch.values[0, :, channel], color="black", ls=":", label="demonstration")
    axes.set(
        xlabel="frame",
        ylabel=f"{punch.channels[channel]} / rad",
        title="vae-dmp-single: 90 % bands",
    )
    axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
