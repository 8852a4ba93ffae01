"""Every public name is documented, and every example in a docstring runs."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType

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


def examples(module: ModuleType) -> list[doctest.DocTest]:
    """Examples of a module and of what is written there, inside of decorators too."""
    things = {id(t): t for t in vars(module).values() if inspect.isclass(t) or inspect.isroutine(t)}
    own = [t for t in things.values() if t.__module__ == module.__name__]
    finder = doctest.DocTestFinder()
    parts = (finder.find(t, module=False, globs=vars(module)) for t in own)  # type: ignore[arg-type]
    text = inspect.getsource(module)
    return [example for part in parts for example in part if example.docstring in text]


@pytest.mark.parametrize("name", modules())
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    found, runner = examples(module), doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for example in found:
        runner.run(example)
    assert runner.failures == 0
    written = re.findall(r"^ *>>> ", inspect.getsource(module), re.MULTILINE)
    assert sum(len(e.examples) for e in found) == len(written)


@pytest.mark.parametrize("name", modules())
def test_public_names_are_documented(name: str) -> None:
    module = importlib.import_module(name)
    assert inspect.getdoc(module)
    for public in getattr(module, "__all__", []):
        thing = getattr(module, public)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), f"{name}.{public}"
