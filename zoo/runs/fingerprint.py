"""Everything that determines a trained run, in words: what a folder or a cache is compared by."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from typing import Any

import torch
from torch import nn

from zoo import archive
from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.digest import contents
from zoo.inference.resume.cellcode import digest, needed
from zoo.inference.resume.codehash import has_source, hashes
from zoo.inference.resume.state import FREE
from zoo.runs.assembly import Assembly

__all__ = ["code", "fingerprint", "key"]

_LIBRARIES = ("pyro-ppl", "gpytorch", "numpy", "scipy")


def fingerprint(
    assembly: Assembly, train: Pairs | Sequences, val: Pairs | Sequences | None = None
) -> dict[str, str]:
    """What decides the bits of ``zoo.fit``: settings, seed, data, libraries and code, by name.

    Digests begin with #. The number of threads is not among them: it changes the rounding, not
    the model. Of a class that no module holds, such as one of a notebook, it is the code of the
    class and of all of the notebook's own that it names; where that cannot be told, the
    fingerprint is equal to none but that of the same class object.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> found = fingerprint(zoo.create("pca", data, latent_dim=2), data)
    >>> found["latent_dim of the model"], found["seed"], "code of zoo.models.frames.pca" in found
    ('2', '0', True)
    """
    entry = assembly.entry
    return {
        "entry": entry.name,
        "model": _path(assembly.model),
        "guide": _path(assembly.guide),
        "inference": type(assembly.inference).__name__,
        **_settings(assembly),
        "scaling": assembly.scaling,
        "seed": str(assembly.seed),
        "device": assembly.device,
        "number type": str(assembly.dtype),
        **contents(train, "training"),
        **contents(val, "validation"),
        **_versions(),
        **code(_roots(assembly)),
        **{f"code of {_path(p)}": digest(type(p)) for p in _cells(assembly)},
        "initial parameters": _initial(assembly),
    }


def key(made_of: object) -> str:
    """A short hash of a fingerprint, or of a list with some: the name of a cache's folder."""
    text = json.dumps(made_of, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def code(roots: Iterable[str]) -> dict[str, str]:
    """Digests of all the code that some modules depend on, by module."""
    return {f"code of {module}": f"#{digest}" for module, digest in hashes(roots).items()}


def _path(part: nn.Module | None) -> str:
    return "none" if part is None else f"{type(part).__module__}:{type(part).__qualname__}"


def _roots(assembly: Assembly) -> list[str]:
    """Modules whose code decides the result: the entry's, those of what stands in for it, ours."""
    paths = [p for p in (assembly.entry.model, assembly.entry.guide) if isinstance(p, str)]
    cells = [type(part) for part in _cells(assembly)]
    used = [type(p).__module__ for p in (assembly.model, assembly.guide) if type(p) not in cells]
    named = [p.partition(":")[0] for p in paths]
    own = {"zoo", *(module.partition(".")[0] for module in named)}
    given = [k.__module__ for k in _classes(assembly) if k not in cells]
    beside = [module for kind in cells for module in needed(kind)]
    kept = [m for m in used if m.partition(".")[0] in own]
    return [*named, *given, *beside, *kept, "zoo.runs.training"]


def _classes(assembly: Assembly) -> list[type]:
    """Parts that an entry names by the class itself."""
    return [p for p in (assembly.entry.model, assembly.entry.guide) if isinstance(p, type)]


def _cells(assembly: Assembly) -> list[nn.Module]:
    """Parts whose class no module holds."""
    given = _classes(assembly)
    parts = [p for p in (assembly.model, assembly.guide) if p is not None and type(p) in given]
    return [p for p in parts if not has_source(type(p).__module__)]


def _settings(assembly: Assembly) -> dict[str, str]:
    """All settings, those left at their defaults too."""
    parts: dict[str, Any] = {"model": assembly.model, "guide": assembly.guide}
    found = {
        f"{name} of the {part}": _plain(value)
        for part, module in parts.items()
        for name, value in _fields(module).items()
    }
    strategy = asdict(assembly.inference).items()
    return found | {
        f"{name} of the training": _plain(v) for name, v in strategy if name not in FREE
    }


def _fields(module: Any) -> dict[str, Any]:
    """Fields of the part's Config; an automatic guide has none."""
    config = getattr(module, "config", None)
    return {} if config is None else asdict(config)


def _plain(value: object) -> str:
    """A setting in words: alike for a list, a tuple and an array."""
    return json.dumps(value, default=lambda array: array.tolist())


def _initial(assembly: Assembly) -> str:
    total = hashlib.sha256()
    for name, value in archive.state_of(model=assembly.model, guide=assembly.guide).items():
        total.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        total.update(value.detach().cpu().contiguous().numpy().tobytes())
    return f"#{total.hexdigest()[:16]}"


@cache
def _versions() -> dict[str, str]:
    python = ".".join(platform.python_version_tuple()[:2])
    found = {f"version of {name}": version(name) for name in _LIBRARIES}
    return {"version of python": python, "version of torch": str(torch.__version__), **found}
