"""What of a record determines a training on it, told part by part."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields

from torch import Tensor

from zoo.datasets.records import Pairs, Sequences

__all__ = ["contents"]

_LABELS = ("name", "provenance", "notes")


def contents(data: Sequences | Pairs | None, role: str) -> dict[str, str]:
    """Every part of a record by name: numbers in words, all else by a digest that begins with #.

    Name, provenance and notes do not count.

    >>> import numpy as np
    >>> data = Sequences.from_arrays(np.zeros((2, 5, 1)), rate=60.0)
    >>> found = contents(data, "training")
    >>> found["rate of the training data"], found["values of the training data"][0]
    ('60.0', '#')
    >>> contents(None, "validation")
    {'validation data': 'absent'}
    """
    found = {f"{role} data": "absent" if data is None else type(data).__name__}
    if data is None:
        return found
    for part in fields(data):
        if part.name not in _LABELS:
            found[f"{part.name} of the {role} data"] = _told(getattr(data, part.name))
    return found


def _told(value: object) -> str:
    if value is None or isinstance(value, bool | float):
        return str(value)
    if isinstance(value, Tensor):
        content = f"{value.dtype} {tuple(value.shape)}".encode()
        content += value.cpu().contiguous().numpy().tobytes()
    else:
        content = json.dumps(value).encode()
    return f"#{hashlib.sha256(content).hexdigest()[:16]}"
