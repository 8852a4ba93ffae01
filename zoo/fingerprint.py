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
from zoo.assembly import Assembly
from zoo.codehash import hashes
from zoo.datasets.digest import contents
from zoo.datasets.records import Pairs, Sequences
from zoo.inference.state import FREE

__all__ = ["code", "fingerprint", "key"]

_LIBRARIES = ("pyro-ppl", "gpytorch", "numpy", "scipy")


def fingerprint(
    assembly: Assembly, train: Pairs | Sequences, val: Pairs | Sequences | None = None
) -> dict[str, str]:
    """What decides the bits of ``zoo.fit``: settings, seed, data, libraries and code, by name.

    Digests begin with #. The number of threads is not among them: it changes the rounding, not
    the model.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> found = fingerprint(zoo.create("pca", data, latent_dim=2), data)
    >>> found["latent_dim of the model"], found["seed"], "code of zoo.models.pca" in found
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
    named = [p.partition(":")[0] for p in (assembly.entry.model, assembly.entry.guide) if p]
    own = {"zoo", *(module.partition(".")[0] for module in named)}
    used = [type(part).__module__ for part in (assembly.model, assembly.guide)]
    return [*named, *(m for m in used if m.partition(".")[0] in own), "zoo.training"]


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
