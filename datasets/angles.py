"""Joint angles without jumps: turns of 360°, equal Euler angles and lost signs undone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

__all__ = ["continuous"]

JUMP = math.pi / 2
Angles = Float[ndarray, " dof"]


def continuous(
    values: Float[ndarray, "frame channel"], channels: Sequence[str]
) -> tuple[Float[ndarray, "frame channel"], tuple[str, ...]]:
    """The movement without jumps of more than 90° a frame where one can be undone, and what was.

    A joint goes on from each frame by the first of these that moves it by less than 90°: its
    angles up to full turns; of three angles the equal ones (x+π, π−y, z+π); of an x–z joint z with
    its sign restored. CMU's files lose that sign beyond 90°: in 35_14 and 35_19 the z of thumb and
    hand, which otherwise differ by 30° to 0.1°, have opposite signs there (beyond 135° it cannot be
    told from a full turn). Where none does, the angles stay, up to full turns. Channels end in
    ``_rx``, ``_ry``, ``_rz``; others are left alone. Angles in rad, frames count from 1.

    >>> angles = np.deg2rad([[170.0], [-175.0], [-160.0]])
    >>> smooth, notes = continuous(angles, ["root_ry"])
    >>> np.rad2deg(smooth).round().tolist(), notes
    ([[170.0], [185.0], [200.0]], ('root_ry: turns of 360° undone in 2 frames from frame 2',))
    """
    smooth, notes = values.copy(), []
    for columns in _joints(channels).values():
        axes = "".join(channels[c][-1] for c in columns)
        if (np.abs(np.diff(values[:, columns], axis=0)) > JUMP).any():
            smooth[:, columns], how = _walk(values[:, columns], REPAIRS.get(axes, TURNS))
            notes += [
                _note([channels[c] for c in columns], repair, np.flatnonzero(how == repair) + 1)
                for repair in dict.fromkeys(how.tolist())
                if repair
            ]
    return smooth, tuple(notes)


def _walk(values: Float[ndarray, "frame dof"], repairs: Repairs) -> tuple[ndarray, ndarray]:
    """Angles that go on from each other, and by which repair."""
    path, how = [values[0]], [""]
    for angles in values[1:]:
        options = {n: _nearest(repair(angles), path[-1]) for n, repair in repairs.items()}
        jumps = {n: np.abs(option - path[-1]).max() for n, option in options.items()}
        name = next((n for n, jump in jumps.items() if jump < JUMP), next(iter(repairs)))
        path.append(options[name])
        how.append(name if (options[name] != angles).any() else "")
    return np.stack(path), np.array(how)


def _nearest(angles: Angles, last: Angles) -> Angles:
    turns: Angles = np.round((angles - last) / (2 * math.pi))
    return angles - 2 * math.pi * turns


def _joints(channels: Sequence[str]) -> Mapping[str, list[int]]:
    joints: dict[str, list[int]] = {}
    for i, name in enumerate(channels):
        bone, _, dof = name.rpartition("_")
        if dof in ("rx", "ry", "rz"):
            joints.setdefault(bone, []).append(i)
    return joints


def _note(channels: Sequence[str], repair: str, frames: ndarray) -> str:
    many = f"{len(frames)} frames from frame" if len(frames) > 1 else "frame"
    return f"{', '.join(channels)}: {repair} in {many} {frames[0]}"


Repairs = Mapping[str, Callable[[Angles], Angles]]
TURNS: Repairs = {"turns of 360° undone": lambda a: a}
REPAIRS: Mapping[str, Repairs] = {
    "xyz": {
        **TURNS,
        "equal Euler angles taken": lambda a: np.array([a[0] + np.pi, np.pi - a[1], a[2] + np.pi]),
    },
    "xz": {**TURNS, "sign of z restored": lambda a: a * (1, -1)},
}
