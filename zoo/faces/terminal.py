"""What is written to a terminal, or to a pipe: tables for people, plain lines for programs."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from typing import Any

from rich.console import Console

__all__ = ["said_plainly", "show"]

WIDE = 4000
RULES = frozenset(" ─━╶╴═")


def show(*things: Any) -> None:
    """Print for whoever reads: in colours and as wide as a terminal, or a record a line."""
    if sys.stdout.isatty():
        Console().print(*things)
        return
    for thing in things:
        print(plain(thing))


def plain(thing: Any) -> str:
    """A record a line, however wide, without rules, colours and padding."""
    if hasattr(thing, "markdown"):
        return str(thing.markdown()).strip()
    text = StringIO()
    Console(file=text, width=WIDE, color_system=None, force_terminal=False).print(thing)
    lines = (line.rstrip() for line in text.getvalue().splitlines())
    return "\n".join(line for line in lines if line and not set(line) <= RULES)


@contextmanager
def said_plainly() -> Iterator[None]:
    """Warnings as a line on stderr, without file, line and code."""
    with warnings.catch_warnings():
        warnings.showwarning = _warn  # type: ignore[assignment]
        yield


def _warn(message: Warning | str, *_: object) -> None:
    print(f"zoo: warning: {message}", file=sys.stderr)
