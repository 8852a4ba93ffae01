"""What the package requires is what it imports."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ENGINES = {"h5netcdf": 'engine="h5netcdf"', "h5py": 'engine="h5netcdf"'}
"""Requirements that another library imports when it is told their name; h5netcdf reads by h5py."""


def sources() -> list[str]:
    """The text of every file of the package."""
    homes = (ROOT / home for home in ("zoo", "guides", "datasets"))
    files = {file.resolve() for home in homes for file in home.rglob("*.py")}
    return [file.read_text(encoding="utf-8") for file in sorted(files)]


def imported() -> set[str]:
    """Distributions that the package imports, inside functions too."""
    modules = set()
    for node in (n for text in sources() for n in ast.walk(ast.parse(text))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
        modules |= {name.partition(".")[0] for name in names}
    known = packages_distributions()
    strange = modules - sys.stdlib_module_names - {"zoo"}
    return {named(known.get(module, [module])[0]) for module in strange}


def named(requirement: str) -> str:
    """The distribution of a requirement, in small letters with hyphens."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found is not None
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def test_every_requirement_is_imported() -> None:
    required = {named(r) for r in PROJECT["dependencies"]}
    text = "\n".join(sources())
    assert all(words in text for words in ENGINES.values())
    assert required - imported() == set(ENGINES)


def test_every_import_is_required_or_of_an_extra() -> None:
    extras = [r for some in PROJECT["optional-dependencies"].values() for r in some]
    assert imported() <= {named(r) for r in PROJECT["dependencies"] + extras}


def test_every_requirement_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {named(line) for line in lines if line and not line.startswith("#")}
    assert {named(r) for r in PROJECT["dependencies"]} <= pinned
