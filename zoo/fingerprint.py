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
        "model": entry.model,
        "guide": str(entry.guide),
        "inference": type(assembly.inference).__name__,
        **_settings(assembly),
        "scaling": assembly.scaling,
        "seed": str(assembly.seed),
        "device": assembly.device,
        "number type": str(assembly.dtype),
        **contents(train, "training"),
        **contents(val, "validation"),
        **_versions(),
        **code([p.partition(":")[0] for p in (entry.model, entry.guide) if p] + ["zoo.training"]),
        "initial parameters": _initial(assembly),
    }


def key(made_of: object) -> str:
    """A short hash of a fingerprint, or of a list with some: the name of a cache's folder."""
    text = json.dumps(made_of, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def code(roots: Iterable[str]) -> dict[str, str]:
    """Digests of all the code that some modules depend on, by module."""
    return {f"code of {module}": f"#{digest}" for module, digest in hashes(roots).items()}


def _settings(assembly: Assembly) -> dict[str, str]:
    """All settings, those left at their defaults too."""
    parts: dict[str, Any] = {"model": assembly.model, "guide": assembly.guide}
    found = {
        f"{name} of the {part}": _plain(value)
        for part, module in parts.items()
        if module is not None
        for name, value in asdict(module.config).items()
    }
    strategy = asdict(assembly.inference).items()
    return found | {
        f"{name} of the training": _plain(v) for name, v in strategy if name not in FREE
    }


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
