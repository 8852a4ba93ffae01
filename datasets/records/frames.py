"""Frames of pandas, polars and Arrow, and arrays of records: their columns, names and index."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records.clock import seconds
from zoo.datasets.records.columns import TIMES, Part, name_and_unit

__all__ = [
    "columns_of",
    "index_of",
    "is_series",
    "row_labels",
    "series_label",
    "unnamed",
    "without_names",
]


def columns_of(given: Any) -> dict[Any, Any] | None:
    """Columns of a frame (pandas, polars, Arrow) or of an array of records, by name."""
    if isinstance(given, np.ndarray) and given.dtype.names is not None:
        return {name: given[name] for name in given.dtype.names}
    names = getattr(given, "columns", None)
    if names is None or not hasattr(given, "to_numpy"):
        names = getattr(given, "column_names", None)
    if names is None or not hasattr(given, "__getitem__"):
        return None
    labels = list(names)
    if len(set(labels)) != len(labels):
        twice = next(c for c in labels if labels.count(c) > 1)
        raise ValueError(f"the frame has several columns named {twice!r}")
    return {label: _plain(given[label]) for label in labels}


def _plain(column: Any) -> Any:
    """A column as an array; one that may hold NA as doubles with NaN."""
    kind = str(getattr(column, "dtype", ""))
    if kind[:1] in "IUFB" and hasattr(column, "isna"):
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    return column.to_numpy()


def unnamed(given: Any) -> bool:
    """Whether the columns are numbered 0, 1, …, as a frame of a bare array has them."""
    names = getattr(given, "columns", None)
    return names is not None and list(names) == list(range(len(names)))


def without_names(part: Part) -> Part:
    """A part whose columns were only numbered."""
    return Part(what=part.what, values=part.values, times=part.times, groups=part.groups)


def is_series(given: Any) -> bool:
    """Whether it is one column of a frame."""
    return hasattr(given, "to_numpy") and hasattr(given, "name") and getattr(given, "ndim", 1) == 1


def series_label(given: Any) -> dict[str, Any]:
    """Name and unit of a column; empty where it has no name."""
    if given.name is None:
        return {}
    name, unit = name_and_unit(given.name)
    return {"names": (name,), "units": (unit,)}


def row_labels(given: Any) -> Any:
    """The labels of rows that an index holds; None without one."""
    index: Any = getattr(given, "index", None)
    return index.to_numpy() if hasattr(index, "to_numpy") else None


def index_of(given: Any, what: str) -> tuple[NDArray[np.float64] | None, NDArray[Any] | None]:
    """Times that an index tells, in s, or the numbers of frames; None where it tells neither."""
    values = row_labels(given)
    if values is None:
        return None, None
    label = given.index.name
    name, unit = ("", "") if label is None else name_and_unit(label)
    if values.dtype.kind in "Mmf" or name.lower() in TIMES:
        return seconds(values, unit, f"index of {what}"), None
    return None, values if values.dtype.kind in "iu" else None
