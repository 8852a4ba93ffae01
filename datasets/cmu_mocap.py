"""Human movements of the CMU Graphics Lab Motion Capture Database, as joint angles."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.amc import read_amc
from zoo.datasets.angles import continuous
from zoo.datasets.asf import read_asf
from zoo.datasets.cmu_files import BASE, HASHES
from zoo.datasets.records import Sequences
from zoo.datasets.skeleton import Skeleton
from zoo.datasets.split import nearest
from zoo.datasets.store import FileFormatError, MissingDataError, download, find, listed, sought
from zoo.errors import UnknownNameError

__all__ = ["ACKNOWLEDGEMENT", "CONSTANT", "load", "load_skeleton"]

DATASET = "cmu-mocap"
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)
# The marker set does not observe these: BodyBuilder writes 0 and 7.125° with rounding noise.
CONSTANT = (
    "lclavicle_ry",
    "lclavicle_rz",
    "lfingers_rx",
    "rclavicle_ry",
    "rclavicle_rz",
    "rfingers_rx",
)
NO_VARIANCE = 1e-26
RATE = 120.0
RUNS = "35_running_30hz.npz"

Kind = Literal["joint", "all"]
Table = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Movement:
    """Trials of one subject that show one movement."""

    subject: str
    name: str
    trials: tuple[int, ...]


MOVEMENTS = {
    "07-walk": Movement(subject="07", name="walk", trials=(1, 2, 3, 6, 7, 8, 9, 10, 11)),
    "08-walk": Movement(subject="08", name="walk", trials=(1, 2, 3, 4, 6, 8, 9, 10)),
    "35-walk": Movement(subject="35", name="walk", trials=tuple(range(1, 17))),
    "35-run": Movement(subject="35", name="run", trials=tuple(range(17, 25))),
    "49-balance": Movement(subject="49", name="balance", trials=(18,)),
}


def load(
    what: str,
    *,
    folder: str | Path | None = None,
    frames: int | None = 70,
    rate: float | None = None,
    angles: Kind = "joint",
) -> Sequences:
    """Trials of a movement (``35-walk``), of a subject (``07``) or one (``35_01``): angles in rad.

    A subject's trials are all AMC files that the folder has of it (of 35 not the runs, which are
    at 30 Hz); the channels of all subjects are the same, so that :func:`zoo.concatenate` joins
    them, with the group columns ``trial``, ``subject`` and ``movement``.
    Every trial is brought to ``frames`` frames as in §6.3.1, or to ``rate`` Hz where that is given;
    ``frames=None`` leaves the recording (120 Hz; 30 Hz for the runs). ``angles="joint"`` gives the
    50 angles of §5.3.1: without the root, whose frame is fixed, and without six that the markers do
    not observe (variance < 1e−26 rad² in every trial). ``"all"`` gives 62, the root in m and rad.
    Jumps of angles are undone (:mod:`zoo.datasets.angles`); ``notes`` of the record says where.

    Files are sought in ``folder``, else in ``$MOVEZOO_DATA``, else downloaded and checked.
    """
    if angles not in get_args(Kind):
        raise ValueError(f"angles must be one of {', '.join(get_args(Kind))}; got {angles!r}")
    movement = _movement(what, folder)
    acknowledge()
    skeleton = load_skeleton(movement.subject, folder=folder)
    names = skeleton.channels
    kept = [i for i, c in enumerate(names) if angles == "all" or _is_joint_angle(c)]
    arrays, notes = [], []
    recordings, recorded = _recordings(movement, skeleton, folder)
    for trial, values in recordings:
        smooth, found = continuous(values, names)
        arrays.append(smooth[:, kept])
        notes += [f"{trial}: {note}" for note in (*found, *_dropped(smooth, names, kept))]
    data = Sequences.from_arrays(
        arrays,
        rate=recorded,
        channels=[names[i] for i in kept],
        units=[skeleton.units[i] for i in kept],
        groups={
            "trial": [trial for trial, _ in recordings],
            "subject": [movement.subject] * len(arrays),
            "movement": [_shown(movement.subject, number) for number in movement.trials],
        },
        notes=notes,
        name=f"{DATASET}/{what}",
        provenance="public",
    )
    if rate is not None:
        return data.resampled(rate=rate)
    return data if frames is None else data.resampled(frames)


def load_skeleton(subject: str | int, *, folder: str | Path | None = None) -> Skeleton:
    """The skeleton of a subject, for forward kinematics of its trials."""
    name = f"{int(subject):02d}"
    return read_asf(_file(f"{name}/{name}.asf", folder))


@cache
def acknowledge() -> None:
    """Print the owner's acknowledgement, once in a process."""
    print(ACKNOWLEDGEMENT, file=sys.stderr)


def _movement(what: str, folder: str | Path | None) -> Movement:
    if what in MOVEMENTS:
        return MOVEMENTS[what]
    if re.fullmatch(r"\d{2,3}", what):
        return Movement(subject=what, name="all", trials=_trials(what, folder))
    trial = re.fullmatch(r"(\d{2,3})_(\d{2,3})", what)
    if trial is None:
        hint = nearest(what, MOVEMENTS)
        raise UnknownNameError(
            f"no CMU movement {what!r}{hint}; single trials are named SUBJECT_TRIAL, such as "
            "35_01, all of a subject by its number, such as 07"
        )
    subject, number = trial[1], int(trial[2])
    return Movement(subject=subject, name=_shown(subject, number), trials=(number,))


def _shown(subject: str, trial: int) -> str:
    """What a trial shows, where that is known."""
    known = (m.name for m in MOVEMENTS.values() if m.subject == subject and trial in m.trials)
    return next(known, "unknown")


def _trials(subject: str, folder: str | Path | None) -> tuple[int, ...]:
    """Numbers of the trials at hand, else of those that can be downloaded."""
    pattern = f"{subject}/{subject}_*.amc"
    here = [file.stem for file in listed(pattern, dataset=DATASET, folder=folder)]
    remote = [Path(path).stem for path in HASHES if folder is None and Path(path).match(pattern)]
    numbers = sorted({int(stem.partition("_")[2]) for stem in here or remote})
    if not numbers:
        raise MissingDataError(
            f"{DATASET}: no trial of subject {subject} is {sought(folder)}; fetch {BASE}{subject}/ "
            f"yourself and put it into $MOVEZOO_DATA/{DATASET}/{subject}, or name its folder with "
            "folder=..."
        )
    return tuple(numbers)


def _is_joint_angle(channel: str) -> bool:
    return not channel.startswith("root_") and channel not in CONSTANT


def _dropped(values: Table, names: Sequence[str], kept: Sequence[int]) -> Iterator[str]:
    """Where a channel that is left out as constant does vary."""
    for i, name in enumerate(names):
        variance = values[:, i].var()
        if name in CONSTANT and i not in kept and variance >= NO_VARIANCE:
            yield f"{name} is left out although its variance is {variance:.1e} rad²"


def _recordings(
    movement: Movement, skeleton: Skeleton, folder: str | Path | None
) -> tuple[list[tuple[str, Table]], float]:
    """Names and values of the trials in the order of the skeleton's channels, and their rate."""
    trials = [f"{movement.subject}_{number:02d}" for number in movement.trials]
    runs = find(RUNS, dataset=DATASET, folder=folder)
    if movement.name == "run" and runs is not None:
        return _runs(runs, trials, skeleton)
    files = [_file(f"{movement.subject}/{trial}.amc", folder) for trial in trials]
    values = [read_amc(file, skeleton).numpy() for file in files]
    return list(zip(trials, values, strict=True)), RATE


def _runs(
    path: Path, trials: Sequence[str], skeleton: Skeleton
) -> tuple[list[tuple[str, Table]], float]:
    """Trials of an archive in degrees and file units, its channels in any order."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    lacking = [key for key in ("channels", "fps", *trials) if key not in arrays]
    if lacking:
        raise FileFormatError(path, None, f"no array {lacking[0]!r}; it holds {', '.join(arrays)}")
    channels = [str(c) for c in arrays["channels"]]
    if sorted(channels) != sorted(skeleton.channels):
        raise FileFormatError(path, None, "its channels are not those of the skeleton")
    order = [channels.index(c) for c in skeleton.channels]
    unit = np.array([skeleton.metre if u == "m" else np.pi / 180 for u in skeleton.units])
    rows = [(trial, arrays[trial].astype(np.float64)[:, order] * unit) for trial in trials]
    return rows, float(arrays["fps"])


def _file(relative: str, folder: str | Path | None) -> Path:
    found = find(relative, dataset=DATASET, folder=folder)
    if found is not None:
        return found
    if folder is not None:
        raise MissingDataError(f"{DATASET}: {relative} is not {sought(folder)}")
    return download(relative, base=BASE, hashes=HASHES, dataset=DATASET)
