"""``zoo.fit``: a training, or the finished one that a folder holds."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

from zoo.arguments import path_of
from zoo.datasets.records import Pairs, Sequences, check_record
from zoo.evaluation.calibration.calibration import Calibration
from zoo.inference.harness import Session
from zoo.runs.assembly import Assembly
from zoo.runs.disk import save_run
from zoo.runs.fingerprint import fingerprint
from zoo.runs.run import Run, load
from zoo.runs.rundir import Resume, claimed
from zoo.runs.training import learn
from zoo.runs.units import fingerprints

__all__ = ["fit"]


def fit(
    assembly: Assembly,
    train: Pairs | Sequences,
    *,
    val: Pairs | Sequences | None = None,
    run_dir: str | Path | None = None,
    resume: Resume = "never",
    overwrite: bool = False,
    progress: bool = False,
    tensorboard: bool = False,
) -> Run:
    """Train what :func:`zoo.create` bound together; the assembly itself stays untouched.

    With ``run_dir`` the training writes checkpoints and, at its end, the run. What the folder
    holds already is never replaced unasked: ``resume="auto"`` goes on with a begun training and
    gives the same bits as an uninterrupted one, or returns the finished run (without the
    calibration it may have been saved with: :func:`zoo.load` has that); ``"must"`` does so and
    starts none anew; ``overwrite=True`` replaces it. Both compare all that determines the result:
    entry, settings, seed, data, libraries and the code of model, guide and training.

    Raises OtherTrainingError, which names what differs, RunExistsError where the folder is taken
    and neither was asked for, RunLockedError where another process trains in it, and
    FileNotFoundError where ``resume="must"`` finds nothing.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> run = zoo.fit(zoo.create("pca", data, latent_dim=2), data)
    >>> run.reconstruct(data).shape
    (4, 20, 3)
    """
    if not isinstance(assembly, Assembly):
        raise TypeError(f"fit trains what zoo.create gives; got {type(assembly).__name__}")
    for part in (train,) if val is None else (train, val):
        check_record(part, "fit")
        assembly.layout.check(part.layout)
    session = Session(
        seed=assembly.seed, device=assembly.device, progress=progress, tensorboard=tensorboard
    )
    if run_dir is None:
        return _fitted(assembly, train, val, session, {})
    folder = path_of(run_dir, "run_dir must be a folder:")
    made_of = fingerprint(assembly, train, val)
    with claimed(folder, made_of, resume, overwrite) as finished:
        if finished:
            return _kept(assembly, folder, progress)
        run = _fitted(assembly, train, val, replace(session, folder=folder), made_of)
        save_run(run, folder)
    return run


def _kept(assembly: Assembly, folder: Path, told: bool) -> Run:
    """The finished run of a folder as the training left it."""
    run = load(folder, device=assembly.device)
    if told:
        done = f"{run.name}: trained before in {run.seconds:.0f} s, taken from {folder}"
        print(done, file=sys.stderr)
    return replace(run, calibration=Calibration(), calibrated_on=[])


def _fitted(
    assembly: Assembly,
    train: Pairs | Sequences,
    val: Pairs | Sequences | None,
    session: Session,
    made_of: dict[str, str],
) -> Run:
    began = time.monotonic()
    learned = learn(assembly, train, val, session)
    epochs = sum(row.get("seconds", 0.0) for row in learned.history)
    return Run(
        assembly=learned.assembly,
        scaler=learned.scaler,
        history=learned.history,
        seconds=max(epochs, time.monotonic() - began),
        trained_on={
            "name": train.name,
            "fingerprints": fingerprints(train),
            "selected_on": [] if val is None else fingerprints(val),
        },
        made_of=made_of,
    )
