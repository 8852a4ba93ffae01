"""Movements of several sources in agreement: one order of channels, one unit each, one rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zoo.arguments import names_of
from zoo.datasets.records.arrays import matrix
from zoo.datasets.records.clock import common_rate
from zoo.datasets.records.columns import Part

__all__ = ["Movements", "agreed", "labels_of"]


@dataclass(frozen=True, kw_only=True)
class Movements:
    """Movements with all that their sources and the keywords tell of them, in agreement."""

    arrays: list[NDArray[np.float64]]
    names: Sequence[str] | None
    units: str | Sequence[str]
    rate: float
    groups: Mapping[str, Sequence[object]] | None


def agreed(
    parts: Sequence[Part],
    *,
    channels: Sequence[str] | None,
    units: str | Sequence[str],
    rate: object,
    groups: Mapping[str, Sequence[object]] | None,
) -> Movements:
    """Parts with one order of channels, one unit for each, one rate and one set of groups."""
    first = parts[0]
    if any((p.names is None) != (first.names is None) for p in parts):
        named = next(p.what for p in parts if p.names is not None)
        raise ValueError(f"all movements or none must have names of channels; {named} has them")
    channels = None if channels is None else names_of(channels, "channel names")
    names = first.names if channels is None or first.names is None else tuple(channels)
    places = [_places(p, names, "channels" if channels else first.what) for p in parts]
    told = [
        None if p.units is None else tuple(p.units[i] for i in at)
        for p, at in zip(parts, places, strict=True)
    ]
    arrays = [matrix(p.values, p.what)[:, at] for p, at in zip(parts, places, strict=True)]
    return Movements(
        arrays=arrays,
        names=channels if names is None else names,
        units=_one_unit(told, units, [p.what for p in parts], names),
        rate=common_rate([p.times for p in parts], rate, [p.what for p in parts]),
        groups=_group_columns(parts, groups),
    )


def labels_of(
    part: Part, names: Sequence[str] | None, units: str | Sequence[str]
) -> tuple[NDArray[np.float64], Sequence[str] | None, str | Sequence[str]]:
    """Values in the order of ``names``, names and units, where source and keywords agree."""
    order = part.names if names is None or part.names is None else tuple(names)
    at = _places(part, order, "features or channels" if names else part.what)
    told = None if part.units is None else tuple(part.units[i] for i in at)
    named = order if order is not None else names
    return part.values[:, at], named, _one_unit([told], units, [part.what], order)


def _places(part: Part, names: tuple[str, ...] | None, source: str) -> list[int]:
    """Columns of a part in the order of ``names``."""
    if names is None or part.names is None:
        return list(range(part.values.shape[-1]))
    missing = [n for n in names if n not in part.names]
    more = [n for n in part.names if n not in names]
    if missing or more:
        told = [f"lacks {', '.join(missing)}"] * bool(missing)
        told += [f"has {', '.join(more)} besides"] * bool(more)
        raise ValueError(
            f"{part.what} {' and '.join(told)}, where {source} "
            f"{'name' if source == 'channels' else 'has'} {', '.join(names)}; choose columns by "
            "frame[[...]], rename them by frame.rename(columns=...)"
        )
    return [part.names.index(n) for n in names]


def _one_unit(
    told: Sequence[tuple[str, ...] | None],
    units: str | Sequence[str],
    what: Sequence[str],
    names: tuple[str, ...] | None,
) -> str | Sequence[str]:
    """The units given, or else those that all sources tell."""
    known = [(u, w) for u, w in zip(told, what, strict=True) if u is not None and any(u)]
    if not known:
        return units
    width = len(known[0][0])
    wanted = [units] * width if isinstance(units, str) else list(units)
    found: list[str] = wanted if len(wanted) == width else [""] * width
    for each, source in known:
        for c, unit in enumerate(each):
            if unit and found[c] and unit != found[c]:
                channel = names[c] if names else f"channel {c}"
                raise ValueError(f"unit of {channel} is {found[c]!r}; {source} has {unit!r}")
            found[c] = found[c] or unit
    return found if len(wanted) == width else units


def _group_columns(
    parts: Sequence[Part], groups: Mapping[str, Sequence[object]] | None
) -> Mapping[str, Sequence[object]] | None:
    """Group columns of the sources and those given."""
    first = parts[0].groups
    for part in parts:
        if set(part.groups) != set(first):
            raise ValueError(
                f"group columns differ: {', '.join(first) or 'none'} in {parts[0].what}, "
                f"{', '.join(part.groups) or 'none'} in {part.what}"
            )
    found = {key: tuple(p.groups[key] for p in parts) for key in first}
    if groups is None:
        return found or None
    if not isinstance(groups, Mapping):
        raise TypeError(
            "groups must be a mapping of names to columns, such as {'subject': ['a', 'b']}; got "
            f"{groups!r:.60}"
        )
    for key in groups:
        if key in found and tuple(str(v) for v in groups[key]) != found[key]:
            raise ValueError(f"group column {key!r} is given and in the data, with other values")
    return {**found, **groups}
