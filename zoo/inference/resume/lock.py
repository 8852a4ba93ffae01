"""One writer at a time in a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from zoo.errors import RunLockedError

__all__ = ["free", "locked"]

_NAME = "lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold ``folder`` alone; a second writer gets a RunLockedError at once.

    The system's lock (``fcntl.flock``) on a file that is kept open: it ends with the process,
    however that ends, so that none is left behind by a kill. The file itself stays. A system
    without fcntl raises RunLockedError: one cannot be told there that nobody else writes.
    """
    try:
        import fcntl
    except ImportError:
        raise RunLockedError(
            f"{folder} cannot be locked: this system has no fcntl; train without run_dir"
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _NAME).open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RunLockedError(_taken(folder)) from None
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


@contextmanager
def free(folder: Path) -> Iterator[None]:
    """Hold ``folder`` alone where something was ever trained in it; elsewhere do nothing."""
    with locked(folder) if (folder / _NAME).exists() else nullcontext():
        yield


def _taken(folder: Path) -> str:
    holder = (folder / _NAME).read_text(encoding="utf-8").strip() or "unknown"
    return f"process {holder} is writing in {folder}: wait until it ends, or take another run_dir"
