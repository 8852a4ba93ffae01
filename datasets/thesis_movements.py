"""The five movements of the thesis: 70 frames of 50 joint angles each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from zoo.datasets.records import Sequences
from zoo.datasets.store import FileFormatError, require

__all__ = ["FRAMES", "SUBJECTS", "load"]

SUBJECTS = {"walking": 35, "balance": 49, "kicking": 74, "tai_chi": 120, "punching": 143}
FRAMES, JOINTS = 70, 50
RATE = 120 / 7
ADVICE = "put movements.npz into $MOVEZOO_DATA/thesis-movements/ or name its folder with folder=..."


def load(*, folder: str | Path | None = None) -> Sequences:
    """Walking, balance, kicking, tai chi and punching as in Table 2: joint angles in rad.

    The data of the VAE-DMP paper as later passed on with VTSFE: CMU motion capture of the subjects
    of §5.3.1, angles folded by arcsin(sin). Balance is frames 50 + 7i of trial 49_18 at 120 Hz
    (three angles of its right leg differ by up to 0.032 rad); the other rates are not known, so
    that ``rate`` is nominal and time counts as normalised. Walking and balance are certain; the
    names kicking, punching and tai chi are inferred from the limbs that move.
    """
    path = require("movements.npz", dataset="thesis-movements", folder=folder, advice=ADVICE)
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    for name in ("columns", *SUBJECTS):
        if name not in arrays:
            raise FileFormatError(path, None, f"no array {name!r}; it holds {', '.join(arrays)}")
    for name in SUBJECTS:
        if arrays[name].shape != (FRAMES, JOINTS):
            raise FileFormatError(
                path, None, f"{name} has shape {arrays[name].shape}; {(FRAMES, JOINTS)} is needed"
            )
    return Sequences.from_arrays(
        [arrays[name] for name in SUBJECTS],
        rate=RATE,
        time_normalised=True,
        channels=[str(c) for c in arrays["columns"]],
        units="rad",
        groups={"movement": list(SUBJECTS), "subject": list(SUBJECTS.values())},
        name="thesis-movements",
        provenance="thesis",
    )
