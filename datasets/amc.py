"""Movements from the AMC files of Acclaim motion capture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.skeleton import Skeleton
from zoo.datasets.store import FileFormatError
from zoo.datasets.words import numbers, worded_lines

__all__ = ["read_amc"]


def read_amc(path: str | Path, skeleton: Skeleton) -> Float[Tensor, "frame channel"]:
    """The movement of an AMC file in the order of ``skeleton.channels``: rad and m, float64.

    Frames must follow each other without a gap and give every bone that can move exactly once.
    """
    degrees = True
    frames: list[_Frame] = []
    width = {b.name: len(b.dof) for b in skeleton.bones if b.dof}
    for line, words in worded_lines(path):
        if words[0].startswith(":"):
            if frames:
                raise FileFormatError(path, line, f"{words[0]} after the first frame")
            degrees = _keyword(path, line, words, degrees)
        elif len(words) == 1 and words[0].isdigit():
            _close(path, line, frames, width, "before the next one starts")
            frames.append(_Frame(number=int(words[0]), line=line, values={}))
            _follows(path, frames)
        elif not frames:
            raise FileFormatError(path, line, f"{words[0]!r} before the first frame number")
        else:
            _bone_values(path, line, words, frames[-1], width)
    if not frames:
        raise FileFormatError(path, None, "no frames")
    _close(path, None, frames, width, "where the file ends: truncated?")
    table = torch.from_numpy(_table(path, frames, width))
    moving = torch.tensor([unit == "m" for unit in skeleton.units])
    return table * torch.where(moving, skeleton.metre, math.pi / 180 if degrees else 1.0)


@dataclass(frozen=True, kw_only=True)
class _Frame:
    number: int
    line: int
    values: dict[str, tuple[int, list[str]]]


def _keyword(path: str | Path, line: int, words: list[str], degrees: bool) -> bool:
    known = {":DEGREES": True, ":RADIANS": False, ":FULLY-SPECIFIED": degrees}
    if words[0].upper() not in known:
        raise FileFormatError(
            path, line, f"unknown keyword {words[0]!r}; known are {', '.join(known)}"
        )
    return known[words[0].upper()]


def _follows(path: str | Path, frames: Sequence[_Frame]) -> None:
    if len(frames) > 1 and frames[-1].number != frames[-2].number + 1:
        want, got = frames[-2].number + 1, frames[-1].number
        raise FileFormatError(path, frames[-1].line, f"frame {want} is missing; got frame {got}")


def _bone_values(
    path: str | Path, line: int, words: list[str], frame: _Frame, width: dict[str, int]
) -> None:
    name, given = words[0], words[1:]
    if name not in width:
        raise FileFormatError(path, line, f"unknown bone {name!r}; the skeleton has no such joint")
    if name in frame.values:
        raise FileFormatError(path, line, f"bone {name!r} comes twice in frame {frame.number}")
    if len(given) != width[name]:
        raise FileFormatError(
            path, line, f"bone {name!r} needs {width[name]} values; got {len(given)}"
        )
    frame.values[name] = (line, given)


def _close(
    path: str | Path,
    line: int | None,
    frames: Sequence[_Frame],
    width: dict[str, int],
    where: str,
) -> None:
    if frames and len(frames[-1].values) < len(width):
        lacking = [name for name in width if name not in frames[-1].values]
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        raise FileFormatError(
            path,
            line or frames[-1].line,
            f"frame {frames[-1].number} lacks bone {lacking[0]!r}{more} {where}",
        )


def _table(
    path: str | Path, frames: Sequence[_Frame], width: dict[str, int]
) -> NDArray[np.float64]:
    """All words as numbers at once; where that fails, line by line to find the culprit."""
    words = [word for frame in frames for name in width for word in frame.values[name][1]]
    try:
        table = np.array(words, dtype=np.float64).reshape(len(frames), -1)
    except ValueError:
        table = np.full((1, 1), np.nan)
    if not np.isfinite(table).all():
        for line, given in (given for frame in frames for given in frame.values.values()):
            numbers(path, line, given)
    return table
