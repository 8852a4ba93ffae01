"""Known inputs of every frame: as long as their movements, complete, with names and units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from zoo.datasets.records.checks import distinct_names, pad, units_of
from zoo.datasets.records.labelled import movements

__all__ = ["known_controls"]


def known_controls(
    controls: Any,
    names: Sequence[str] | None,
    units: str | Sequence[str],
    rate: float,
    lengths: Tensor,
) -> dict[str, Any]:
    """The fields of a record that hold them; they may come as anything that movements may."""
    if controls is None:
        return {
            "control_names": distinct_names(names, 0, "control"),
            "control_units": units_of(units, 0),
        }
    found = movements(
        controls, channels=names, units=units, rate=rate, groups=None, what="controls of sequence"
    )
    parts = found.arrays
    if [len(p) for p in parts] != lengths.tolist():
        raise ValueError("controls and arrays must have the same lengths, sequence by sequence")
    if any(np.isnan(p).any() for p in parts):
        raise ValueError("controls must be complete; found NaN")
    known = pad(parts, parts[0].shape[1], "controls")[0]
    return {
        "controls": known,
        "control_names": distinct_names(found.names, known.shape[2], "control"),
        "control_units": units_of(found.units, known.shape[2]),
    }
