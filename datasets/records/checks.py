"""Checks that turn users' arrays, names and group columns into the parts of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from zoo.arguments import list_of

__all__ = [
    "Groups",
    "distinct_names",
    "group_columns",
    "pad",
    "rows_of",
    "stacked",
    "units_of",
]

Groups = dict[str, tuple[str, ...]]


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


def distinct_names(names: Sequence[str] | None, count: int, what: str) -> tuple[str, ...]:
    """The names given, or numbered ones."""
    if names is None:
        return tuple(f"{what}_{i}" for i in range(count))
    if isinstance(names, str):
        raise TypeError(f"{what} names must come as a list; got the string {names!r}")
    names = list_of(names, f"{what} names")
    if any(not isinstance(n, str) for n in names):
        raise TypeError(f"{what} names must be text; got {list(names)}")
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{count} distinct {what} names are needed; got {list(names)}")
    return tuple(names)


def units_of(units: str | Sequence[str], count: int) -> tuple[str, ...]:
    """One unit for each name."""
    if isinstance(units, str):
        return (units,) * count
    units = list_of(units, "units")
    if any(not isinstance(u, str) for u in units):
        raise TypeError(f"units must be text; got {units}")
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


def rows_of(index: object, count: int) -> list[int]:
    """Row numbers of an index: a number, a slice, numbers, or a truth value for every row.

    >>> rows_of([True, False, True], 3), rows_of(-1, 3), rows_of(slice(1, 3), 3)
    ([0, 2], [2], [1, 2])
    """
    if isinstance(index, slice):
        return list(range(count))[index]
    if index is None or isinstance(index, str | bool | float):
        raise TypeError(f"rows are chosen by numbers, a slice or truth values; got {index!r}")
    found = np.asarray(index.cpu() if isinstance(index, Tensor) else index)
    if found.ndim > 1 or (found.size and found.dtype.kind not in "iub"):
        raise TypeError(
            f"rows are chosen by whole numbers or truth values in a row; got {found.dtype} of "
            f"shape {found.shape}"
        )
    if found.dtype.kind == "b":
        if found.shape != (count,):
            raise ValueError(f"{count} rows need {count} truth values; got shape {found.shape}")
        return [int(r) for r in np.flatnonzero(found)]
    rows = [int(r) for r in np.atleast_1d(found)]
    if any(not -count <= r < count for r in rows):
        raise IndexError(f"row {max(rows, key=abs)} of {count}")
    return [r % count for r in rows]


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Movements of unequal length in one tensor, padded with 0 or False."""
    return torch.nn.utils.rnn.pad_sequence(list(parts), batch_first=True)
