"""Imports only ever point down: each room knows the floors below it and nothing above."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FLOORS = {
    "zoo.types": 0,
    "zoo.version": 0,
    "zoo.errors": 0,
    "zoo.prediction": 0,
    "zoo.mixtures": 0,
    "zoo.capabilities": 0,
    "zoo.parts": 0,
    "zoo.strategies": 0,
    "zoo.registry": 0,
    "zoo.methods": 0,
    "zoo.plugins": 0,
    "zoo.cellcode": 0,
    "zoo.archive": 0,
    "zoo.arguments": 0,
    "zoo.codehash": 0,
    "zoo.lock": 0,
    "zoo.streams": 0,
    "zoo.inference": 1,
    "zoo.dynamics": 1,
    "zoo.nn": 1,
    "zoo.datasets": 1,
    "zoo.models": 2,
    "zoo.guides": 2,
    "zoo.evaluation": 2,
    "zoo.player": 2,
    "zoo.automatic": 3,
    "zoo.catalogue": 3,
    "zoo.assembly": 4,
    "zoo.tasks": 4,
    "zoo.exchange": 4,
    "zoo.fitting": 4,
    "zoo.questions": 4,
    "zoo.fingerprint": 4,
    "zoo.rundir": 4,
    "zoo.training": 4,
    "zoo.record": 4,
    "zoo.answering": 4,
    "zoo.run": 4,
    "zoo.ensemble": 4,
    "zoo.storage": 4,
    "zoo.cards": 5,
    "zoo.experiments": 5,
    "zoo.leaderboard": 5,
    "zoo.workflow": 5,
    "zoo.screening": 5,
    "zoo.console": 6,
    "zoo.cli": 6,
    "zoo.options": 6,
    "zoo.demo": 6,
    "zoo.__main__": 6,
}
APART = ("zoo.models", "zoo.guides", "zoo.evaluation")


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


def room(module: str) -> str | None:
    """The room a module stands in; the package itself is no room."""
    return next((r for r in FLOORS if module == r or module.startswith(f"{r}.")), None)


def imports(file: Path) -> set[str]:
    """Modules of the zoo that a file imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            found |= {f"{node.module}.{a.name}" for a in node.names} | {str(node.module)}
    return {name for name in found if name.startswith("zoo.")}


MODULES = modules()


@pytest.mark.parametrize("module", sorted(set(MODULES) - {"zoo"}))
def test_imports_point_down(module: str) -> None:
    mine = room(module)
    assert mine is not None, f"{module} stands in no room"
    for other in map(room, imports(MODULES[module])):
        assert other is None or FLOORS[other] <= FLOORS[mine], f"{module} looks up to {other}"


@pytest.mark.parametrize("module", sorted(m for m in MODULES if room(m) in APART))
def test_models_guides_and_evaluation_do_not_know_each_other(module: str) -> None:
    others = {room(i) for i in imports(MODULES[module])} & set(APART)
    assert others <= {room(module)}


def test_every_file_is_of_a_size_that_one_reads() -> None:
    long = {m for m, f in MODULES.items() if f.read_text(encoding="utf-8").count("\n") > 320}
    assert not long
