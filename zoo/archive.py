"""Folders of safetensors and JSON with a format version and a hash: written whole or not at all.

The tensors go into a file named by their own hash; the JSON that names it is replaced last, in one
step. A crash at any moment leaves the old folder or the new one, never a mixture.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from zoo.errors import DamagedRunError

__all__ = ["clear", "exists", "read", "replace_file", "restore", "state_of", "write"]


def write(
    folder: Path,
    stem: str,
    meta: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    *,
    version: int,
) -> None:
    """Write ``stem.json`` and its tensors into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    content = save_tensors({k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()})
    digest = hashlib.sha256(content).hexdigest()
    name = f"{stem}-{digest[:16]}.safetensors"
    head = {"format": f"movezoo-{stem}", "version": version, "tensors": name, "sha256": digest}
    body = {**head, **meta}
    replace_file(folder / name, content)
    sealed = json.dumps({**body, "seal": _seal(body)}, indent=1, allow_nan=False)
    replace_file(folder / f"{stem}.json", sealed.encode())
    for old in folder.glob(f"{stem}-*.safetensors*"):
        if old.name != name:
            old.unlink(missing_ok=True)


def read(folder: Path, stem: str, *, version: int) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what :func:`write` wrote; a damaged, foreign or newer folder is refused."""
    meta = _opened(folder / f"{stem}.json", stem, version)
    name = str(meta.get("tensors"))
    if not re.fullmatch(f"{stem}-[0-9a-f]{{16}}\\.safetensors", name):
        raise DamagedRunError(f"{folder / stem}.json names {name!r}; a {stem} keeps no such file")
    file = folder / name
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DamagedRunError(f"{file}: the tensors are missing or unreadable: {error}") from None
    if hashlib.sha256(content).hexdigest() != meta.get("sha256"):
        raise DamagedRunError(f"{file}: the tensors are damaged: their hash is not the one kept")
    try:
        return meta, load_tensors(content)
    except (SafetensorError, LookupError, RuntimeError, ValueError) as error:
        raise DamagedRunError(f"{file}: not a safetensors file: {error!r}") from None


def exists(folder: Path, stem: str) -> bool:
    """Whether ``folder`` holds one."""
    return (folder / f"{stem}.json").exists()


def clear(folder: Path, stem: str) -> None:
    """Remove it from ``folder``, its index first."""
    (folder / f"{stem}.json").unlink(missing_ok=True)
    for path in folder.glob(f"{stem}-*.safetensors*"):
        path.unlink(missing_ok=True)


def replace_file(path: Path, content: bytes) -> None:
    """Put ``content`` at ``path`` in one step that is on the disk when this returns."""
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def state_of(**modules: nn.Module | None) -> dict[str, Tensor]:
    """Parameters and buffers of the modules, each under ``module.name``."""
    return {
        f"{prefix}.{key}": value
        for prefix, module in modules.items()
        if module is not None
        for key, value in module.state_dict().items()
    }


def restore(module: nn.Module, prefix: str, tensors: Mapping[str, Tensor]) -> None:
    """Load ``prefix.*`` into a module; statistics may take whatever shape the data gave them."""
    mine = {
        k.removeprefix(f"{prefix}."): v for k, v in tensors.items() if k.startswith(f"{prefix}.")
    }
    expected = module.state_dict()
    if set(mine) != set(expected):
        odd = sorted(set(mine) ^ set(expected))
        raise DamagedRunError(f"{prefix} and the saved state differ in {', '.join(odd[:5])}")
    parameters = dict(module.named_parameters())
    for key, value in mine.items():
        target = expected[key]
        if value.dtype != target.dtype or not bool(value.isfinite().all()):
            raise DamagedRunError(
                f"{prefix}.{key} must hold finite {target.dtype}; it holds {value.dtype}"
                f"{'' if bool(value.isfinite().all()) else ' that are not finite'}"
            )
        if key in parameters and target.numel() and target.shape != value.shape:
            raise DamagedRunError(
                f"{prefix}.{key} has shape {tuple(value.shape)}; {tuple(target.shape)} is needed"
            )
        _put(module, key, value.to(device=target.device), key in parameters)


def _put(module: nn.Module, key: str, value: Tensor, trainable: bool) -> None:
    path, _, name = key.rpartition(".")
    owner = module.get_submodule(path)
    with torch.no_grad():
        if trainable:
            getattr(owner, name).data = value
        else:
            owner._buffers[name] = value


def _seal(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _opened(index: Path, stem: str, version: int) -> dict[str, Any]:
    if not index.is_file():
        raise DamagedRunError(f"{index.parent} holds no {index.name}: it is not a movezoo {stem}")
    try:
        body: dict[str, Any] = json.loads(index.read_bytes(), parse_constant=_no_json)
        kind, found, seal = body["format"], body["version"], body.pop("seal", None)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DamagedRunError(f"{index}: not a readable {stem}: {error!r}") from None
    if kind != f"movezoo-{stem}":
        raise DamagedRunError(f"{index}: format is {kind!r}; 'movezoo-{stem}' is needed")
    if found != version:
        raise DamagedRunError(f"{index}: format version {found}; this movezoo reads {version}")
    if seal != _seal(body):
        raise DamagedRunError(f"{index}: the index is damaged (its seal differs)")
    return body


def _no_json(word: str) -> None:
    raise ValueError(f"{word} is not JSON")
