"""Methods of a class, read from its source: no model has to be imported to be listed."""

from __future__ import annotations

import ast
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path

__all__ = ["methods"]

_OWN = "zoo"


@cache
def methods(path: str) -> frozenset[str]:
    """Names of the methods of ``module:Class`` and of its bases.

    Bases are followed within this package and within the package of the module; a class that the
    module takes from another one of these is followed too. Raises ModuleNotFoundError for a module
    without a source file, and ValueError where it has no such class.

    >>> found = methods("zoo.models.baselines.mean:Mean")
    >>> "forecast" in found, "generate" in found
    (True, False)
    """
    module, _, name = path.partition(":")
    tree, package = _parse(module)
    known = _imported(tree, {_OWN, module.partition(".")[0]}, package)
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            own = {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
            local = {n.name for n in tree.body if isinstance(n, ast.ClassDef)}
            bases = [_located(base, module, local, known) for base in node.bases]
            return frozenset(own.union(*(methods(b) for b in bases if b)))
    if name in known:
        return methods(known[name])
    raise ValueError(f"{module} defines no class {name}")


def _located(base: ast.expr, module: str, local: set[str], known: dict[str, str]) -> str | None:
    """Where a base class comes from; None for one of another library."""
    home, _, name = ast.unparse(base).rpartition(".")
    if not home:
        return f"{module}:{name}" if name in local else known.get(name)
    found = known.get(home, home).replace(":", ".")
    return f"{found}:{name}" if home in known or found.partition(".")[0] == _OWN else None


def _imported(tree: ast.Module, own: set[str], package: str) -> dict[str, str]:
    """Names that a module imports from this package or its own, as ``module:name``."""
    found: dict[str, str] = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            home = f"{'.' * node.level}{node.module or ''}"
            home = resolve_name(home, package) if node.level else home
            if home.partition(".")[0] in own:
                found |= {a.asname or a.name: f"{home}:{a.name}" for a in node.names}
    return found


@cache
def _parse(module: str) -> tuple[ast.Module, str]:
    """The syntax of a module, and the package that its relative imports start from."""
    package, _, leaf = module.rpartition(".")
    spec = find_spec(package) if package else None
    folders = (spec.submodule_search_locations or []) if spec else []
    for folder in folders:
        path = Path(folder) / f"{leaf}.py"
        if path.exists():
            return ast.parse(path.read_text(encoding="utf-8")), package
    found = find_spec(module)
    if found is None or found.origin is None or not found.origin.endswith(".py"):
        raise ModuleNotFoundError(f"no module {module} with a source file")
    home = module if found.submodule_search_locations is not None else package
    return ast.parse(Path(found.origin).read_text(encoding="utf-8")), home
