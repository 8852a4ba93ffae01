"""Numbered lines, words and numbers of text files, with errors that name file and line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from zoo.datasets.store import FileFormatError

__all__ = ["Lines", "exactly", "numbers", "worded_lines"]

Lines = list[tuple[int, list[str]]]


def worded_lines(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Number and words of every line that has any, without ``#`` comments.

    CR, LF and CRLF all end a line; CR CR LF, as in some of CMU's files, ends one.
    """
    text = Path(path).read_bytes().decode("utf-8", errors="replace")
    text = text.replace("\r\r\n", "\n").replace("\r\n", "\n").replace("\r", "\n")
    for number, line in enumerate(text.split("\n"), 1):
        if words := line.partition("#")[0].split():
            yield number, words


def numbers(path: str | Path, line: int, words: Sequence[str]) -> list[float]:
    """The words as finite numbers."""
    try:
        found = [float(w) for w in words]
    except ValueError:
        bad = next(w for w in words if not _is_number(w))
        raise FileFormatError(path, line, f"{bad!r} is not a number") from None
    if not all(map(math.isfinite, found)):
        raise FileFormatError(path, line, f"{' '.join(words)!r} is not finite")
    return found


def exactly(
    path: str | Path, line: int, words: Sequence[str], count: int, what: str
) -> list[float]:
    """The words as ``count`` numbers."""
    if len(words) != count:
        raise FileFormatError(path, line, f"{what} needs {count} numbers; got {' '.join(words)!r}")
    return numbers(path, line, words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
