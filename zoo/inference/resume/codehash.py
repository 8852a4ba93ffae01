"""Hashes of the source code that a result depends on, module by module.

A module depends on all that it imports, inside functions too, and on the packages it is in. Only
modules of this package, and of the packages that the roots belong to, are followed; libraries are
told apart by their version. Comments, docstrings and layout do not count.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path

__all__ = ["bare", "has_source", "hashes"]

_OWN = "zoo"
# the catalogue knows every entry and the package every name: what a result takes from them is told
# by the entry's own paths and settings
_APART = ("zoo", "zoo.catalogue")
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def hashes(roots: Iterable[str]) -> dict[str, str]:
    """A hash for every module that ``roots`` import, directly or not, and for themselves.

    Raises ModuleNotFoundError for a root without a source file.

    >>> found = hashes(["zoo.models.baselines.mean"])
    >>> "zoo.models.baselines.mean" in found, "zoo.types" in found, "zoo.models.frames.vae" in found
    (True, True, False)
    """
    waiting = list(dict.fromkeys(roots))
    own = frozenset({_OWN, *(root.partition(".")[0] for root in waiting)})
    found: dict[str, str] = {}
    while waiting:
        module = waiting.pop()
        if module not in found and module not in _APART:
            found[module], imported = _read(module)
            needed = {module.rpartition(".")[0], *imported}
            mine = (i for i in needed if i.partition(".")[0] in own)
            waiting += [i for i in mine if _file(i) is not None]
    return dict(sorted(found.items()))


def has_source(module: str) -> bool:
    """Whether a module has a file whose code can be hashed.

    >>> has_source("zoo.types"), has_source("math")
    (True, False)
    """
    try:
        return _file(module) is not None
    except (ImportError, ValueError):  # a module that was made by hand, such as __main__
        return False


@cache
def _read(module: str) -> tuple[str, frozenset[str]]:
    """Hash of a module's code, and what it imports."""
    path = _file(module)
    if path is None:
        raise ModuleNotFoundError(f"no source file of module {module}: its code has no hash")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    imported = frozenset(_imports(tree, package))
    return hashlib.sha256(ast.dump(bare(tree)).encode()).hexdigest()[:16], imported


def _imports(tree: ast.Module, package: str) -> Iterator[str]:
    """Modules that a file names; ``from a import b`` may mean a module a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            dots = "." * node.level
            home = resolve_name(f"{dots}{node.module or ''}", package) if dots else node.module
            yield str(home)
            yield from (f"{home}.{alias.name}" for alias in node.names)


@cache
def _file(module: str) -> Path | None:
    """The source of a module, sought without importing it; None where there is none."""
    package, _, leaf = module.rpartition(".")
    if package:
        files = [f for p in _folders(package) for f in (p / leaf / "__init__.py", p / f"{leaf}.py")]
        return next((f for f in files if f.is_file()), None)
    spec = find_spec(module)
    file = None if spec is None or not spec.has_location else Path(str(spec.origin))
    return file if file is not None and file.suffix == ".py" else None


@cache
def _folders(package: str) -> tuple[Path, ...]:
    spec = find_spec(package)
    return tuple(Path(p) for p in (spec.submodule_search_locations or ())) if spec else ()


def bare(tree: ast.Module) -> ast.Module:
    """The code without its docstrings."""
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return tree
