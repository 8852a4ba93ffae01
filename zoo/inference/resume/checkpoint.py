"""Checkpoints that survive a kill at any moment: safetensors and JSON, put in place atomically."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from zoo import archive
from zoo.errors import DamagedRunError

__all__ = ["ANEW", "capture", "clear", "difference", "exists", "read", "restore", "write"]

VERSION = 1
ANEW = "take another run_dir, or overwrite=True (--overwrite) to begin anew"
_STEM = "checkpoint"
_MOST = 3

Tensors = dict[str, Tensor]


def write(folder: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Store ``tensors`` and ``state``; the last checkpoint stays until this one is whole."""
    archive.write(folder, _STEM, {"state": state}, tensors, version=VERSION)


def read(folder: Path) -> tuple[Tensors, dict[str, Any]]:
    """Tensors and state of the checkpoint; what is not whole and ours is a DamagedRunError."""
    try:
        body, tensors = archive.read(folder, _STEM, version=VERSION)
    except DamagedRunError as error:
        raise DamagedRunError(f"{error}; {ANEW}") from None
    return tensors, body["state"]


def exists(folder: Path) -> bool:
    """Whether ``folder`` holds a checkpoint."""
    return archive.exists(folder, _STEM)


def clear(folder: Path) -> None:
    """Remove the checkpoint of ``folder``, its index first."""
    archive.clear(folder, _STEM)


def difference(saved: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """In what a saved training differs from the one at hand, in words; None where in nothing.

    The first three differences are told, and how many more there are. Values that begin with #
    are digests.

    >>> difference({"seed": 0, "epochs": 5}, {"seed": 1, "epochs": 5})
    'seed was 0 and is 1 now'
    >>> difference({"code of zoo.models.frames.vae": "#1"}, {"code of zoo.models.frames.vae": "#2"})
    'code of zoo.models.frames.vae changed'
    """
    found = [_told(k, saved, now) for k in {**now, **saved} if saved.get(k) != now.get(k)]
    more = f", and {len(found) - _MOST} more" if len(found) > _MOST else ""
    return "; ".join(found[:_MOST]) + more if found else None


def _told(key: str, saved: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    if key not in saved:
        return f"{key} was not there"
    if key not in now:
        return f"{key} is there no more"
    if str(now[key]).startswith("#"):
        return f"{key} changed"
    return f"{key} was {saved[key]} and is {now[key]} now"


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
