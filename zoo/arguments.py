"""What users give: numbers, names, lists and paths, checked and named when wrong."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from numbers import Integral, Real
from pathlib import Path
from typing import Any

__all__ = ["level_of", "list_of", "names_of", "path_of", "positive", "seed_of", "whole_number"]

_SEEDS = 2**63


def whole_number(value: object, what: str, least: int = 1, unit: str = "") -> int:
    """``value`` as an int of at least ``least``; 1.5, True, "3" and None are refused.

    Raises TypeError for what is no whole number and ValueError for one that is too small.

    >>> whole_number(3, "horizon")
    3
    >>> whole_number(1.5, "horizon")
    Traceback (most recent call last):
    TypeError: horizon must be a whole number; got 1.5
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{what} must be a whole number{unit and f' of {unit}s'}; got {value!r}")
    if value < least:
        raise ValueError(f"{what} must be at least {least}{unit and f' {unit}'}; got {value}")
    return int(value)


def seed_of(seed: object, what: str = "seed") -> int:
    """A seed: a whole number from 0 to 2⁶³ − 1, which every generator takes as it is.

    >>> seed_of("0")
    Traceback (most recent call last):
    TypeError: seed must be a whole number; got '0'
    """
    number = whole_number(seed, what, 0)
    if number >= _SEEDS:
        raise ValueError(f"{what} must be below 2**63; got {number}")
    return number


def level_of(level: object) -> float:
    """A probability strictly between 0 and 1; a percentage is told as what it may have meant.

    >>> level_of(90)
    Traceback (most recent call last):
    ValueError: level must be between 0 and 1; got 90: for 90 % write 0.9
    """
    number = level.item() if hasattr(level, "item") and _single(level) else level
    if isinstance(number, bool) or not isinstance(number, Real):
        raise TypeError(f"level must be one number between 0 and 1; got {level!r}")
    number = float(number)
    if not 0 < number < 1:
        meant = f": for {number:g} % write {number / 100:g}" if 5 <= number < 100 else ""
        raise ValueError(f"level must be between 0 and 1; got {number:g}{meant}")
    return number


def positive(value: object, what: str) -> float:
    """A positive, finite number.

    >>> positive("2", "duration")
    Traceback (most recent call last):
    TypeError: duration must be a number; got '2'
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{what} must be a number; got {value!r}")
    if not 0 < float(value) < math.inf:
        raise ValueError(f"{what} must be positive and finite; got {value}")
    return float(value)


def path_of(value: object, what: str) -> Path:
    """A path, given as text or as a path.

    >>> path_of(3, "load takes the folder of a run:")
    Traceback (most recent call last):
    TypeError: load takes the folder of a run: a path, as text or pathlib.Path; got 3
    """
    if not isinstance(value, (str, os.PathLike)) or isinstance(os.fspath(value), bytes):
        raise TypeError(f"{what} a path, as text or pathlib.Path; got {value!r}")
    if not os.fspath(value):
        raise ValueError(f"{what} a path, as text or pathlib.Path; got an empty one")
    return Path(value)


def list_of(value: object, what: str) -> list[Any]:
    """The parts of a list; text is no list, and neither is a number.

    >>> list_of("forecast", "tasks")
    Traceback (most recent call last):
    TypeError: tasks must be a list; got 'forecast'
    """
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
        raise TypeError(f"{what} must be a list; got {value!r}")
    return list(value)


def names_of(value: object, what: str) -> list[str]:
    """A list of texts.

    >>> names_of([1, 2], "channels")
    Traceback (most recent call last):
    TypeError: channels must be a list of texts; got [1, 2]
    """
    found = list_of(value, what)
    if any(not isinstance(name, str) for name in found):
        raise TypeError(f"{what} must be a list of texts; got {found}")
    return found


def _single(value: object) -> bool:
    return getattr(value, "ndim", None) == 0
