"""Checks that turn users' arrays, names and group columns into the parts of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

__all__ = [
    "Groups",
    "distinct_names",
    "group_columns",
    "matrix",
    "pad",
    "pad_controls",
    "rows_of",
    "stacked",
    "units_of",
]

Groups = dict[str, tuple[str, ...]]


def matrix(array: ArrayLike, what: str) -> NDArray[np.float64]:
    """A non-empty finite matrix of doubles; NaN is allowed."""
    found = np.asarray(array, dtype=np.float64)
    if found.ndim != 2 or 0 in found.shape:
        raise ValueError(f"{what} must be a non-empty matrix; got shape {found.shape}")
    if np.isinf(found).any():
        row, column = np.argwhere(np.isinf(found))[0]
        raise ValueError(f"{what} is infinite at row {row}, column {column}")
    return found


def pad(parts: list[NDArray[np.float64]], width: int, what: str) -> tuple[Tensor, Tensor, Tensor]:
    """Values padded with 0 to the longest part, mask of what is there, and lengths."""
    lengths = torch.tensor([len(p) for p in parts])
    full = np.full((len(parts), int(lengths.max()), width), np.nan)
    for i, part in enumerate(parts):
        if part.shape[1] != width:
            raise ValueError(f"sequence {i} has {part.shape[1]} {what}; the first has {width}")
        full[i, : len(part)] = part
    values = torch.from_numpy(full)
    return torch.nan_to_num(values), ~torch.isnan(values), lengths


def pad_controls(controls: Sequence[ArrayLike], lengths: Tensor) -> Tensor:
    """Padded controls, complete and as long as their sequences."""
    parts = [matrix(c, f"controls of sequence {i}") for i, c in enumerate(controls)]
    if [len(p) for p in parts] != lengths.tolist():
        raise ValueError("controls and arrays must have the same lengths, sequence by sequence")
    if any(np.isnan(p).any() for p in parts):
        raise ValueError("controls must be complete; found NaN")
    return pad(parts, parts[0].shape[1], "controls")[0]


def distinct_names(names: Sequence[str] | None, count: int, what: str) -> tuple[str, ...]:
    """The names given, or numbered ones."""
    if names is None:
        return tuple(f"{what}_{i}" for i in range(count))
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{count} distinct {what} names are needed; got {list(names)}")
    return tuple(names)


def units_of(units: str | Sequence[str], count: int) -> tuple[str, ...]:
    """One unit for each name."""
    if isinstance(units, str):
        return (units,) * count
    if len(units) != count:
        raise ValueError(f"{count} units are needed; got {list(units)}")
    return tuple(units)


def group_columns(
    groups: Mapping[str, Sequence[object]] | None, count: int, what: str, default: str
) -> Groups:
    """Group columns as text, one row for each item."""
    if groups is None:
        return {default: tuple(str(i) for i in range(count))}
    for key, column in groups.items():
        if not isinstance(column, Sized):
            raise TypeError(f"group column {key!r} needs {count} rows, in a list; got {column!r}")
        if len(column) != count:
            raise ValueError(f"group column {key!r} has {len(column)} rows for {count} {what}")
    return {key: tuple(str(v) for v in column) for key, column in groups.items()}


def rows_of(index: int | slice | Sequence[int], count: int) -> list[int]:
    """Row numbers of an index, checked."""
    if isinstance(index, slice):
        return list(range(count))[index]
    rows = [index] if isinstance(index, int) else [int(i) for i in index]
    if any(not -count <= r < count for r in rows):
        raise IndexError(f"row {max(rows, key=abs)} of {count}")
    return [r % count for r in rows]


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Movements of unequal length in one tensor, padded with 0 or False."""
    return torch.nn.utils.rnn.pad_sequence(list(parts), batch_first=True)
