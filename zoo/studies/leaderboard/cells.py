"""One cell of a leaderboard: models trained on a fold's training part, and their predictions."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, fields
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from zoo import archive
from zoo.catalogue import CATALOGUE, register
from zoo.contract.registry import Entry
from zoo.datasets.records import Sequences
from zoo.datasets.records.digest import contents
from zoo.errors import DamagedRunError
from zoo.evaluation.tasks import answered
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive
from zoo.runs.assembly import Assembly
from zoo.runs.ensemble import Ensemble
from zoo.runs.fingerprint import code, fingerprint, key
from zoo.runs.fitting import fit
from zoo.runs.run import create
from zoo.studies.leaderboard.protocol import Fold, Protocol

__all__ = ["FAILURES", "Cell", "Found", "compute", "compute_all"]

VERSION = 3
# a multiple of the 16 components of exact mixtures: an equal ensemble of both then has 48
DRAWS = 48
FAILURES = (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)
_PARTS = ("location", "noise", "epistemic", "draws")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Which model, trained with which settings and seed on which rows, answers for which others.

    ``promp+kernel-ridge`` is an ensemble of two entries; ``settings`` are those of each.
    """

    protocol: str
    model: str
    settings: tuple[tuple[tuple[str, Any], ...], ...]
    seed: int
    number: int
    fold: Fold

    @property
    def members(self) -> tuple[tuple[str, dict[str, Any]], ...]:
        """Entries and their settings."""
        pairs = zip(self.model.split("+"), self.settings, strict=True)
        return tuple((name, dict(settings)) for name, settings in pairs)

    @property
    def rows(self) -> tuple[int, ...]:
        """Those that are predicted: the calibration part's, then the judged ones."""
        return self.fold.calibration + self.fold.judged

    def folder(self, root: Path, made_of: object) -> Path:
        """Where its answer is kept, by all that it depends on."""
        return root / self.protocol / self.model / f"seed-{self.seed}-{key(made_of)}"


@dataclass(frozen=True, kw_only=True)
class Found:
    """The answer of a cell: a prediction of its rows, or the error that stopped it.

    ``seconds`` are those of its trainings, whenever they were; ``reused`` says whether the answer
    or the trainings were found before.
    """

    cell: Cell
    prediction: Prediction | None
    error: str
    seconds: float
    reused: Literal["", "answer", "training"] = ""


def compute(cell: Cell, root: Path, asked: Protocol) -> Found:
    """The answer, from its folder if it was found before; a training goes on where it stopped."""
    try:
        data = asked.prepared(_loaded(asked.load, os.environ.get("MOVEZOO_DATA")))
        train = data[list(cell.fold.train)]
        made = [create(name, train, seed=cell.seed, **options) for name, options in cell.members]
        folder = cell.folder(
            root, _made_of(cell, asked, data, [fingerprint(m, train) for m in made])
        )
        return _kept(cell, folder) or _answered(cell, asked, data, train, made, root, folder)
    except FAILURES as stop:
        error = f"{type(stop).__name__}: {stop}"
        return Found(cell=cell, prediction=None, error=error, seconds=0.0)


@lru_cache(maxsize=1)
def _loaded(load: Callable[[], Sequences], folder: str | None) -> Sequences:
    """The data, once in a process; ``folder`` is where the loader looks."""
    return load()


def _made_of(
    cell: Cell, asked: Protocol, data: Sequences, members: list[dict[str, str]]
) -> list[object]:
    """Trainings, question, data and code: all that an answer depends on."""
    values = {f.name: getattr(asked, f.name) for f in fields(asked)}
    question = {name: repr(value) for name, value in values.items() if not callable(value)}
    return [members, question, cell.rows, contents(data, "judged"), code([__name__])]


def compute_all(
    cells: Sequence[Cell],
    root: Path,
    asked: Protocol,
    jobs: int,
    note: Callable[[Found], None],
) -> list[Found]:
    """All answers, in processes of one thread each; ensembles last, of what was trained by then."""
    done: dict[Cell, Found] = {}
    alone = [cell for cell in cells if len(cell.members) == 1]
    together = [cell for cell in cells if len(cell.members) > 1]
    for stage in (alone, together):
        for answer in _computed(stage, root, asked, jobs):
            done[answer.cell] = answer
            note(answer)
    return [done[cell] for cell in cells]


def _computed(cells: Sequence[Cell], root: Path, asked: Protocol, jobs: int) -> Iterator[Found]:
    """Answers as they are found."""
    if jobs == 1:
        yield from (compute(cell, root, asked) for cell in cells)
        return
    others = _registered(cells)
    with ProcessPoolExecutor(jobs, get_context("spawn"), _begin, (others,)) as pool:
        futures = [pool.submit(compute, cell, root, asked) for cell in cells]
        try:
            for future in as_completed(futures):
                yield future.result()
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise


def _registered(cells: Sequence[Cell]) -> tuple[Entry, ...]:
    """Entries that another process must register before it can train them."""
    names = {name for cell in cells for name, _ in cell.members}
    found = tuple(entry for entry in CATALOGUE.joined if entry.name in names)
    for entry in found:
        if not entry.importable:
            raise ValueError(
                f"other processes cannot import the classes of {entry.name!r}: take jobs=1, or put "
                "them into a module"
            )
    return found


def _begin(others: Sequence[Entry]) -> None:
    """One thread a process, all entries known, and no process that outlives the command."""
    torch.set_num_threads(1)
    for entry in others:
        if entry.name not in CATALOGUE.names():
            register(entry)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _answered(
    cell: Cell,
    asked: Protocol,
    data: Sequences,
    train: Sequences,
    made: list[Assembly],
    root: Path,
    folder: Path,
) -> Found:
    """The answer of members trained before, or now; it is kept in ``folder``."""
    homes = [root / "trained" / f"{m.entry.name}-{key(fingerprint(m, train))}" for m in made]
    before = all(archive.exists(home, "run") for home in homes)
    members = [
        fit(m, train, run_dir=home, resume="auto") for m, home in zip(made, homes, strict=True)
    ]
    run = members[0] if len(members) == 1 else Ensemble(members=tuple(members))
    found = Found(
        cell=cell,
        prediction=answered(
            run, asked.question(data[list(cell.rows)]), draws=DRAWS, seed=cell.seed
        ),
        error="",
        seconds=sum(member.seconds for member in members),
        reused="training" if before else "",
    )
    _keep(found, folder)
    return found


def _keep(found: Found, folder: Path) -> None:
    tensors: dict[str, Tensor] = {}
    meta: dict[str, Any] = {"seconds": found.seconds}
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
    prediction = Prediction(
        predictive=Predictive(**tensors, joint=meta["joint"]),
        axes=tuple(meta["axes"]),
        names=tuple(meta["names"]),
        units=tuple(meta["units"]),
        task=meta["task"],
        rate=meta["rate"],
        offset=meta["offset"],
    )
    seconds = meta["seconds"]
    return Found(cell=cell, prediction=prediction, error="", seconds=seconds, reused="answer")
