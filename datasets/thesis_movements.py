"""The five movements of the thesis: 70 frames of 50 joint angles each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records import Sequences
from zoo.datasets.store import FileFormatError, require

__all__ = ["FRAMES", "SUBJECTS", "load"]

SUBJECTS = {"walking": 35, "balance": 49, "kicking": 74, "tai_chi": 120, "punching": 143}
FRAMES, JOINTS = 70, 50
RATE = 120 / 7
RIGHT_ARM = ("rhumerus", "rradius", "rwrist", "rhand", "rfingers", "rthumb")
ADVICE = "put movements.npz into $MOVEZOO_DATA/thesis-movements/ or name its folder with folder=..."


def load(*, folder: str | Path | None = None) -> Sequences:
    """Walking, balance, kicking, tai chi and punching as in Table 2: joint angles in rad.

    The data of the VAE-DMP paper as later passed on with VTSFE: CMU motion capture of the subjects
    of §5.3.1, angles folded by arcsin(sin). Balance is frames 50 + 7i of trial 49_18 at 120 Hz
    (three angles of its right leg differ by up to 0.032 rad); the other rates are not known, so
    that ``rate`` is nominal and time counts as normalised. Walking and balance are certain. The
    other names are inferred: punching is one arm along nearly a line, as §6.3.1.1 says ("punching
    is a single line"; the first principal component holds 71 % of the variance), tai chi moves
    both arms and both legs (§5.3.2: "complicated movement"), and `dmp`, which is deterministic,
    then has MSE 18.5·10⁻⁴ rad² on tai chi, where Table 2 prints 26, and 0.4 on punching (8.4).
    A file in which these two have each other's names is refused with a ``FileFormatError``.
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
    _check_names(path, arrays)
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


def _check_names(path: Path, arrays: dict[str, NDArray[np.float64]]) -> None:
    """Refuse a file of before November 2026, in which two movements had each other's names."""
    arm = np.array([str(c).startswith(RIGHT_ARM) for c in arrays["columns"]])
    share = {n: arrays[n][:, arm].var(0).sum() / arrays[n].var(0).sum() for n in SUBJECTS}
    if share["punching"] < share["tai_chi"]:
        raise FileFormatError(
            path,
            None,
            f"the right arm has {share['punching']:.0%} of the variance of punching and "
            f"{share['tai_chi']:.0%} of that of tai_chi: the two arrays have each other's names "
            "(exchange them)",
        )
