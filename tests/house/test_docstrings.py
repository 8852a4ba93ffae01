"""Every public name is documented, and every example in a docstring runs."""

from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HOMES = {"zoo": "zoo", "guides": "zoo.guides", "datasets": "zoo.datasets"}
LINKS = ("guides", "datasets", "results")


def modules() -> list[str]:
    """Import names of all modules of the package."""
    names = []
    for home, package in HOMES.items():
        for file in sorted((ROOT / home).rglob("*.py")):
            inside = file.relative_to(ROOT / home)
            if not (home == "zoo" and inside.parts[0] in LINKS):
                dotted = ".".join((package, *inside.with_suffix("").parts))
                names.append(dotted.removesuffix(".__init__"))
    return names


@pytest.mark.parametrize("name", modules())
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.failed == 0


@pytest.mark.parametrize("name", modules())
def test_public_names_are_documented(name: str) -> None:
    module = importlib.import_module(name)
    assert inspect.getdoc(module)
    for public in getattr(module, "__all__", []):
        thing = getattr(module, public)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), f"{name}.{public}"
