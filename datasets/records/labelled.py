"""What users give as data, understood: arrays, frames and labelled arrays as named movements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from zoo.datasets.records.agreement import Movements, agreed
from zoo.datasets.records.arrays import doubles, matrix
from zoo.datasets.records.clock import consecutive
from zoo.datasets.records.columns import Part, named_matrix, parts_of_table
from zoo.datasets.records.frames import (
    columns_of,
    index_of,
    is_series,
    row_labels,
    series_label,
    unnamed,
    without_names,
)
from zoo.datasets.records.xarrays import is_labelled, labelled_matrix, parts_of_labelled

__all__ = ["Items", "check_same_items", "items", "movements"]


def movements(
    given: object,
    *,
    what: str = "sequence",
    channels: Sequence[str] | None,
    units: str | Sequence[str],
    rate: object,
    groups: Mapping[str, Sequence[object]] | None,
) -> Movements:
    """The movements of whatever was given, their channels in one order.

    Columns of several frames are brought to the order of the first, or of ``channels``, by name.
    Raises ValueError or TypeError, which names the movement, where something cannot be read or
    where two sources disagree.
    """
    parts = _parts(given, channels, what)
    if not parts:
        raise ValueError(f"no {what} is given; at least one is needed")
    return agreed(parts, channels=channels, units=units, rate=rate, groups=groups)


@dataclass(frozen=True, kw_only=True)
class Items:
    """Rows of regression data; where told, the name of their dimension and their index."""

    part: Part
    dimension: str | None = None
    index: Any = None


def items(given: Any, names: Sequence[str] | None, what: str) -> Items:
    """The rows of whatever was given; one dimension is one target, or the one feature named."""
    if isinstance(given, str | Path):
        raise TypeError(f"{what} must be an array; got {str(given)!r}")
    if is_labelled(given):
        part, dimension = labelled_matrix(given, what)
        index = given.indexes.get(dimension)
        return _checked(part, dimension, None if index is None else index.to_numpy())
    if (columns := columns_of(given)) is not None:
        part = named_matrix(columns, what)
        return _checked(without_names(part) if unnamed(given) else part, None, row_labels(given))
    if is_series(given):
        values = doubles(given, what)[:, None]
        return _checked(
            Part(what=what, values=values, **series_label(given)), None, row_labels(given)
        )
    values = doubles(given, what)
    if values.ndim == 1 and (what == "targets" or (names is not None and len(names) == 1)):
        values = values[:, None]
    if values.ndim == 1:
        raise ValueError(
            f"{what} must be (item, feature); got shape {values.shape}: x[:, None] makes it items "
            "of one feature, x[None] one item"
        )
    return _checked(Part(what=what, values=values))


def _checked(part: Part, dimension: str | None = None, index: Any = None) -> Items:
    matrix(part.values, part.what)
    return Items(part=part, dimension=dimension, index=index)


def check_same_items(inputs: Items, targets: Items) -> None:
    """Refuse inputs and targets whose rows are not the same ones."""
    mine, theirs = inputs.dimension, targets.dimension
    if mine is not None and theirs is not None and mine != theirs:
        raise ValueError(f"inputs have their items along {mine!r}, targets along {theirs!r}")
    a, b = inputs.index, targets.index
    if a is None or b is None or len(a) != len(b) or np.array_equal(a, b):
        return
    row = next(i for i, (x, y) in enumerate(zip(a, b, strict=True)) if x != y)
    raise ValueError(
        f"inputs and targets have their items in unlike order: at row {row} their index is "
        f"{a[row]!s} and {b[row]!s}"
    )


def _parts(given: Any, channels: Sequence[str] | None, name: str) -> list[Part]:
    """Movements of one thing, or of a list of things."""
    if isinstance(given, str | Path):
        raise TypeError(f"arrays are needed; zoo.load_data({str(given)!r}) reads a file")
    single = _labelled_parts(given, "the data")
    if single is not None:
        return single
    if isinstance(given, Mapping):
        raise TypeError(
            f"a list of arrays is needed, (time, channel) each; got {type(given).__name__}: "
            "list(arrays.values()) with groups={'trial': list(arrays)}, or zoo.load_data for a file"
        )
    if isinstance(given, np.ndarray | Tensor) or not isinstance(given, Iterable):
        return _of_array(given, channels, name)
    parts: list[Part] = []
    for i, one in enumerate(given):
        what = f"{name} {i}"
        found = _labelled_parts(one, what)
        parts += [_of_matrix(one, channels, what)] if found is None else found
    return parts


def _labelled_parts(given: Any, what: str) -> list[Part] | None:
    """Movements of a frame or a labelled array; None of anything else."""
    if is_labelled(given):
        return parts_of_labelled(given, what)
    if (columns := columns_of(given)) is not None:
        parts = parts_of_table(columns, what, *index_of(given, what))
        return [without_names(p) for p in parts] if unnamed(given) else parts
    if is_series(given):
        label = series_label(given)
        if label:
            times, frames = index_of(given, what)
            if frames is not None:
                consecutive(frames, f"index of {what}")
            return [Part(what=what, values=doubles(given, what)[:, None], times=times, **label)]
    return None


def _of_array(given: Any, channels: Sequence[str] | None, name: str) -> list[Part]:
    """A three-dimensional array is several movements, a two-dimensional one is one."""
    values = doubles(given, f"array of every {name}")
    if values.ndim == 3:
        return [Part(what=f"{name} {i}", values=v) for i, v in enumerate(values)]
    return [_of_matrix(values, channels, f"{name} 0")]


def _of_matrix(given: Any, channels: Sequence[str] | None, what: str) -> Part:
    values = doubles(given, what)
    if values.ndim == 1 and channels is not None and len(channels) == 1:
        values = values[:, None]
    if values.ndim != 2:
        remedy = ""
        if values.ndim == 1:
            remedy = (
                ": x[:, None], or channels=['knee'], makes it a movement of one channel, "
                "x[None] one frame"
            )
        raise ValueError(f"{what} must be (time, channel); got shape {values.shape}{remedy}")
    return Part(what=what, values=matrix(values, what))
