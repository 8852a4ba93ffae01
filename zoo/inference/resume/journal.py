"""A journal of objective evaluations, from which an interrupted optimisation replays its past.

Optimisers here are deterministic functions of what the objective returned. So nothing of their
inner state is stored: after a crash the same optimiser runs again, is answered from the journal
as far as that goes, and arrives at the same bits as if it had never been interrupted.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from zoo.errors import DamagedRunError
from zoo.inference.minimise import Evaluate, Vector
from zoo.inference.resume.checkpoint import ANEW

__all__ = ["Journal", "clear", "exists"]

_NAME = "evaluations.jsonl"
_HEAD = {"format": "movezoo-evaluations", "version": 1}


def exists(folder: Path) -> bool:
    """Whether ``folder`` holds a journal."""
    return (folder / _NAME).is_file()


def clear(folder: Path) -> None:
    """Remove the journal of ``folder``."""
    (folder / _NAME).unlink(missing_ok=True)


class Journal:
    """Evaluations of an objective in order, on disk where ``folder`` is given.

    A line that a crash cut short is dropped. The first evaluation is always repeated: where it
    differs from the journal's, data or settings changed and the journal is refused.
    """

    def __init__(
        self, evaluate: Evaluate, folder: Path | None, resume: Literal["never", "auto", "must"]
    ) -> None:
        """Open the journal in ``folder``, empty unless ``resume`` allows to go on with it."""
        self.evaluate = evaluate
        self.path = None if folder is None else folder / _NAME
        self.count = 0
        self.past = self._open(resume)

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        """Value and gradient at ``x``, from the journal where it knows them."""
        known = self.past[self.count] if self.count < len(self.past) else None
        self.count += 1
        if known is not None and self.count > 1:
            return self._recall(known, x)
        value, gradient = self.evaluate(x)
        if known is None:
            self._append(_entry(x, value, gradient))
        elif known != _entry(x, value, gradient):
            raise DamagedRunError(f"{self.path} was written with other data or settings: {ANEW}")
        return value, gradient

    def _open(self, resume: str) -> list[dict[str, Any]]:
        if self.path is None:
            return []
        if resume == "must" and not self.path.is_file():
            raise DamagedRunError(f"{self.path.parent} holds no {_NAME} to resume from")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        old = self.path.read_bytes() if resume != "never" and self.path.is_file() else b""
        whole = old[: old.rfind(b"\n") + 1]
        if not whole:
            self.path.write_text(json.dumps(_HEAD) + "\n", encoding="utf-8")
            return []
        head, *past = _parse(self.path, whole)
        if head != _HEAD:
            raise DamagedRunError(f"{self.path} is not a journal of version {_HEAD['version']}")
        os.truncate(self.path, len(whole))
        return past

    def _recall(self, known: dict[str, Any], x: Vector) -> tuple[float, Vector]:
        if known["at"] != _digest(x):
            raise DamagedRunError(
                f"{self.path}: evaluation {self.count} was made at another point: {ANEW}"
            )
        return _number(known["value"]), np.array([_number(g) for g in known["gradient"]])

    def _append(self, entry: dict[str, Any]) -> None:
        if self.path is not None:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
                file.flush()
                os.fsync(file.fileno())


def _parse(path: Path, text: bytes) -> list[Any]:
    try:
        return [json.loads(line) for line in text.splitlines()]
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DamagedRunError(f"{path}: not a journal of evaluations: {error}; {ANEW}") from None


def _entry(x: Vector, value: float, gradient: Vector) -> dict[str, Any]:
    """One line of the journal; numbers that are not finite are null."""
    numbers = [g if math.isfinite(g) else None for g in gradient.tolist()]
    return {
        "at": _digest(x),
        "value": value if math.isfinite(value) else None,
        "gradient": numbers,
    }


def _number(entry: float | None) -> float:
    return math.nan if entry is None else entry


def _digest(x: Vector) -> str:
    return hashlib.sha256(x.tobytes()).hexdigest()
