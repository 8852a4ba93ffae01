"""One cell of a leaderboard: models trained without a fold, and their prediction of that fold."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import zoo
from zoo import archive
from zoo.datasets.records import Sequences
from zoo.ensemble import Ensemble
from zoo.errors import DamagedRunError
from zoo.fitting import fit
from zoo.leaderboard.protocols import PROTOCOLS, Protocol
from zoo.prediction import Prediction, Predictive
from zoo.run import Run, create, load
from zoo.rundir import Resume
from zoo.strategies import Svi

__all__ = ["Cell", "Found", "compute", "compute_all"]

VERSION = 1
# a multiple of the 16 components of exact mixtures: an equal ensemble of both then has 48
DRAWS = 48
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
    def members(self) -> tuple[tuple[str, dict[str, Any]], ...]:
        """Entries and their settings."""
        pairs = zip(self.model.split("+"), self.settings, strict=True)
        return tuple((name, dict(settings)) for name, settings in pairs)

    @property
    def key(self) -> str:
        """A hash of everything that the answer depends on."""
        return _hash(self.protocol, self.model, self.settings, self.seed, self.rows)

    def folder(self, root: Path) -> Path:
        """Where its answer is kept."""
        return root / self.protocol / self.model / f"seed-{self.seed}-{self.key}"

    def training(self, root: Path, data: str, member: int) -> Path:
        """Where a member is trained, for all protocols on these data and all ensembles."""
        name, settings = self.members[member]
        key = _hash(data, name, sorted(settings.items()), self.seed, self.rows)
        return root / "trained" / f"{name}-{key}"


@dataclass(frozen=True, kw_only=True)
class Found:
    """The answer of a cell: a prediction of its rows, or the error that stopped it.

    ``seconds`` are those of its trainings.
    """

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
    try:
        prediction, seconds = _predicted(cell, asked, asked.load(), root)
        found = Found(cell=cell, prediction=prediction, error="", seconds=seconds)
    except (RuntimeError, TypeError, ValueError) as stop:
        error = f"{type(stop).__name__}: {stop}"
        found = Found(cell=cell, prediction=None, error=error, seconds=0.0)
    _keep(found, folder)
    return found


def compute_all(
    cells: Sequence[Cell], root: Path, jobs: int, note: Callable[[Found], None]
) -> list[Found]:
    """All answers, in processes of one thread each; ensembles last, of what was trained by then."""
    done: dict[Cell, Found] = {}
    alone = [cell for cell in cells if len(cell.members) == 1]
    together = [cell for cell in cells if len(cell.members) > 1]
    for stage in (alone, together):
        for answer in _computed(stage, root, jobs):
            done[answer.cell] = answer
            note(answer)
    return [done[cell] for cell in cells]


def _computed(cells: Sequence[Cell], root: Path, jobs: int) -> Iterator[Found]:
    """Answers as they are found."""
    if jobs == 1:
        yield from (compute(cell, root) for cell in cells)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), _begin) as pool:
        futures = [pool.submit(compute, cell, root) for cell in cells]
        try:
            for future in as_completed(futures):
                yield future.result()
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise


def _begin() -> None:
    """One thread a process, and no process that outlives the command."""
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _predicted(
    cell: Cell, protocol: Protocol, data: Sequences, root: Path
) -> tuple[Prediction, float]:
    """The answer, and the seconds that its members took to train."""
    inside = set(cell.rows)
    train = data[[i for i in range(len(data)) if i not in inside]]
    members = [_trained(cell, protocol, train, root, k) for k in range(len(cell.members))]
    run = members[0] if len(members) == 1 else Ensemble(members=tuple(members))
    answer = protocol.answer(run, data[list(cell.rows)], draws=DRAWS, seed=cell.seed)
    return answer, sum(member.seconds for member in members)


def _trained(cell: Cell, protocol: Protocol, train: Sequences, root: Path, member: int) -> Run:
    """A member trained before, or now; an interrupted training goes on."""
    name, settings = cell.members[member]
    folder = cell.training(root, protocol.data or cell.protocol, member)
    if archive.exists(folder, "run"):
        return load(folder)
    assembly = create(name, train, seed=cell.seed, **settings)
    resume: Resume = "auto" if isinstance(assembly.inference, Svi) else "never"
    return fit(assembly, train, run_dir=folder, resume=resume)


def _hash(*told: Any) -> str:
    text = json.dumps([*told, zoo.__version__])
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


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
