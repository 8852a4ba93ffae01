"""Registration machinery: entries by name, lazily imported, with capabilities read from source."""

from __future__ import annotations

import ast
import difflib
import fnmatch
import importlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from zoo.errors import UnknownNameError
from zoo.strategies import Inference

__all__ = ["CAPABILITIES", "Entry", "Registry", "Scaling", "load"]

Scaling = Literal["standard", "center", "range", "none"]
CAPABILITIES = ("regress", "represent", "reconstruct", "forecast", "impute", "generate", "act")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One selectable model: generative model + guide + inference, by import path ``module:Class``.

    ``config`` overrides defaults of the model's and the guide's ``Config``; ``dataset`` is the
    data set that the card trains on; ``thesis`` the section; ``scaling`` how the run scales data.
    """

    name: str
    summary: str
    thesis: str
    model: str
    guide: str | None
    inference: Inference
    data: Literal["sequences", "pairs"]
    dataset: str
    scaling: Scaling = "standard"
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def posterior(self) -> str:
        """The guide in words, such as ``exact posterior``, or ``none``."""
        if self.guide is None:
            return "none"
        _, _, name = self.guide.partition(":")
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()

    @property
    def capabilities(self) -> tuple[str, ...]:
        """Tasks that the model's class has a method for."""
        return tuple(c for c in CAPABILITIES if c in _methods(self.model))


class Registry:
    """Entries by name; a name can be taken once."""

    def __init__(self, entries: Iterable[Entry] = ()) -> None:
        """Register ``entries`` in order."""
        self._entries: dict[str, Entry] = {}
        for entry in entries:
            self.register(entry)

    def register(self, entry: Entry) -> None:
        """Add an entry; a name that is taken is refused."""
        if entry.name in self._entries:
            raise ValueError(f"model {entry.name!r} is registered already")
        self._entries[entry.name] = entry

    def __getitem__(self, name: str) -> Entry:
        """The entry of that name; an unknown name lists the nearest ones."""
        if not isinstance(name, str):
            raise TypeError(f"a model is named by text, such as 'vae-dmp'; got {name!r}")
        if name not in self._entries:
            near = difflib.get_close_matches(name, self._entries, n=3, cutoff=0.4)
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise UnknownNameError(f"no model {name!r}{hint} (`zoo list` names all)")
        return self._entries[name]

    def __iter__(self) -> Any:
        """Entries in the order of registration."""
        return iter(self._entries.values())

    def names(self, pattern: str = "*", *, can: str | None = None) -> list[str]:
        """Names that match a glob and, where ``can`` is given, have that capability."""
        if can is not None and can not in CAPABILITIES:
            raise UnknownNameError(f"no capability {can!r}; there are {', '.join(CAPABILITIES)}")
        return [
            e.name
            for e in self
            if fnmatch.fnmatch(e.name, pattern) and (can is None or can in e.capabilities)
        ]


def load(path: str) -> Any:
    """The class behind ``module:Class``."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


@cache
def _methods(path: str) -> frozenset[str]:
    module, _, name = path.partition(":")
    tree = _parse(module)
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            own = {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
            bases = [b.id for b in node.bases if isinstance(b, ast.Name)]
            return frozenset(
                own.union(*(_methods(p) for p in map(_locate(tree, module), bases) if p))
            )
    raise ValueError(f"{module} defines no class {name}")


def _locate(tree: ast.Module, module: str) -> Any:
    """Where a base class comes from: this module, another module of the zoo, or elsewhere."""
    local = {n.name for n in tree.body if isinstance(n, ast.ClassDef)}
    imported = {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("zoo.")
        for alias in node.names
    }
    return lambda base: f"{module}:{base}" if base in local else imported.get(base)


@cache
def _parse(module: str) -> ast.Module:
    package, _, leaf = module.rpartition(".")
    spec = find_spec(package) if package else None
    folders = (spec.submodule_search_locations or []) if spec else []
    for folder in folders:
        path = Path(folder) / f"{leaf}.py"
        if path.exists():
            return ast.parse(path.read_text(encoding="utf-8"))
    found = find_spec(module)
    if found is None or found.origin is None:
        raise ModuleNotFoundError(f"no module {module}")
    return ast.parse(Path(found.origin).read_text(encoding="utf-8"))
