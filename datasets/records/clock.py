"""Times of frames: in seconds, regular, and the rate that they tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records.arrays import doubles

__all__ = ["checked_rate", "common_rate", "consecutive", "regular_rate", "seconds"]

JITTER = 0.2
NEAR = 0.005
_DIGITS = 9
_UNITS = {
    **dict.fromkeys(("", "s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), 1e-9),
}


def seconds(times: object, unit: str, what: str) -> NDArray[np.float64]:
    """Times in s: of numbers in ``unit``, of dates from the first of them, of durations.

    >>> seconds([0, 20, 40], "ms", "time")
    array([0.  , 0.02, 0.04])
    """
    found: Any = np.asarray(times)
    if found.dtype.kind == "M":
        found = found - found[:1]
    if found.dtype.kind == "m":
        return doubles(found.astype("timedelta64[ns]").astype(np.int64), what) * 1e-9
    if unit not in _UNITS:
        raise ValueError(f"{what} is in {unit!r}; times are read in s, ms, us or ns")
    return doubles(times, what) * _UNITS[unit]


def consecutive(frames: object, what: str) -> None:
    """Refuse numbers of frames that do not follow one another."""
    numbers = doubles(frames, what)
    gaps = np.flatnonzero(np.diff(numbers) != 1)
    if not np.isfinite(numbers).all() or gaps.size:
        at = int(gaps[0]) if gaps.size else int(np.flatnonzero(~np.isfinite(numbers))[0])
        before, after = numbers[at], numbers[min(at + 1, len(numbers) - 1)]
        raise ValueError(
            f"{what} goes from {before:g} to {after:g} after row {at}: frames must follow one "
            "another; rows of NaN stand for missing ones (frame.reindex), and "
            "frame.reset_index(drop=True) says that none is missing"
        )


def regular_rate(times: NDArray[np.float64], what: str) -> float | None:
    """The rate of regular times, in Hz; None of a single one.

    Each time must be within a fifth of a frame of its place on a regular grid. The rate is the
    roundest number of Hz that the decimals of the times allow.

    >>> regular_rate(np.round(np.arange(100) / 120, 3), "time")
    120.0
    """
    if len(times) < 2:
        return None
    if not np.isfinite(times).all():
        raise ValueError(f"{what} is missing or infinite at row {_first(~np.isfinite(times))}")
    steps = np.diff(times)
    if not (steps > 0).all():
        row = _first(~(steps > 0)) + 1
        raise ValueError(
            f"{what} must rise from frame to frame; row {row} has {times[row]:g} after "
            f"{times[row - 1]:g}"
        )
    step = (times[-1] - times[0]) / len(steps)
    off = np.abs(times - times[0] - step * np.arange(len(times))) / step
    if off.max() > JITTER:
        widest = int(np.abs(steps - np.median(steps)).argmax())
        raise ValueError(
            f"{what} is irregular: frames are {np.median(steps):.4g} s apart, but "
            f"{steps[widest]:.4g} s after row {widest}; interpolate to a regular grid, or put rows "
            "of NaN where frames are missing"
        )
    return _round(step, _resolution(times) / len(steps))


def common_rate(
    times: Sequence[NDArray[np.float64] | None], rate: object, names: Sequence[str]
) -> float:
    """The rate of all movements in Hz, as given or as their times tell, which must agree."""
    given = None if rate is None else checked_rate(rate)
    told = [
        (found, len(t) - 1, name)
        for t, name in zip(times, names, strict=True)
        if t is not None and (found := regular_rate(t, f"time of {name}")) is not None
    ]
    if given is None and not told:
        raise ValueError(
            "rate is needed, in Hz (rate=120.0, or --rate 120 on the command line): the data have "
            "no times, such as a column or coordinate named time, in s"
        )
    common, _, source = max(told, key=lambda t: t[1]) if given is None else (given, 0, "")
    for found, intervals, name in told:
        if abs(found / common - 1) > max(NEAR, 2 * JITTER / intervals):
            whose = f"that of {source}" if source else "the rate given"
            raise ValueError(f"times of {name} run at {found:g} Hz; {whose} is {common:g} Hz")
    return common


def checked_rate(rate: object) -> float:
    """A positive number of Hz."""
    if not isinstance(rate, Real) or isinstance(rate, bool) or not 0 < float(rate) < math.inf:
        raise ValueError(f"rate must be a positive number, in Hz; got {rate!r}")
    return float(rate)


def _resolution(times: NDArray[np.float64]) -> float:
    """One unit of the last decimal that the times have."""
    for digits in range(_DIGITS):
        if np.abs(times - np.round(times, digits)).max() < 10.0 ** -(_DIGITS + 1):
            return 10.0**-digits
    return 10.0**-_DIGITS


def _round(step: float, doubt: float) -> float:
    """The rate with the fewest decimals whose step is the one found, or within ``doubt`` of it."""
    for allowed, most in ((step * 10.0**-_DIGITS, 4), (doubt, _DIGITS)):
        for digits in range(most):
            rate = round(float(1 / step), digits)
            if rate > 0 and abs(1 / rate - step) <= allowed:
                return rate
    return float(1 / step)


def _first(where: NDArray[np.bool_]) -> int:
    return int(np.flatnonzero(where)[0])
