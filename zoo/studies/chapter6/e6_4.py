"""E6.4: switching from jogging to walking in a latent space (§6.3.1.3, Fig. 51)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.evaluation.figures.postures import posture_strips
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run
from zoo.studies.chapter5.walking import FRAMES, both, fitted
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["STEPS", "run"]

START, STEPS, LATENT = 20, 18, 5
JOINT = "lfemur_rx"
SEED = 0


def run(*, quick: bool, progress: bool) -> Result:
    """One model of walking and jogging; every jogging sequence is switched to a walking one."""
    data = both()
    settings = {"latent_dim": LATENT, "epochs": 300}
    model = fitted("vae-dmp", data, "both", quick=quick, progress=progress, **settings)
    kind = list(data.groups["movement"])
    jog = data[[i for i, k in enumerate(kind) if k == "jogging"]]
    walk = data[[i for i, k in enumerate(kind) if k == "walking"][: len(jog)]]
    return _result(model, jog, walk)


def _switched(model: Run, jog: Sequences, walk: Sequences) -> Prediction:
    return model.generate(jog, onto=walk, start=START, steps=STEPS, draws=200)


def _result(model: Run, jog: Sequences, walk: Sequences) -> Result:
    switch, alone = _switched(model, jog, walk), model.generate(jog, draws=200)
    target = model.generate(walk, draws=200)
    before = _rms(switch.mean[:, : START + 1] - alone.mean[:, : START + 1])
    apart = [
        _rms(switch.mean[:, a:b] - target.mean[:, a:b])
        for a, b in ((0, START), (START, START + STEPS), (START + STEPS, FRAMES))
    ]
    different = _rms(alone.mean[:, -12:] - target.mean[:, -12:])
    late = _rms(switch.mean[:, -12:] - target.mean[:, -12:])
    rate = jog.rate or 1.0
    peaks = [_peak(p.mean, rate) for p in (alone, target, switch)]
    rows = (
        ("jogging until the switch, RMS distance from jogging / rad", before),
        (f"frames 0–{START}: RMS distance from walking / rad", apart[0]),
        (f"frames {START}–{START + STEPS}, switching", apart[1]),
        (f"frames {START + STEPS}–{FRAMES}, after", apart[2]),
        ("last 12 frames, after", late),
        ("last 12 frames of jogging from walking, not switched", different),
        ("largest joint acceleration, jogging / rad/s²", peaks[0]),
        ("largest joint acceleration, walking", peaks[1]),
        ("largest joint acceleration, switched", peaks[2]),
    )
    return Result(
        title="jogging switched to walking from frame 20 to 38, 5-D",
        source="public",
        columns=("quantity", "value"),
        rows=rows,
        findings=(
            f"Until frame {START} the movement is the jogging (to {before:.1e} rad); in the last "
            f"12 frames it is {late:.3f} rad from the walking it was switched to, where jogging "
            f"itself is {different:.3f} rad away.",
            f"Its largest acceleration is {peaks[2]:.0f} rad/s², that of the jogging "
            f"{peaks[0]:.0f} and of the walking {peaks[1]:.0f}.",
            "The thesis shows Fig. 51 and no numbers. Here nine jogging sequences are each "
            "switched to one of nine walking ones, all at 60 Hz; the shades in the figure are "
            "90 % bands of the generated movement.",
        ),
        seed=SEED,
        details={"training_seconds": round(sum(e["seconds"] for e in model.history), 1)},
        cards=(
            {
                "model": "vae-dmp",
                "what": "jogging switched to walking, distance from walking at the end",
                "value": f"{late:.3f} rad (jogging itself {different:.3f} rad)",
                "thesis": "Fig. 51, no numbers",
            },
        ),
        figure=_figure(model, jog, walk, switch, alone, target),
    )


def _rms(apart: Tensor) -> float:
    return float(apart.double().square().mean().sqrt())


def _peak(angles: Tensor, rate: float) -> float:
    """99.9 % quantile of all joints' accelerations."""
    found = angles.double().diff(n=2, dim=1).abs().flatten() * rate**2
    return float(torch.quantile(found, 0.999))


def _figure(
    model: Run,
    jog: Sequences,
    walk: Sequences,
    switch: Prediction,
    alone: Prediction,
    target: Prediction,
) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8), layout="constrained")
    spec = figure.add_gridspec(4, 2, height_ratios=(2, 1, 1, 1))
    latent, joint = figure.add_subplot(spec[0, 0]), figure.add_subplot(spec[0, 1])
    _latent(latent, model, jog, walk)
    _joint(joint, switch, alone, target, jog.channels.index(JOINT))
    shown = {"jogging": alone, "switched": switch, "walking": target}
    strips = {name: prediction.mean[0] for name, prediction in shown.items()}
    posture_strips([figure.add_subplot(spec[k, :]) for k in (1, 2, 3)], strips, jog.channels)
    return figure


def _latent(axes: Axes, model: Run, jog: Sequences, walk: Sequences) -> None:
    """The two coordinates of the largest variance; the switched path is encoded again."""
    switched = _switched(model, jog, walk).mean.double().numpy()
    again = Sequences.from_arrays(
        list(switched), rate=jog.rate, channels=jog.channels, units=jog.units
    )
    paths = [model.represent(d[:1], draws=50).mean[0] for d in (jog, walk, again)]
    wide = torch.cat(paths[:2]).var(0).argsort(descending=True)[:2].tolist()
    named = {"jogging": "C0", "walking": "C2", "switched": "C1"}
    for path, (name, colour) in zip(paths, named.items(), strict=True):
        axes.plot(path[:, wide[0]], path[:, wide[1]], color=colour, label=name)
        axes.plot(*path[0, wide], "o", color=colour, ms=4)
    for frame in (START, START + STEPS):
        across, up = paths[2][frame, wide].tolist()
        axes.annotate(str(frame), (across, up), fontsize=8)
    axes.set(xlabel=f"z* {wide[0] + 1}", ylabel=f"z* {wide[1] + 1}", title="Latent space")
    axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)


def _joint(
    axes: Axes, switch: Prediction, alone: Prediction, target: Prediction, channel: int
) -> None:
    time = np.arange(FRAMES)
    shown = (("jogging", alone, "C0"), ("walking", target, "C2"), ("switched", switch, "C1"))
    for name, prediction, colour in shown:
        low, high = (q[0, :, channel] for q in prediction.interval(0.9))
        axes.fill_between(time, low, high, color=colour, alpha=0.15, lw=0)
        axes.plot(time, prediction.mean[0, :, channel], color=colour, label=name)
    axes.axvspan(START, START + STEPS, color="0.93", zorder=0)
    axes.set(xlabel="frame", ylabel="left hip pitch / rad", title="Left hip; grey: switching")
    axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
