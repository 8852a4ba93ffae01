"""Digests of code that no module holds: a class of a notebook and all of its own that it names."""

from __future__ import annotations

import ast
import builtins
import dataclasses
import hashlib
import inspect
import sys
import sysconfig
import textwrap
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any
from uuid import uuid4

from zoo.inference.resume.codehash import bare, has_source

__all__ = ["digest", "needed"]

_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_WORDS = ("typing", "types", "collections.abc")
_LIBRARIES = tuple(sysconfig.get_paths()[k] for k in ("stdlib", "platstdlib", "purelib", "platlib"))


class _Unknown(Exception):
    """Something that the class names has neither a source nor a plain value."""


def digest(kind: type) -> str:
    """A digest of a class, and of the functions, classes and plain values beside it that it names.

    Where a part has no source, or is neither code nor a plain value, nobody can tell whether it is
    still the same: the digest then holds for this very class object alone, so that no training and
    no cache of another session is taken for it.
    """
    try:
        parts = "\n".join(sorted(_parts(kind)))
    except _Unknown as reason:
        return f"unknown ({reason}; {_token(kind)})"
    return f"#{hashlib.sha256(parts.encode()).hexdigest()[:16]}"


def needed(kind: type) -> list[str]:
    """Modules with a source file, no libraries, that the class and what is beside it name."""
    try:
        found = {name for thing in _closure(kind).values() for name in _modules(thing, kind)}
    except _Unknown:
        found = {base.__module__ for base in kind.__mro__}
    return sorted(m for m in found if not _library(m) and has_source(m))


def _parts(kind: type) -> Iterator[str]:
    for name, thing in _closure(kind).items():
        if _beside(thing, kind):
            yield f"{name}: {_text(thing)}"
        elif not isinstance(thing, (ModuleType, type, FunctionType)):
            yield f"{name} = {_value(name, thing)}"


def _closure(kind: type) -> dict[str, Any]:
    """The class and what it names, directly or not, in its own namespace."""
    space = vars(sys.modules[kind.__module__]) if kind.__module__ in sys.modules else {}
    found: dict[str, Any] = {}
    waiting: list[tuple[str, Any]] = [(kind.__qualname__, kind)]
    while waiting:
        name, thing = waiting.pop()
        if name not in found:
            found[name] = thing
            if _beside(thing, kind):
                waiting += [(n, space[n]) for n in _names(thing) if n in space]
                waiting += [(b.__qualname__, b) for b in getattr(thing, "__mro__", ())[1:-1]]
    return found


def _names(thing: Any) -> set[str]:
    nodes = ast.walk(ast.parse(_text(thing, bared=False)))
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    return names - set(vars(builtins))


def _beside(thing: Any, kind: type) -> bool:
    """Whether something is code of the same namespace."""
    return isinstance(thing, (type, FunctionType)) and thing.__module__ == kind.__module__


def _modules(thing: Any, kind: type) -> set[str]:
    if isinstance(thing, ModuleType):
        return {thing.__name__}
    outside = isinstance(thing, (type, FunctionType)) and not _beside(thing, kind)
    return {thing.__module__} if outside else set()


def _library(module: str) -> bool:
    """Whether a module is told apart by its version: not this package, nor a file of the user's."""
    file = getattr(sys.modules.get(module), "__file__", None)
    own = module.partition(".")[0] == "zoo"
    return not own and (file is None or str(Path(file).resolve()).startswith(_LIBRARIES))


def _text(thing: Any, *, bared: bool = True) -> str:
    """The code without comments, docstrings and layout."""
    tree = _tree(thing)
    if tree is None and dataclasses.is_dataclass(thing):
        fields = [(f.name, str(f.type), f.default) for f in dataclasses.fields(thing)]
        return f"dataclass {fields!r}" if bared else ""
    if tree is None:
        raise _Unknown(f"{thing.__name__} has no source")
    return ast.dump(bare(tree)) if bared else ast.unparse(tree)


def _tree(thing: Any) -> ast.Module | None:
    try:
        return ast.parse(textwrap.dedent(inspect.getsource(thing)))
    except (OSError, TypeError, SyntaxError):
        return _cell(thing) if isinstance(thing, type) else None


def _cell(kind: type) -> ast.Module | None:
    """A class in the cell that its methods were written in."""
    for method in filter(inspect.isfunction, vars(kind).values()):
        try:
            tree = ast.parse("".join(inspect.findsource(method)[0]))
        except (OSError, TypeError, SyntaxError):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and node.name == kind.__name__:
                return ast.Module(body=[node], type_ignores=[])
    return None


def _value(name: str, thing: Any) -> str:
    if isinstance(thing, (list, tuple, set, frozenset)):
        return f"{type(thing).__name__}({', '.join(_value(name, t) for t in thing)})"
    if isinstance(thing, Mapping):
        return f"{{{', '.join(f'{k!r}: {_value(name, v)}' for k, v in thing.items())}}}"
    if isinstance(thing, _PLAIN):
        return repr(thing)
    if inspect.isroutine(thing) or type(thing).__module__ in _WORDS:
        return f"{getattr(thing, '__module__', '')} {getattr(thing, '__qualname__', thing)}"
    raise _Unknown(f"{name} is a {type(thing).__name__}")


@cache
def _token(kind: type) -> str:
    """A word for this class object and no other, of whatever session."""
    return uuid4().hex[:12]
