"""Columns of a table as movements: what groups rows, what times them, and channels with units."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records.arrays import doubles
from zoo.datasets.records.clock import consecutive, seconds

__all__ = ["GROUPS", "TIMES", "Part", "name_and_unit", "named_matrix", "parts_of_table", "role"]

TIMES = ("time", "t", "seconds")
FRAMES = ("frame", "frames")
GROUPS = ("movement", "trial", "subject", "group", "session")
_BRACKETS = re.compile(r"^(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")
_ATOM = r"(?:[munkMcd]?(?:m|s|g|N|V|A|W|J|Hz|Pa|rad|Nm)|µ(?:m|s|V)|deg|degrees|°|sec|min|h|%)"
_POWER = r"(?:\^?-?[0-9]|[²³]|⁻[¹²])?"
_UNIT = rf"{_ATOM}{_POWER}(?:[/·* ]{_ATOM}{_POWER})*"
_PARENTHESES = re.compile(rf"^(?P<name>.*\S)\s*\((?P<unit>{_UNIT})\)$")


@dataclass(frozen=True, kw_only=True)
class Part:
    """One movement as its source tells it; None where it does not.

    ``what`` names it in errors; ``units`` has one for each column, empty where it is not told;
    ``times`` are in s.
    """

    what: str
    values: NDArray[np.float64]
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    times: NDArray[np.float64] | None = None
    groups: Mapping[str, str] = field(default_factory=dict)


def name_and_unit(label: object, what: str = "column") -> tuple[str, str]:
    """A name and the unit that stands behind it in square brackets.

    In parentheses a unit is one where it is known as such; anything else belongs to the name.

    >>> name_and_unit("knee [rad]"), name_and_unit("hip")
    (('knee', 'rad'), ('hip', ''))
    >>> name_and_unit("knee (deg)"), name_and_unit("speed (m/s)"), name_and_unit("knee (left)")
    (('knee', 'deg'), ('speed', 'm/s'), ('knee (left)', ''))
    """
    if isinstance(label, tuple):
        raise ValueError(
            f"{what} {label!r} has several levels; one name is needed: "
            "frame.columns = ['_'.join(c) for c in frame.columns]"
        )
    text = str(label).strip()
    found = _BRACKETS.match(text) or _PARENTHESES.match(text)
    return (found["name"], found["unit"].strip()) if found else (text, "")


def role(label: object) -> str:
    """What a column is, by its name: ``group``, ``time``, ``frame`` or ``channel``.

    >>> [role(c) for c in ("Trial", "time [ms]", "frame", "knee [rad]")]
    ['group', 'time', 'frame', 'channel']
    """
    name = name_and_unit(label)[0].lower()
    roles = {"group": GROUPS, "time": TIMES, "frame": FRAMES}
    return next((r for r, names in roles.items() if name in names), "channel")


def parts_of_table(
    columns: Mapping[Any, Any],
    what: str,
    times: NDArray[np.float64] | None = None,
    frames: NDArray[Any] | None = None,
) -> list[Part]:
    """The movements of a table: its rows are frames, in order.

    Columns named movement, trial, subject, group or session say which rows belong together; one
    named time, t or seconds has the times (in s, or in the unit in its brackets), one named frame
    the frames' numbers; all others are channels. ``times`` and ``frames`` are those of an index.
    """
    names = {label: name_and_unit(label) for label in columns}
    _distinct([name for name, _ in names.values()], what)
    by_role: dict[str, list[Any]] = {r: [] for r in ("group", "time", "frame", "channel")}
    for label in columns:
        by_role[role(label)].append(label)
    channels = by_role["channel"]
    if not channels:
        raise ValueError(f"{what} has no channel: its columns are {_shown(names.values())}")
    if len(by_role["time"]) > 1:
        raise ValueError(f"{what} has several columns of times: {', '.join(by_role['time'])}")
    for label in by_role["time"]:
        times = seconds(columns[label], names[label][1], f"time of {what}")
    values = _stacked([doubles(columns[c], f"column {c!r} of {what}") for c in channels])
    groups = {names[g][0].lower(): _words(columns[g], g, what) for g in by_role["group"]}
    counted = {f"column {c!r}": np.asarray(columns[c]) for c in by_role["frame"]}
    if frames is not None and not by_role["time"]:
        counted["index"] = frames
    parts = []
    for key, rows in _runs(groups, len(values), what):
        name = ", ".join(f"{k} {v}" for k, v in key.items())
        whole = f"{what}, {name}" if name else what
        for source, numbers in counted.items():
            consecutive(numbers[rows], f"{source} of {whole}")
        part = Part(
            what=whole,
            values=values[rows],
            names=tuple(names[c][0] for c in channels),
            units=tuple(names[c][1] for c in channels),
            times=None if times is None else times[rows],
            groups=key,
        )
        parts.append(part)
    return parts


def named_matrix(columns: Mapping[Any, Any], what: str) -> Part:
    """All columns of a table as a matrix, none of them with a role of its own."""
    labels = [name_and_unit(label) for label in columns]
    _distinct([name for name, _ in labels], what)
    values = _stacked([doubles(v, f"column {c!r} of {what}") for c, v in columns.items()])
    names, units = zip(*labels, strict=True)
    return Part(what=what, values=values, names=names, units=units)


def _runs(
    groups: Mapping[str, Sequence[str]], count: int, what: str
) -> list[tuple[dict[str, str], slice]]:
    """Rows of every movement, which stand together."""
    if not groups:
        return [({}, slice(0, count))]
    keys = list(zip(*groups.values(), strict=True))
    starts = [i for i in range(count) if i == 0 or keys[i] != keys[i - 1]]
    known: set[tuple[str, ...]] = set()
    for start in starts:
        if keys[start] in known:
            raise ValueError(
                f"{what}: rows of {_key(groups, keys[start])} begin again at row {start}; those of "
                "a movement must follow one another: sort by movement and time"
            )
        known.add(keys[start])
    stops = [*starts[1:], count]
    return [
        (dict(zip(groups, keys[a], strict=True)), slice(a, b))
        for a, b in zip(starts, stops, strict=True)
    ]


def _key(groups: Mapping[str, Sequence[str]], key: tuple[str, ...]) -> str:
    return ", ".join(f"{k} {v}" for k, v in zip(groups, key, strict=True))


def _words(column: Any, label: object, what: str) -> tuple[str, ...]:
    found = column if isinstance(column, list | tuple) else np.asarray(column).tolist()
    words = [str(int(v)) if isinstance(v, float) and v.is_integer() else v for v in found]
    for row, word in enumerate(words):
        if word is None or word == "" or word != word or str(word) == "<NA>":
            raise ValueError(f"column {label!r} of {what} is empty at row {row}")
    return tuple(str(w) for w in words)


def _stacked(columns: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.stack(columns, -1)


def _distinct(names: Sequence[str], what: str) -> None:
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"{what} has several columns named {', '.join(twice)}")
    if "" in names:
        raise ValueError(f"{what} has a column without a name, number {names.index('')}")


def _shown(labels: Any) -> str:
    return ", ".join(name for name, _ in labels) or "none"
