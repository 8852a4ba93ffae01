"""Runs on disk: a folder with ``run.json``, its tensors and the training history."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import torch
from pydantic import TypeAdapter
from torch import Tensor

from zoo import archive
from zoo.catalogue import CATALOGUE
from zoo.contract.parts import Builds
from zoo.contract.registry import Entry, named_well
from zoo.datasets.records.scaling import Scaler
from zoo.errors import DamagedRunError, NotRegisteredError, RunExistsError, UnknownNameError
from zoo.evaluation.calibration.asked import Asked
from zoo.evaluation.calibration.calibration import Calibrated, Calibration
from zoo.runs.assembly import assemble
from zoo.runs.record import Record
from zoo.types import Layout
from zoo.version import __version__

__all__ = ["FORMAT_VERSION", "load_run", "made_of_run", "save_run"]

FORMAT_VERSION = 2
_LIBRARIES = ("torch", "pyro-ppl", "gpytorch", "numpy")


@dataclass(frozen=True, kw_only=True)
class _TrainedOn:
    name: str
    fingerprints: list[str]
    selected_on: list[str] = field(default_factory=list)


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
    made_of: dict[str, str]
    calibrated_on: list[str]
    versions: dict[str, str]
    calibration: list[dict[str, Any]] = field(default_factory=list)
    recalibrations: dict[str, dict[str, Any]] = field(default_factory=dict)

    def bands(self, tensors: dict[str, Tensor]) -> Calibration:
        """All corrections; those of runs saved without their questions are of unknown ones."""
        new = Calibration.from_state(self.calibration, _part(tensors, "calibration."))
        about = {"people": {}, "by": "", "adaptive": False}
        old = [
            Calibrated.from_state(
                {**state, **about, "asked": Asked(task=task).state()},
                _part(tensors, f"recalibration.{task}."),
            )
            for task, state in self.recalibrations.items()
        ]
        return new.joined(old)


def save_run(run: Record, folder: Path, *, overwrite: bool = False) -> Path:
    """Write a run so that :func:`load_run` gives back the same predictions, bit for bit.

    Another run in ``folder`` is replaced only where ``overwrite`` says so; the same training, with
    whatever calibration, is.
    """
    assembly = run.assembly
    tensors: dict[str, Tensor] = archive.state_of(model=assembly.model, guide=assembly.guide)
    if archive.exists(folder, "run") and not overwrite:
        _check_same(folder, run, tensors)
    corrections, extra = run.calibration.state()
    tensors.update({f"calibration.{k}": v for k, v in extra.items()})
    meta = {
        "entry": assembly.entry.name,
        "settings": json.loads(json.dumps(dict(assembly.settings), default=_plain)),
        "layout": asdict(assembly.layout),
        "scaler": run.scaler.to_json(),
        "seed": assembly.seed,
        "seconds": run.seconds,
        "history": [_finite(row) for row in run.history],
        "trained_on": run.trained_on,
        "made_of": run.made_of,
        "calibration": corrections,
        "calibrated_on": run.calibrated_on,
        "versions": {"movezoo": __version__, **{n: installed(n) for n in _LIBRARIES}},
    }
    archive.write(folder, "run", meta, tensors, version=FORMAT_VERSION)
    return folder


def load_run(folder: Path, *, device: str = "cpu") -> Record:
    """Read a run; what is damaged, foreign or of another format version is refused.

    Raises NotRegisteredError where its entry is not registered.
    """
    meta, tensors = archive.read(folder, "run", version=FORMAT_VERSION)
    try:
        return _rebuild(TypeAdapter(_Index).validate_python(meta), tensors, device)
    except (DamagedRunError, NotRegisteredError):
        raise
    except (LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        raise DamagedRunError(f"{folder}/run.json does not describe a run: {error}") from error


def made_of_run(folder: Path) -> dict[str, str]:
    """The fingerprint of a saved run; empty where it was trained without a folder."""
    found: dict[str, str] = archive.read(folder, "run", version=FORMAT_VERSION)[0]["made_of"]
    return found


def _check_same(folder: Path, run: Record, tensors: dict[str, Tensor]) -> None:
    """Refuse to replace a run whose training was another."""
    try:
        meta, kept = archive.read(folder, "run", version=FORMAT_VERSION)
    except DamagedRunError as error:
        raise RunExistsError(f"{error}; save(..., overwrite=True) replaces it") from None
    same = meta["entry"] == run.assembly.entry.name and set(tensors) == {
        k for k in kept if not k.startswith(("calibration.", "recalibration."))
    }
    if not (same and all(_equal(v, kept[k]) for k, v in tensors.items())):
        raise RunExistsError(
            f"{folder} holds another run, of {meta['entry']} on {meta['trained_on']['name']!r}: "
            "take another folder, or save(..., overwrite=True) to replace it"
        )


def _equal(one: Tensor, other: Tensor) -> bool:
    return one.dtype == other.dtype and torch.equal(one.detach().cpu(), other)


def _rebuild(index: _Index, tensors: dict[str, Tensor], device: str) -> Record:
    entry, layout = _entry(index), index.layout
    assembly = assemble(entry, layout, index.settings, seed=index.seed, device=device)
    both = {"model": assembly.model, "guide": assembly.guide}
    modules = {name: module for name, module in both.items() if module is not None}
    parts = [f"calibration.{i}" for i in range(len(index.calibration))]
    parts += [f"recalibration.{task}" for task in index.recalibrations]
    _check_names(tensors, [*modules, *parts])
    for name, module in modules.items():
        if isinstance(module, Builds):
            module.build()
        archive.restore(module, name, tensors)
        module.eval()
    return Record(
        assembly=assembly,
        scaler=_scaler(index),
        history=index.history,
        seconds=index.seconds,
        trained_on=asdict(index.trained_on),
        made_of=index.made_of,
        calibration=index.bands(tensors),
        calibrated_on=index.calibrated_on,
    )


def _entry(index: _Index) -> Entry:
    """The entry of a run, which somebody must have registered."""
    if not named_well(index.entry):
        raise ValueError(f"no entry can be named {index.entry!r}")
    try:
        return CATALOGUE[index.entry]
    except UnknownNameError as error:
        made = index.made_of.get("model")
        raise NotRegisteredError(
            f"this is a run of {index.entry!r}{f' ({made})' if made else ''}, which is not "
            "registered here: call zoo.register(entry) first, or install the package that offers "
            f"it; {error}"
        ) from None


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
