"""Whatever holds real numbers, as doubles with NaN where an entry is missing; all else refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["doubles", "matrix"]

_EXACT = 2**53
_KINDS = {
    "c": "complex numbers: take real and imaginary part, or magnitude and phase, as two channels",
    "U": "text",
    "S": "text",
    "T": "text",
    "M": "dates: times belong into an index or a column named time",
    "m": "durations: times belong into an index or a column named time",
    "V": "records",
}


def doubles(array: object, what: str) -> NDArray[np.float64]:
    """The numbers of an array, a list, a tensor or a masked array; masked entries become NaN.

    Integers and truth values are taken as they are. Raises TypeError for what holds no real
    numbers and ValueError for rows of unlike length and for integers that no double can hold.

    >>> doubles(np.ma.masked_array([1, 2], mask=[False, True]), "x")
    array([ 1., nan])
    """
    found = _array(array, what)
    kind = found.dtype.kind
    if kind == "O":
        raise TypeError(f"{what} holds {_stranger(found)}; numbers are needed, NaN where none is")
    if kind not in "fiub":
        raise TypeError(
            f"{what} holds {_KINDS.get(kind, str(found.dtype))}; real numbers are needed"
        )
    values = np.ma.getdata(found)
    if kind in "iu" and values.size and max(int(values.max()), -int(values.min())) > _EXACT:
        raise ValueError(f"{what} holds integers beyond 2**53, which doubles do not hold exactly")
    numbers = values.astype(np.float64)
    if isinstance(found, np.ma.MaskedArray):
        numbers[np.ma.getmaskarray(found)] = np.nan
    return numbers


def matrix(array: object, what: str) -> NDArray[np.float64]:
    """A non-empty finite matrix of doubles; NaN is allowed."""
    found = doubles(array, what)
    if found.ndim != 2 or 0 in found.shape:
        raise ValueError(f"{what} must be a non-empty matrix; got shape {found.shape}")
    if np.isinf(found).any():
        row, column = np.argwhere(np.isinf(found))[0]
        raise ValueError(
            f"{what} is infinite at row {row}, column {column}; NaN stands for a missing entry"
        )
    return found


def _array(array: object, what: str) -> Any:
    """An array of numpy, masked where any part is."""
    if isinstance(array, list | tuple) and array and all(isinstance(a, Tensor) for a in array):
        array = torch.stack(list(array))
    if isinstance(array, Tensor):
        array = array.detach().cpu()
        return (array.double() if array.is_floating_point() else array).numpy()
    if isinstance(array, np.ma.MaskedArray):
        return array
    if array is None or isinstance(array, str | bytes | dict | set):
        raise TypeError(f"{what} must be an array of numbers; got {_told(array)}")
    try:
        if isinstance(array, list | tuple) and any(isinstance(a, np.ma.MaskedArray) for a in array):
            return np.ma.array(array)
        return np.asarray(array)
    except (ValueError, TypeError) as error:
        unlike = "inhomogeneous" in str(error) or "same size" in str(error)
        reason = "rows of unlike length" if unlike else str(error)
        raise ValueError(f"{what} is no array of numbers: {reason}") from None


def _stranger(found: Any) -> str:
    """The first entry of an array of objects that is no number."""
    entries = np.ma.getdata(found).ravel()
    first = next((e for e in entries if not isinstance(e, int | float)), None)
    if first is None and not any(e is None for e in entries):
        return "Python objects: .astype(float) makes numbers of them"
    return _told(first)


def _told(thing: object) -> str:
    text = repr(thing)
    return text if len(text) <= 60 else f"a {type(thing).__name__}"
