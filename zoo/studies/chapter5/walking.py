"""What the experiments of §5.3.2–§5.3.5 share: walking and jogging, trained models, questions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import find_peaks

from zoo.contract.strategies import Svi
from zoo.datasets.cmu_mocap import load
from zoo.datasets.records import Sequences
from zoo.runs.run import Run, create
from zoo.studies.kept import trained

__all__ = ["DATA", "FRAMES", "both", "fitted", "jogging", "mse", "walking", "without"]

FRAMES, RATE = 70, 60.0
HIP = "rfemur_rx"
DATA = (
    "Subject 35, cut at 60 Hz into 70 frames (1.17 s) that begin where the right hip is bent most. "
    "The thesis does not say which 21 walking sequences it has; here they are the first 21 of "
    "trials 35_01–35_12, and all of 35_13–35_16 are held out."
)
TRAINING, HELD_OUT = 21, ("35_13", "35_14", "35_15", "35_16")

Column = NDArray[np.float64]


def walking() -> tuple[Sequences, Sequences]:
    """21 sequences to train on, and those of four other trials."""
    data = load("35-walk", frames=None).resampled(rate=RATE)
    arrays, trials = [], []
    for values, trial in zip(data.arrays, data.groups["trial"], strict=True):
        for start in _starts(values[:, data.channels.index(HIP)]):
            arrays.append(values[start : start + FRAMES])
            trials.append(trial)
    cut = _record(data, arrays, trials)
    unseen = [i for i, t in enumerate(trials) if t in HELD_OUT]
    return cut[:TRAINING], cut[unseen]


def jogging() -> Sequences:
    """Nine sequences: the first 70 frames of eight trials, and the last of one."""
    data = load("35-run", frames=None).resampled(rate=RATE)
    arrays, trials = list(data.arrays), list(data.groups["trial"])
    longest = int(np.argmax([len(a) for a in arrays]))
    cut = [a[:FRAMES] for a in arrays] + [arrays[longest][-FRAMES:]]
    return _record(data, cut, [*trials, trials[longest]])


def both() -> Sequences:
    """The walking to train on and the jogging, told apart by the group ``movement``."""
    walk, jog = walking()[0], jogging()
    return Sequences.from_arrays(
        [*walk.arrays, *jog.arrays],
        rate=RATE,
        channels=walk.channels,
        units=walk.units,
        groups={
            "trial": [*walk.groups["trial"], *jog.groups["trial"]],
            "movement": ["walking"] * len(walk) + ["jogging"] * len(jog),
        },
        name=f"walking and jogging cut into {FRAMES} frames",
        provenance=walk.provenance,
    )


def _starts(hip: Column) -> list[int]:
    """Frames where the hip is bent most, half a sequence apart, with a whole one after them."""
    peaks, _ = find_peaks(hip, distance=0.55 * RATE, prominence=0.2)
    starts: list[int] = []
    for peak in peaks.tolist():
        if peak + FRAMES <= len(hip) and (not starts or peak >= starts[-1] + FRAMES // 2):
            starts.append(peak)
    return starts


def _record(data: Sequences, arrays: Sequence[Column], trials: Sequence[object]) -> Sequences:
    return Sequences.from_arrays(
        arrays,
        rate=RATE,
        channels=data.channels,
        units=data.units,
        groups={"trial": trials},
        name=f"{data.name} cut into {FRAMES} frames",
        provenance=data.provenance,
    )


def fitted(
    name: str, data: Sequences, label: str, *, quick: bool, progress: bool, **settings: Any
) -> Run:
    """A model trained on ``data``; a trained one is kept under runs/chapter-5."""
    assembly = create(name, data, seed=0, **settings)
    if quick and isinstance(assembly.inference, Svi):
        assembly = create(name, data, seed=0, **{**settings, "epochs": 5})
    return trained(assembly, data, "chapter-5", label, progress=progress)


def without(data: Sequences, channels: Sequence[str]) -> Sequences:
    """The movements without some channels."""
    mask = data.mask.clone()
    mask[:, :, [data.channels.index(c) for c in channels]] = False
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))


def mse(squares: torch.Tensor) -> tuple[float, float]:
    """Mean and standard deviation of squared errors."""
    return float(squares.mean()), float(squares.std(correction=0))
