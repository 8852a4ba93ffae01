"""Checkpoints that survive a kill at any moment: safetensors and JSON, put in place atomically."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from zoo.errors import DamagedRunError

__all__ = ["capture", "clear", "difference", "exists", "read", "restore", "write", "write_file"]

FORMAT = "movezoo-checkpoint"
VERSION = 1
_INDEX = "checkpoint.json"
_TENSORS = "checkpoint-*.safetensors"

Tensors = dict[str, Tensor]


def write(folder: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Store ``tensors`` and the JSON ``state``; the last checkpoint stays until this one is whole.

    The tensors go to a file named by its content, then the index is replaced: a reader finds
    either the old checkpoint or the new one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    content = save({k: v.detach().cpu().clone() for k, v in tensors.items()})
    digest = hashlib.sha256(content).hexdigest()
    name = _TENSORS.replace("*", digest[:16])
    write_file(folder / name, content)
    body = {"format": FORMAT, "version": VERSION, "tensors": name, "sha256": digest, "state": state}
    write_file(folder / _INDEX, _sealed(body).encode())
    for old in folder.glob(_TENSORS):
        if old.name != name:
            old.unlink(missing_ok=True)


def read(folder: Path) -> tuple[Tensors, dict[str, Any]]:
    """Tensors and state of the checkpoint; what is not whole and ours is a DamagedRunError."""
    index = folder / _INDEX
    body = _opened(index)
    path = folder / str(body["tensors"])
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedRunError(f"{path}: the checkpoint's tensors cannot be read: {error}") from None
    if hashlib.sha256(content).hexdigest() != body["sha256"]:
        raise DamagedRunError(f"{path}: the tensors are damaged (their SHA-256 differs)")
    return load(content), body["state"]


def exists(folder: Path) -> bool:
    """Whether ``folder`` holds a checkpoint."""
    return (folder / _INDEX).exists()


def clear(folder: Path) -> None:
    """Remove the checkpoint of ``folder``, its index first."""
    (folder / _INDEX).unlink(missing_ok=True)
    for path in folder.glob(_TENSORS):
        path.unlink(missing_ok=True)


def write_file(path: Path, content: bytes) -> None:
    """Replace a file in one step that is on the disk when this returns."""
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)
    _sync_folder(path.parent)


def difference(saved: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """The first setting in which a saved training differs from the one at hand.

    >>> difference({"seed": 0, "epochs": 5}, {"seed": 1, "epochs": 5})
    'seed was 0 and is 1 now'
    """
    for key in sorted({*saved, *now}):
        was, new = saved.get(key), now.get(key)
        if was != new:
            return f"{key} was {was} and is {new} now"
    return None


def capture(prefix: str, part: nn.Module | torch.optim.Optimizer) -> Tensors:
    """Copies of all tensors of a module or an optimiser, by name under ``prefix``."""
    return {f"{prefix}/{name}": value.detach().clone() for name, value in _live(part).items()}


def restore(prefix: str, part: nn.Module | torch.optim.Optimizer, tensors: Tensors) -> None:
    """Put the tensors under ``prefix`` back in place, bit for bit."""
    kept = {k[len(prefix) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{prefix}/")}
    if isinstance(part, torch.optim.Optimizer):
        _restore_optimizer(part, kept)
    else:
        _restore_module(part, kept)


def _live(part: nn.Module | torch.optim.Optimizer) -> Tensors:
    if isinstance(part, nn.Module):
        return dict(part.state_dict())
    moments = part.state_dict()["state"]
    return {f"{i}/{key}": value for i, slots in moments.items() for key, value in slots.items()}


def _restore_module(module: nn.Module, kept: Tensors) -> None:
    live = _live(module)
    shapes = {k: list(v.shape) for k, v in live.items()}
    if gap := difference({k: list(v.shape) for k, v in kept.items()}, shapes):
        raise DamagedRunError(f"checkpoint of another {type(module).__name__}: the shape of {gap}")
    for name, value in live.items():
        value.copy_(kept[name])


def _restore_optimizer(optimizer: torch.optim.Optimizer, kept: Tensors) -> None:
    slots: dict[int, dict[str, Tensor]] = {}
    for name, value in kept.items():
        index, key = name.split("/")
        slots.setdefault(int(index), {})[key] = value.clone()
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": slots, "param_groups": groups})


def _sealed(body: dict[str, Any]) -> str:
    return json.dumps({**body, "seal": _seal(body)}, allow_nan=False)


def _seal(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _opened(index: Path) -> dict[str, Any]:
    try:
        body: dict[str, Any] = json.loads(index.read_bytes())
        kind, version, seal = body["format"], body["version"], body.pop("seal", None)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DamagedRunError(f"{index}: not a readable checkpoint: {error!r}") from None
    if kind != FORMAT:
        raise DamagedRunError(f"{index}: format is {kind!r}; {FORMAT!r} is needed")
    if version != VERSION:
        raise DamagedRunError(f"{index}: format version {version}; this movezoo reads {VERSION}")
    if seal != _seal(body):
        raise DamagedRunError(f"{index}: the index is damaged (its seal differs)")
    return body


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
