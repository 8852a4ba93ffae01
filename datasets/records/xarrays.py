"""Labelled arrays of xarray as movements: dimensions by their names, coordinates as labels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records.arrays import doubles
from zoo.datasets.records.clock import consecutive, seconds
from zoo.datasets.records.columns import FRAMES, TIMES, Part, name_and_unit

__all__ = ["is_labelled", "labelled_matrix", "parts_of_labelled"]

CHANNELS = ("channel", "channels", "joint", "joints", "feature", "variable", "target")
UNITS = ("unit", "units")


def is_labelled(thing: object) -> bool:
    """Whether it is a DataArray or a Dataset of xarray."""
    return all(hasattr(thing, name) for name in ("dims", "coords", "attrs"))


def parts_of_labelled(thing: Any, what: str) -> list[Part]:
    """The movements of a DataArray (time, channel) or (movement, time, channel), or of a Dataset.

    The dimension of frames is named time, t, seconds or frame. Of two others, that of channels is
    named channel, joint or feature, or is the last. Every variable of a Dataset is a channel. Names
    are the coordinates of the channels, units those of ``units`` in their attributes or of a
    coordinate ``unit``; coordinates along the movements are group columns.
    """
    array, names, units = _with_channels(thing, what)
    frames = _dimension(array, (*TIMES, *FRAMES))
    if frames is None:
        raise ValueError(
            f"dimensions of {what} are {_told(array)}; one of them must be named time or frame"
        )
    channels = _channel_dimension(array, frames, what)
    movements = [d for d in array.dims if d not in (frames, channels)]
    if len(movements) > 1:
        raise ValueError(
            f"{what} has dimensions {_told(array)}; (movement, time, channel) are needed"
        )
    array = array.transpose(*movements, frames, channels)
    times = _times(array, frames, what)
    if not movements:
        return [Part(what=what, values=_values(array, what), names=names, units=units, times=times)]
    groups = _groups(array, movements[0])
    every = _values(array, what)
    return [
        Part(
            what=f"{movements[0]} {i} of {what}",
            values=values,
            names=names,
            units=units,
            times=times,
            groups={k: v[i] for k, v in groups.items()},
        )
        for i, values in enumerate(every)
    ]


def labelled_matrix(thing: Any, what: str) -> tuple[Part, str]:
    """A DataArray (item, feature) or (item,), or a Dataset, and the name of its first dimension."""
    if getattr(thing, "ndim", 2) == 1 and thing.name is None:
        return Part(what=what, values=_values(thing, what)[:, None]), str(thing.dims[0])
    array, names, units = _with_channels(thing, what)
    if array.ndim != 2:
        raise ValueError(f"{what} has dimensions {_told(array)}; (item, feature) are needed")
    item = str(array.dims[0])
    return Part(what=what, values=_values(array, what), names=names, units=units), item


def _with_channels(
    thing: Any, what: str
) -> tuple[Any, tuple[str, ...] | None, tuple[str, ...] | None]:
    """An array with a dimension of channels, their names and units where these are told."""
    if hasattr(thing, "data_vars"):
        return _of_dataset(thing, what)
    if thing.ndim == 1 and thing.name is not None:
        name, unit = name_and_unit(thing.name)
        return thing.expand_dims("channel", -1), (name,), (_unit(thing) or unit,)
    last = _dimension(thing, CHANNELS) or thing.dims[-1]
    if last not in thing.coords or thing.coords[last].dtype.kind not in "UOT":
        labels = None
    else:
        labels = [name_and_unit(label) for label in thing.coords[last].values.tolist()]
    count = thing.sizes[last]
    units = _own_units(thing, last, count)
    if labels is not None:
        units = units or tuple(u for _, u in labels)
    return thing, None if labels is None else tuple(n for n, _ in labels), units


def _of_dataset(thing: Any, what: str) -> tuple[Any, tuple[str, ...], tuple[str, ...]]:
    variables = list(thing.data_vars)
    if not variables:
        raise ValueError(f"{what} is a Dataset without variables")
    first = thing[variables[0]]
    for name in variables:
        if set(thing[name].dims) != set(first.dims):
            raise ValueError(
                f"variables of {what} must have the same dimensions; {variables[0]!r} has "
                f"{_told(first)}, {name!r} has {_told(thing[name])}"
            )
    if _dimension(first, CHANNELS) is not None:
        raise ValueError(
            f"{what} is a Dataset whose variables have channels themselves: give one of them, such "
            f"as dataset[{variables[0]!r}]"
        )
    labels = [name_and_unit(name) for name in variables]
    units = tuple(_unit(thing[v]) or u for v, (_, u) in zip(variables, labels, strict=True))
    import xarray

    array = xarray.DataArray(
        np.stack([thing[v].transpose(*first.dims).values for v in variables], -1),
        dims=(*first.dims, "channel"),
        coords={k: c for k, c in first.coords.items() if c.dims and set(c.dims) <= set(first.dims)},
    )
    return array, tuple(n for n, _ in labels), units


def _channel_dimension(array: Any, frames: str, what: str) -> str:
    named = _dimension(array, CHANNELS)
    if named is not None:
        return named
    others = [d for d in array.dims if d != frames]
    if len(others) == 2 and array.dims[1] != frames:
        raise ValueError(
            f"dimensions of {what} are {_told(array)}: name that of the channels 'channel', or "
            "bring them to (movement, time, channel)"
        )
    if not others:
        raise ValueError(
            f"{what} has times alone: name the array, array.rename('knee'), to make it one channel"
        )
    return str(others[-1])


def _dimension(array: Any, names: tuple[str, ...]) -> str | None:
    return next((d for d in array.dims if str(d).lower() in names), None)


def _values(array: Any, what: str) -> NDArray[np.float64]:
    return doubles(array.values, what)


def _times(array: Any, frames: str, what: str) -> NDArray[np.float64] | None:
    if frames not in array.coords:
        return None
    coordinate = array.coords[frames]
    if frames.lower() in FRAMES:
        consecutive(coordinate.values, f"{frames} of {what}")
        return None
    return seconds(coordinate.values, _unit(coordinate), f"{frames} of {what}")


def _groups(array: Any, movements: str) -> dict[str, list[str]]:
    """Coordinates along the movements."""
    return {
        str(name): [str(v) for v in coordinate.values.tolist()]
        for name, coordinate in array.coords.items()
        if coordinate.dims == (movements,)
    }


def _own_units(array: Any, channels: str, count: int) -> tuple[str, ...] | None:
    for name in UNITS:
        if name in array.coords and array.coords[name].dims == (channels,):
            return tuple(str(u) for u in array.coords[name].values.tolist())
    unit = _unit(array)
    return (unit,) * count if unit else None


def _unit(thing: Any) -> str:
    return str(next((thing.attrs[u] for u in ("units", "unit") if u in thing.attrs), ""))


def _told(array: Any) -> str:
    return f"({', '.join(map(str, array.dims))})"
