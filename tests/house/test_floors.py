"""Imports only ever point down, inside a floor too: no arrow up, no circle, and few rooms."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FLOORS = {
    "zoo.types": 0,
    "zoo.errors": 0,
    "zoo.archive": 0,
    "zoo.version": 0,
    "zoo.arguments": 0,
    "zoo.display": 0,
    "zoo.streams": 0,
    "zoo.prediction": 1,
    "zoo.datasets": 1,
    "zoo.nn": 1,
    "zoo.contract": 2,
    "zoo.inference": 3,
    "zoo.evaluation": 3,
    "zoo.movement": 3,
    "zoo.models": 4,
    "zoo.guides": 4,
    "zoo.catalogue": 5,
    "zoo.runs": 6,
    "zoo.studies": 7,
    "zoo.faces": 8,
    "zoo.__main__": 9,
    "zoo": 9,
}
APART = ("zoo.models", "zoo.guides", "zoo.evaluation")
ROOMS = 26


def modules() -> dict[str, Path]:
    """Every module of the package by its import name."""
    homes = {"zoo": ROOT / "zoo", "zoo.guides": ROOT / "guides", "zoo.datasets": ROOT / "datasets"}
    found = {}
    for package, home in homes.items():
        for file in home.rglob("*.py"):
            inside = file.relative_to(home)
            if package == "zoo" and inside.parts[0] in ("guides", "datasets", "results"):
                continue
            dotted = ".".join((package, *inside.with_suffix("").parts))
            found[dotted.removesuffix(".__init__")] = file
    return found


MODULES = modules()


def room(module: str) -> str:
    """The room a module stands in: its own name or the longest of its packages with a floor."""
    parts = module.split(".")
    names = (".".join(parts[:n]) for n in range(len(parts), 1, -1))
    found = next((name for name in names if name in FLOORS), "zoo" if module == "zoo" else None)
    assert found is not None, f"{module} stands in no room"
    return found


def imports(file: Path) -> set[str]:
    """Files of the zoo that a file imports, inside functions and for its types too.

    A name from a package is the module of that name where there is one, else the package's own
    ``__init__``. The packages that a module is in are not counted: their ``__init__`` may pass on
    what stands in them.
    """
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in MODULES else str(node.module))
    return found & set(MODULES)


GRAPH = {module: imports(file) for module, file in MODULES.items()}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_down(module: str) -> None:
    mine = FLOORS[room(module)]
    up = {other for other in GRAPH[module] if FLOORS[room(other)] > mine}
    assert not up, f"{module} looks up to {', '.join(sorted(up))}"


def test_imports_run_in_no_circle() -> None:
    try:
        TopologicalSorter(GRAPH).prepare()
    except CycleError as error:
        pytest.fail(f"imports run in a circle: {' → '.join(reversed(error.args[1]))}")


@pytest.mark.parametrize("module", sorted(m for m in MODULES if room(m) in APART))
def test_models_guides_and_evaluation_do_not_know_each_other(module: str) -> None:
    others = {room(other) for other in GRAPH[module]} & set(APART)
    assert others <= {room(module)}


def test_the_house_has_few_rooms() -> None:
    rooms = {file.parent for file in MODULES.values()}
    assert len(rooms) <= ROOMS, sorted(str(r.relative_to(ROOT)) for r in rooms)


def test_every_file_is_of_a_size_that_one_reads() -> None:
    long = {m for m, f in MODULES.items() if f.read_text(encoding="utf-8").count("\n") > 320}
    assert not long
