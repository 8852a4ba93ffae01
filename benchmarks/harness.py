"""Interleaved timing of named callables, and results stored with what they were measured on."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import torch

from zoo.studies.result import commit

__all__ = ["Timings", "interleave", "ratio", "report", "store", "versions"]

RESULTS = Path(__file__).resolve().parent.parent / "results"
LIBRARIES = ("movezoo", "torch", "pyro-ppl", "numpy")
FILL = 5e-3
_STARTED = time.monotonic()

Timings = dict[str, dict[str, float]]


def interleave(
    callables: Mapping[str, Callable[[], object]], *, rounds: int = 20, warmup: int = 2
) -> Timings:
    """Seconds a call of every callable, timed in turn so that a busy machine slows all alike.

    ``processor_median`` counts only the time that this thread computed: on a busy machine the
    steadier measure of single-threaded work.

    Every round runs each callable once, in an order that rotates from round to round. Callables
    that take less than five milliseconds are repeated within a round until they fill them.

    >>> timings = interleave({"sum": lambda: sum(range(100))}, rounds=3)
    >>> sorted(timings["sum"])
    ['best', 'lower_quartile', 'median', 'processor_median', 'repeats', 'rounds', 'upper_quartile']
    """
    names = list(callables)
    for _ in range(warmup):
        for name in names:
            callables[name]()
    repeats = {name: _repeats(callables[name]) for name in names}
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for turn in range(rounds):
        shift = turn % len(names)
        for name in names[shift:] + names[:shift]:
            seconds[name].append(_seconds(callables[name], repeats[name]))
    return {name: _summary(seconds[name], repeats[name]) for name in names}


def ratio(timings: Timings, slow: str, fast: str, *, measure: str = "median") -> float:
    """How many times longer the median call of ``slow`` takes than that of ``fast``.

    >>> ratio({"loop": {"median": 2.0}, "product": {"median": 0.5}}, "loop", "product")
    4.0
    """
    return timings[slow][measure] / timings[fast][measure]


def report(title: str, timings: Timings) -> None:
    """Print a table of medians in milliseconds, the fastest callable as unit."""
    unit = min(t["median"] for t in timings.values())
    print(f"{title}\n{'':28}{'median ms':>12}{'quartiles ms':>22}{'ratio':>10}")
    for name, t in timings.items():
        quartiles = f"{1e3 * t['lower_quartile']:.3f}–{1e3 * t['upper_quartile']:.3f}"
        print(f"{name:28}{1e3 * t['median']:12.3f}{quartiles:>22}{t['median'] / unit:10.2f}")


def store(
    name: str,
    payload: Mapping[str, Any],
    *,
    label: Literal["thesis", "public", "simulated"],
    libraries: Sequence[str] = (),
    seed: int | None = None,
    started: float | None = None,
) -> Path:
    """Write ``results/NAME.json``: the payload with versions, processor, threads and duration.

    ``libraries`` are distributions to give the version of, beside the core ones; ``started`` is a
    ``time.monotonic()`` of the start of the measurement (default: the import of this module).
    """
    begin = _STARTED if started is None else started
    document = {
        "name": name,
        "label": label,
        "seed": seed,
        "commit": commit(),
        "versions": versions(*libraries),
        "machine": {
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "load": round(os.getloadavg()[0], 2),
            "processor": platform.machine(),
        },
        "duration_seconds": round(time.monotonic() - begin, 2),
        **payload,
    }
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def versions(*libraries: str) -> dict[str, str]:
    """Versions of Python and of installed distributions.

    >>> sorted(versions())
    ['movezoo', 'numpy', 'pyro-ppl', 'python', 'torch']
    """
    found = {"python": platform.python_version()}
    for library in (*LIBRARIES, *libraries):
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            found[library] = "absent"
    return found


def _repeats(call: Callable[[], object]) -> int:
    return max(1, round(FILL / max(_seconds(call, 1)[0], 1e-7)))


def _seconds(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    begin, busy = time.perf_counter(), time.thread_time()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - begin) / repeats, (time.thread_time() - busy) / repeats


def _summary(seconds: list[tuple[float, float]], repeats: int) -> dict[str, float]:
    elapsed = [wall for wall, _ in seconds]
    lower, middle, upper = statistics.quantiles(elapsed, n=4, method="inclusive")
    return {
        "median": middle,
        "lower_quartile": lower,
        "upper_quartile": upper,
        "best": min(elapsed),
        "processor_median": statistics.median(busy for _, busy in seconds),
        "rounds": len(seconds),
        "repeats": repeats,
    }
