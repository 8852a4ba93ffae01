"""One cell of a leaderboard: a model trained without a fold, and its prediction of that fold."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import zoo
from zoo import archive
from zoo.datasets.records import Sequences
from zoo.ensemble import Ensemble
from zoo.errors import DamagedRunError
from zoo.leaderboard.protocols import PROTOCOLS, Protocol
from zoo.prediction import Prediction, Predictive
from zoo.run import create, fit
from zoo.strategies import Svi

__all__ = ["Cell", "Found", "compute", "compute_all"]

VERSION = 1
DRAWS = 50
_PARTS = ("location", "noise", "epistemic", "draws")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Which model, trained with which settings and seed without which rows.

    ``promp+kernel-ridge`` is an ensemble of two entries; ``settings`` are those of each.
    """

    protocol: str
    model: str
    settings: tuple[tuple[tuple[str, Any], ...], ...]
    seed: int
    fold: int
    rows: tuple[int, ...]

    @property
    def key(self) -> str:
        """A hash of everything that the answer depends on."""
        told = [self.protocol, self.model, self.settings, self.seed, self.rows, zoo.__version__]
        return hashlib.blake2b(json.dumps(told).encode(), digest_size=8).hexdigest()

    def folder(self, root: Path) -> Path:
        """Where its answer is kept."""
        return root / self.protocol / self.model / f"seed-{self.seed}-{self.key}"


@dataclass(frozen=True, kw_only=True)
class Found:
    """The answer of a cell: a prediction of its rows, or the error that stopped it."""

    cell: Cell
    prediction: Prediction | None
    error: str
    seconds: float


def compute(cell: Cell, root: Path, protocol: Protocol | None = None) -> Found:
    """The answer, from its folder if it was found before; a training goes on where it stopped."""
    folder = cell.folder(root)
    kept = _kept(cell, folder)
    if kept is not None:
        return kept
    asked = PROTOCOLS[cell.protocol] if protocol is None else protocol
    data, began = asked.load(), time.monotonic()
    try:
        prediction: Prediction | None = _predicted(cell, asked, data, folder)
        error = ""
    except (RuntimeError, TypeError, ValueError) as stop:
        prediction, error = None, f"{type(stop).__name__}: {stop}"
    found = Found(cell=cell, prediction=prediction, error=error, seconds=time.monotonic() - began)
    _keep(found, folder)
    return found


def compute_all(
    cells: Sequence[Cell], root: Path, jobs: int, note: Callable[[Found], None]
) -> list[Found]:
    """All answers, in processes of one thread each."""
    if jobs == 1:
        found = []
        for cell in cells:
            found.append(compute(cell, root))
            note(found[-1])
        return found
    done: dict[Cell, Found] = {}
    with ProcessPoolExecutor(jobs, get_context("spawn"), _one_thread) as pool:
        futures = [pool.submit(compute, cell, root) for cell in cells]
        try:
            for future in as_completed(futures):
                answer = future.result()
                done[answer.cell] = answer
                note(answer)
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise
    return [done[cell] for cell in cells]


def _one_thread() -> None:
    torch.set_num_threads(1)


def _predicted(cell: Cell, protocol: Protocol, data: Sequences, folder: Path) -> Prediction:
    inside = set(cell.rows)
    train = data[[i for i in range(len(data)) if i not in inside]]
    members = []
    for name, settings in zip(cell.model.split("+"), cell.settings, strict=True):
        assembly = create(name, train, seed=cell.seed, **dict(settings))
        trained = isinstance(assembly.inference, Svi)
        where = folder / f"run-{name}" if trained else None
        members.append(fit(assembly, train, run_dir=where, resume="auto" if trained else "never"))
    run = members[0] if len(members) == 1 else Ensemble(members=tuple(members))
    return protocol.answer(run, data[list(cell.rows)], draws=DRAWS, seed=cell.seed)


def _keep(found: Found, folder: Path) -> None:
    tensors: dict[str, Tensor] = {}
    meta: dict[str, Any] = {"error": found.error, "seconds": found.seconds}
    if found.prediction is not None:
        p = found.prediction
        parts = {name: getattr(p.predictive, name) for name in _PARTS}
        tensors = {name: part for name, part in parts.items() if part is not None}
        meta |= {
            "joint": p.predictive.joint,
            "axes": p.axes,
            "names": p.names,
            "units": p.units,
            "task": p.task,
            "rate": p.rate,
            "offset": p.offset,
        }
    archive.write(folder, "cell", meta, tensors, version=VERSION)


def _kept(cell: Cell, folder: Path) -> Found | None:
    """What an earlier command found; a damaged one is computed again."""
    if not archive.exists(folder, "cell"):
        return None
    try:
        meta, tensors = archive.read(folder, "cell", version=VERSION)
    except DamagedRunError:
        return None
    if meta["error"]:
        return None
    prediction = Prediction(
        predictive=Predictive(**tensors, joint=meta["joint"]),
        axes=tuple(meta["axes"]),
        names=tuple(meta["names"]),
        units=tuple(meta["units"]),
        task=meta["task"],
        rate=meta["rate"],
        offset=meta["offset"],
    )
    return Found(cell=cell, prediction=prediction, error="", seconds=meta["seconds"])
