"""Runs on disk: a folder with ``run.json``, its tensors and the training history."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
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


@dataclass(frozen=True, kw_only=True)
class _TrainedOn:
    name: str
    fingerprints: list[str]


@dataclass(frozen=True, kw_only=True)
class _Index:
    """What ``run.json`` must hold, and of which types."""

    entry: str
    settings: dict[str, Any]
    layout: Layout
    scaler: dict[str, Any]
    seed: int
    seconds: float
    history: list[dict[str, Any]]
    trained_on: _TrainedOn
    recalibrations: dict[str, dict[str, Any]]
    versions: dict[str, str]


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
        "settings": json.loads(json.dumps(dict(assembly.settings), default=_plain)),
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
        return _rebuild(TypeAdapter(_Index).validate_python(meta), tensors, device)
    except DamagedRunError:
        raise
    except (LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        raise DamagedRunError(f"{folder}/run.json does not describe a run: {error}") from error


def _rebuild(index: _Index, tensors: dict[str, Tensor], device: str) -> Run:
    entry, layout = CATALOGUE[index.entry], index.layout
    assembly = assemble(entry, layout, index.settings, seed=index.seed, device=device)
    parts = {"model": assembly.model, "guide": assembly.guide}
    modules = {name: module for name, module in parts.items() if module is not None}
    _check_names(tensors, [*modules, *(f"recalibration.{task}" for task in index.recalibrations)])
    for name, module in modules.items():
        archive.restore(module, name, tensors)
        module.eval()
    return Run(
        assembly=assembly,
        scaler=_scaler(index),
        history=index.history,
        seconds=index.seconds,
        trained_on=asdict(index.trained_on),
        recalibrations={
            task: recalibration_from_state(state, _part(tensors, f"recalibration.{task}."))
            for task, state in index.recalibrations.items()
        },
    )


def _scaler(index: _Index) -> Scaler:
    scaler = Scaler.from_json(index.scaler)
    for what, scale, names in (
        ("channels", scaler.channel_scale, index.layout.channels),
        ("inputs", scaler.input_scale, index.layout.inputs),
    ):
        if len(scale) != len(names):
            raise DamagedRunError(f"the scaling has {len(scale)} {what}; the run has {len(names)}")
    return scaler


def _check_names(tensors: dict[str, Tensor], owners: list[str]) -> None:
    foreign = [k for k in tensors if not k.startswith(tuple(f"{o}." for o in owners))]
    if foreign:
        raise DamagedRunError(f"tensor {foreign[0]!r} belongs to no part of this run")


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinities: they are stored as null."""
    bad = {k for k, v in row.items() if isinstance(v, float) and not math.isfinite(v)}
    return {k: None if k in bad else v for k, v in row.items()}


def _plain(number: Any) -> Any:
    """A number or array of numpy as JSON has it."""
    return number.tolist()
