"""Trainings of experiments, kept by all that determines them, and the time that they took."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from zoo import archive
from zoo.contract.strategies import Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.runs.assembly import Assembly
from zoo.runs.fingerprint import fingerprint, key
from zoo.runs.fitting import fit
from zoo.runs.run import Run

__all__ = ["timed", "trained"]

_TIMES: ContextVar[list[float] | None] = ContextVar("seconds of the trainings", default=None)


def trained(
    assembly: Assembly, data: Pairs | Sequences, home: str, label: str, *, progress: bool = False
) -> Run:
    """A model trained before, if all that determines it is the same, or trained now.

    Trainings by gradient steps are kept under ``runs/HOME``; one that is taken from there is named
    on stderr. An interrupted one is gone on with.
    """
    run = _run(assembly, data, home, label.replace(", ", "-").replace(" ", "-").lower(), progress)
    times = _TIMES.get()
    if times is not None:
        times.append(run.seconds)
    return run


@contextmanager
def timed() -> Iterator[list[float]]:
    """Collect the seconds of all trainings inside, whenever they were."""
    times: list[float] = []
    token = _TIMES.set(times)
    try:
        yield times
    finally:
        _TIMES.reset(token)


def _run(assembly: Assembly, data: Pairs | Sequences, home: str, label: str, progress: bool) -> Run:
    name = assembly.entry.name
    if not isinstance(assembly.inference, Svi):
        return fit(assembly, data, progress=progress)
    folder = Path("runs") / home / f"{name}-{label}-{key(fingerprint(assembly, data))}"
    reused = archive.exists(folder, "run")
    run = fit(assembly, data, run_dir=folder, resume="auto", progress=progress and not reused)
    if reused:
        told = f"{name} ({label}): reused from {folder}, trained in {run.seconds:.0f} s"
        print(told, file=sys.stderr)
    return run
