"""Whether a folder may be trained in: what it holds, and of which training that is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

from zoo import archive
from zoo.errors import DamagedRunError, OtherTrainingError, RunExistsError
from zoo.inference.resume import checkpoint, journal
from zoo.inference.resume.checkpoint import ANEW
from zoo.inference.resume.lock import locked
from zoo.runs.disk import made_of_run

__all__ = ["Resume", "claimed"]

Resume = Literal["never", "auto", "must"]
_BEGUN = "training.json"


@contextmanager
def claimed(
    folder: Path, made_of: dict[str, str], resume: Resume, overwrite: bool
) -> Iterator[bool]:
    """Hold ``folder`` for the training ``made_of``; yields whether its finished run is there.

    A folder that holds a finished run or a begun training is taken only to ``resume`` the same
    one, or to ``overwrite`` it. Raises RunExistsError, OtherTrainingError with all that differs,
    RunLockedError where another process trains there, and FileNotFoundError where
    ``resume="must"`` finds nothing.
    """
    if not isinstance(resume, str) or resume not in get_args(Resume):
        raise ValueError(f"resume must be 'never', 'auto' or 'must'; got {resume!r}")
    if overwrite and resume != "never":
        raise ValueError(
            f"resume={resume!r} (--resume) goes on with a training, overwrite=True (--overwrite) "
            "replaces it: choose one"
        )
    with locked(folder):
        if overwrite:
            _empty(folder)
        finished = _found(folder, made_of, resume)
        if not finished:
            told = json.dumps({"made_of": made_of}, indent=1)
            archive.replace_file(folder / _BEGUN, told.encode())
        yield finished


def _found(folder: Path, made_of: dict[str, str], resume: Resume) -> bool:
    """Whether the finished run is there; refuses what may not be taken."""
    finished = archive.exists(folder, "run")
    begun = checkpoint.exists(folder) or journal.exists(folder)
    if not (finished or begun):
        if resume == "must":
            raise FileNotFoundError(f"resume='must': {folder} holds no training to go on with")
        return False
    if resume == "never":
        raise RunExistsError(
            f"{folder} holds a {'finished run' if finished else 'begun training'}: "
            f"resume='auto' (--resume) to go on with it; else {ANEW}"
        )
    saved = _saved(folder) if finished else _begun(folder)
    if not saved:
        raise OtherTrainingError(f"{folder} does not tell how it was trained: {ANEW}")
    if gap := checkpoint.difference(saved, made_of):
        raise OtherTrainingError(f"{folder} holds another training: {gap}. Please {ANEW}")
    return finished


def _saved(folder: Path) -> dict[str, str]:
    """What the finished run in the folder is made of."""
    try:
        return made_of_run(folder)
    except DamagedRunError as error:
        raise DamagedRunError(f"{error}; {ANEW}") from None


def _begun(folder: Path) -> dict[str, str]:
    """What the training that was begun in the folder is made of."""
    path = folder / _BEGUN
    if not path.is_file():
        return {}
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))["made_of"]
        return dict(found)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DamagedRunError(f"{path} does not tell of a training: {error!r}; {ANEW}") from None


def _empty(folder: Path) -> None:
    for stem in ("run", "checkpoint"):
        archive.clear(folder, stem)
    journal.clear(folder)
    (folder / "history.jsonl").unlink(missing_ok=True)
