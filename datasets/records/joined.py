"""Records joined into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from zoo.arguments import list_of
from zoo.datasets.records.checks import Groups
from zoo.datasets.records.pairs import Pairs
from zoo.datasets.records.sequences import Sequences

__all__ = ["concatenate"]

_Record = TypeVar("_Record", Pairs, Sequences)
_ALIKE = (
    "channels",
    "units",
    "features",
    "feature_units",
    "control_names",
    "control_units",
    "time_normalised",
)


def concatenate(records: Sequence[_Record]) -> _Record:
    """One record of all movements or items, in the order given.

    Movements of unlike length are padded with missing entries, as in any record. Channels, units,
    rate, controls and the names of group columns must be the same; equal values of a group column
    mean the same group. Of time-normalised movements the rate becomes that of the mean duration.

    Raises ValueError for records that differ, by what and where, and TypeError for unlike kinds.

    >>> import numpy as np
    >>> parts = [Sequences.from_arrays(np.ones((2, n, 1)), rate=60.0) for n in (5, 7)]
    >>> both = concatenate(parts)
    >>> both.lengths.tolist(), both.values.shape
    ([5, 5, 7, 7], torch.Size([4, 7, 1]))
    """
    listed = () if isinstance(records, Pairs | Sequences) else list_of(records, "records")
    if not listed or any(not isinstance(r, Pairs | Sequences) for r in listed):
        raise ValueError(
            "concatenate takes a list of at least one record, of Sequences or Pairs; got "
            f"{records!r:.60}"
        )
    first = records[0]
    for i, record in enumerate(records[1:], 1):
        _check(first, record, i)
    joined: dict[str, Any] = {
        part.name: _joined([getattr(r, part.name) for r in records])
        for part in fields(first)
        if isinstance(getattr(first, part.name), Tensor)
    }
    for part in ("name", "provenance"):
        joined[part] = " + ".join(dict.fromkeys(getattr(r, part) for r in records))
    groups = {k: tuple(v for r in records for v in r.groups[k]) for k in first.groups}
    whole = replace(first, **joined, groups=groups)
    return _timed(whole, records) if isinstance(whole, Sequences) else whole


def _check(first: Pairs | Sequences, other: Pairs | Sequences, place: int) -> None:
    if type(first) is not type(other):
        raise TypeError(
            f"records must be of one kind; the first is {type(first).__name__}, record {place} is "
            f"{type(other).__name__}"
        )
    for name in _ALIKE:
        mine, theirs = getattr(first, name, None), getattr(other, name, None)
        if mine != theirs:
            raise ValueError(f"{name.replace('_', ' ')} differ: {_difference(mine, theirs, place)}")
    _check_groups(first.groups, other.groups, place)
    if isinstance(first, Sequences) and isinstance(other, Sequences):
        _check_time(first, other, place)
    for part in fields(first):
        mine, theirs = getattr(first, part.name), getattr(other, part.name)
        if isinstance(mine, Tensor) and mine.dtype != theirs.dtype:
            raise ValueError(
                f"number types of {part.name} differ: {mine.dtype} in the first record, "
                f"{theirs.dtype} in record {place}; bring them to one by data.to(dtype=...)"
            )


def _difference(mine: Any, theirs: Any, place: int) -> str:
    if not isinstance(mine, tuple) or len(mine) != len(theirs):
        counts = [len(v) if isinstance(v, tuple) else v for v in (mine, theirs)]
        return f"{counts[0]} in the first record, {counts[1]} in record {place}"
    at = next(i for i, (a, b) in enumerate(zip(mine, theirs, strict=True)) if a != b)
    return f"number {at} is {mine[at]!r} in the first record, {theirs[at]!r} in record {place}"


def _check_groups(first: Groups, other: Groups, place: int) -> None:
    for key in {**first, **other}:
        if key not in first or key not in other:
            where = "the first record" if key not in first else f"record {place}"
            raise ValueError(f"group column {key!r} is missing in {where}; all need the same ones")


def _check_time(first: Sequences, other: Sequences, place: int) -> None:
    if first.time_normalised:
        frames = {int(n) for r in (first, other) for n in r.lengths}
        if len(frames) > 1:
            raise ValueError(
                f"time-normalised movements need one number of frames; got {min(frames)} to "
                f"{max(frames)} in the first record and record {place}: bring them to it by "
                "data.resampled(frames)"
            )
    elif abs(first.rate - other.rate) > 1e-6 * first.rate:
        raise ValueError(
            f"rates differ: {first.rate:g} Hz in the first record, {other.rate:g} Hz in record "
            f"{place}; bring them to one by data.resampled(rate=...)"
        )
    if first._ahead != other._ahead:
        raise ValueError(
            f"controls go on for {first._ahead} frames after the last one in the first record, for "
            f"{other._ahead} in record {place}"
        )


def _joined(parts: list[Tensor]) -> Tensor:
    """Rows one below the other; a time axis is padded with 0 or False."""
    if parts[0].ndim < 3:
        return torch.cat(parts)
    longest = max(p.shape[1] for p in parts)
    return torch.cat([pad(p, (0, 0, 0, longest - p.shape[1])) for p in parts])


def _timed(whole: Sequences, records: Sequence[Sequences]) -> Sequences:
    """Notes of all; where time is normalised, the rate of the mean duration."""
    notes = tuple(note for r in records for note in r.notes)
    if not whole.time_normalised:
        return replace(whole, notes=notes)
    intervals = [float((r.lengths - 1).sum()) for r in records]
    seconds = sum(n / r.rate for n, r in zip(intervals, records, strict=True))
    return replace(whole, notes=notes, rate=sum(intervals) / seconds)
