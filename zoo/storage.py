"""Runs on disk: a folder with ``run.json``, its tensors and the training history."""

from __future__ import annotations

import math
from dataclasses import asdict
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from torch import Tensor

import zoo
from zoo import archive
from zoo.assembly import assemble
from zoo.catalogue import CATALOGUE
from zoo.datasets.scaling import Scaler
from zoo.errors import DamagedRunError
from zoo.evaluation.calibration import recalibration_from_state
from zoo.run import Run
from zoo.types import Layout

__all__ = ["FORMAT_VERSION", "load_run", "save_run"]

FORMAT_VERSION = 1
_LIBRARIES = ("torch", "pyro-ppl", "gpytorch", "numpy")


def save_run(run: Run, folder: Path) -> Path:
    """Write a run so that :func:`load_run` gives back the same predictions, bit for bit."""
    assembly = run.assembly
    tensors: dict[str, Tensor] = archive.state_of(model=assembly.model, guide=assembly.guide)
    corrections: dict[str, Any] = {}
    for task, recalibration in run.recalibrations.items():
        corrections[task], extra = recalibration.state()
        tensors.update({f"recalibration.{task}.{k}": v for k, v in extra.items()})
    meta = {
        "entry": assembly.entry.name,
        "settings": dict(assembly.settings),
        "layout": asdict(assembly.layout),
        "scaler": run.scaler.to_json(),
        "seed": assembly.seed,
        "seconds": run.seconds,
        "history": [_finite(row) for row in run.history],
        "trained_on": run.trained_on,
        "recalibrations": corrections,
        "versions": {"movezoo": zoo.__version__, **{n: installed(n) for n in _LIBRARIES}},
    }
    archive.write(folder, "run", meta, tensors, version=FORMAT_VERSION)
    return folder


def load_run(folder: Path, *, device: str = "cpu") -> Run:
    """Read a run; what is damaged, foreign or of another format version is refused."""
    meta, tensors = archive.read(folder, "run", version=FORMAT_VERSION)
    try:
        return _rebuild(meta, tensors, device)
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, DamagedRunError):
            raise
        raise DamagedRunError(f"{folder}/run.json does not describe a run: {error}") from error


def _rebuild(meta: dict[str, Any], tensors: dict[str, Tensor], device: str) -> Run:
    layout = TypeAdapter(Layout).validate_python(meta["layout"])
    entry = CATALOGUE[meta["entry"]]
    assembly = assemble(entry, layout, meta["settings"], seed=meta["seed"], device=device)
    archive.restore(assembly.model, "model", tensors)
    assembly.model.eval()
    if assembly.guide is not None:
        archive.restore(assembly.guide, "guide", tensors)
        assembly.guide.eval()
    return Run(
        assembly=assembly,
        scaler=Scaler.from_json(meta["scaler"]),
        history=meta["history"],
        seconds=meta["seconds"],
        trained_on=meta["trained_on"],
        recalibrations={
            task: recalibration_from_state(state, _part(tensors, f"recalibration.{task}."))
            for task, state in meta["recalibrations"].items()
        },
    )


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinities: they are stored as null."""
    bad = {k for k, v in row.items() if isinstance(v, float) and not math.isfinite(v)}
    return {k: None if k in bad else v for k, v in row.items()}
