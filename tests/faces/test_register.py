"""Models from outside: registered in a notebook, or offered by another installed package."""

from __future__ import annotations

import json
import linecache
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import movements

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.methods import methods
from zoo.contract.registry import Entry, Registry
from zoo.errors import (
    BrokenPluginWarning,
    DamagedRunError,
    NotRegisteredError,
    OtherTrainingError,
    UnknownNameError,
)
from zoo.faces.cli import main
from zoo.inference.resume.cellcode import digest
from zoo.studies.leaderboard import own_protocol, run_leaderboard

CELL = '''
from dataclasses import dataclass
import torch
from torch import nn
import zoo

SHIFT = 1.0

@dataclass(frozen=True, kw_only=True)
class Config:
    """No settings."""

def level(values, mask):
    return (values * mask).sum((0, 1)) / mask.sum((0, 1))  # a comment

class Level(nn.Module):
    """Every frame is the mean frame."""

    config_class = Config
    dtype = torch.float64

    def __init__(self, layout, config):
        super().__init__()
        self.config = config
        self.register_buffer("level", torch.zeros(len(layout.channels), dtype=self.dtype))

    def condition(self, data):
        self.level = SHIFT * level(data.values, data.mask)

    def forecast(self, batch, posterior, *, horizon, draws):
        shape = (1, len(batch), horizon, len(self.level))
        one = torch.ones((), dtype=self.dtype)
        return zoo.Predictive(location=self.level.expand(shape), noise=one)
'''


@pytest.fixture(autouse=True)
def shelf(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers is gone after it."""
    list(CATALOGUE)
    monkeypatch.setattr(CATALOGUE, "_entries", dict(CATALOGUE._entries))
    monkeypatch.setattr(CATALOGUE, "_joined", set(CATALOGUE._joined))
    yield


def cell(text: str = CELL, name: str = "<cell>", *, seen: bool = True) -> dict[str, Any]:
    """Run a cell in a namespace of no file, as a notebook does."""
    module = type(sys)("cells")
    sys.modules["cells"] = module
    if seen:
        linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    exec(compile(text, name, "exec"), module.__dict__)
    return module.__dict__


def entry_of(kind: type, **changes: Any) -> Entry:
    """An entry of a class that stands in no file."""
    given: dict[str, Any] = {
        "name": "level",
        "summary": "the mean frame",
        "model": kind,
        "guide": None,
        "inference": zoo.Exact(),
        "data": "sequences",
    }
    return zoo.Entry(**(given | changes))


def test_a_class_of_a_notebook_joins_everything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    zoo.register(entry_of(cell()["Level"]))
    assert "level" in zoo.list_models(can="forecast")
    assert zoo.card("level").text == "Every frame is the mean frame."
    assert main(["list", "level"]) == 0 and main(["card", "level"]) == 0
    assert "the mean frame" in capsys.readouterr().out
    run = zoo.fit(zoo.create("level", movements()), movements()[:6])
    truth = movements().values[:6].mean((0, 1))
    ahead = run.forecast(movements().first(5), horizon=3)
    assert ahead.mean[2, 1].numpy() == pytest.approx(truth.numpy())
    protocol = own_protocol(movements(), seen=10, horizon=8)
    found = run_leaderboard(
        protocol, tmp_path, models=["level", "mean"], root=tmp_path / "cells", folds=3
    )
    assert {row[0] for row in found.rows} == {"level", "mean"}
    with pytest.raises(ValueError, match="cannot import the classes of 'level': take jobs=1"):
        run_leaderboard(protocol, tmp_path, models=["level"], root=tmp_path, folds=3, jobs=2)


def test_an_entry_by_path_is_known_to_other_processes(tmp_path: Path) -> None:
    zoo.register(replace(CATALOGUE["mean"], name="my-mean"))
    protocol = own_protocol(movements(), seen=10, horizon=8)
    found = run_leaderboard(
        protocol, tmp_path, models=["my-mean"], folds=3, root=tmp_path / "cells", jobs=2
    )
    assert [row[0] for row in found.rows] == ["my-mean"]


def test_a_run_needs_its_entry_to_be_registered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zoo.register(entry_of(cell()["Level"]))
    run = zoo.fit(zoo.create("level", movements()), movements())
    folder = run.save(tmp_path / "run")
    again = zoo.load(folder)
    assert again.model.level.equal(run.model.level)
    monkeypatch.delitem(CATALOGUE._entries, "level")
    with pytest.raises(NotRegisteredError, match=r"run of 'level'.* call zoo.register"):
        zoo.load(folder)
    assert main(["evaluate", str(folder), "--data", "robot-arm/reaching"]) == 2
    assert issubclass(NotRegisteredError, UnknownNameError)
    assert not issubclass(NotRegisteredError, DamagedRunError)


def test_a_training_of_a_notebook_is_resumed_while_its_code_is_the_same(tmp_path: Path) -> None:
    def fitted(text: str) -> zoo.Run:
        zoo.register(entry_of(cell(text)["Level"]), replace=True)
        made = zoo.create("level", movements())
        return zoo.fit(made, movements(), run_dir=tmp_path / "run", resume="auto")

    made_of = fitted(CELL).made_of
    assert made_of["code of cells:Level"].startswith("#")
    assert "code of zoo.runs.training" in made_of
    fitted(CELL.replace("# a comment", "# another"))
    for old, new in (("SHIFT = 1.0", "SHIFT = 2.0"), ("sum((0, 1)) / mask", "sum((0, 1)) * mask")):
        with pytest.raises(OtherTrainingError, match="code of cells:Level changed"):
            fitted(CELL.replace(old, new))


@pytest.mark.parametrize(
    "text", [CELL, CELL.replace("SHIFT = 1.0", "SHIFT = torch.ones(())")], ids=["source", "tensor"]
)
def test_code_that_nobody_can_read_is_never_resumed(text: str, tmp_path: Path) -> None:
    """A class without source, or that names a value which is no plain one."""
    seen = text != CELL
    kinds = [cell(text, f"<{i}-{seen}>", seen=seen)["Level"] for i in range(2)]
    assert digest(kinds[0]) == digest(kinds[0]) != digest(kinds[1])
    for kind in kinds:
        zoo.register(entry_of(kind), replace=True)
        made = zoo.create("level", movements())
        if kind is kinds[1]:
            with pytest.raises(OtherTrainingError, match="code of cells:Level was unknown"):
                zoo.fit(made, movements(), run_dir=tmp_path / "run", resume="auto")
        else:
            zoo.fit(made, movements(), run_dir=tmp_path / "run")
            zoo.fit(made, movements(), run_dir=tmp_path / "run", resume="auto")


def test_a_class_of_a_notebook_is_hashed_with_the_modules_it_names() -> None:
    text = (
        CELL
        + """
from zoo.models.frames.pca import PCA

class Mine(PCA):
    dtype = torch.float64
"""
    )
    zoo.register(entry_of(cell(text)["Mine"], guide="zoo.guides.exact:ExactPosterior"))
    from zoo.runs.fingerprint import fingerprint

    found = fingerprint(zoo.create("level", movements(), latent_dim=2), movements())
    assert {"code of zoo.models.frames.pca", "code of zoo.guides.exact"} <= set(found)
    assert not any(name.startswith(("code of torch", "code of dataclasses")) for name in found)


def test_names_that_are_taken_or_ill_formed_are_refused() -> None:
    kind = cell()["Level"]
    with pytest.raises(ValueError, match="'pca' is registered already: take another"):
        zoo.register(entry_of(kind, name="pca"), replace=True)
    zoo.register(entry_of(kind))
    with pytest.raises(ValueError, match="replace=True takes this one"):
        zoo.register(entry_of(kind))
    zoo.register(entry_of(kind, summary="anew"), replace=True)
    assert CATALOGUE["level"].summary == "anew"
    with pytest.raises(TypeError, match=r"a zoo.Entry is needed; got dict"):
        zoo.register({"name": "level"})  # type: ignore[arg-type]
    for name in ("", "Level", "a b", "a+b", "a,b", "-a", "a--b", "ä", 5):
        with pytest.raises(ValueError, match="name must be small letters"):
            entry_of(kind, name=name)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"model": "nowhere"}, ValueError, "model must be a class or 'module:Class'"),
        ({"model": None}, ValueError, "model must be a class"),
        ({"guide": 5}, ValueError, "guide must be a class"),
        ({"inference": "exact"}, TypeError, "inference must be zoo.Svi"),
        ({"data": "images"}, ValueError, "data is one of sequences, pairs"),
        ({"scaling": "log"}, ValueError, "scaling is one of standard"),
    ],
)
def test_entries_say_what_is_wrong(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        entry_of(int, **change)


def test_classes_say_what_they_lack() -> None:
    with pytest.raises(ValueError, match="answers no task"):
        zoo.register(entry_of(int))
    with pytest.raises(ModuleNotFoundError, match=r"no module zoo.models.nowhere"):
        zoo.register(replace(CATALOGUE["mean"], name="lost", model="zoo.models.nowhere:Mean"))
    with pytest.raises(ValueError, match=r"zoo.models.baselines.mean defines no class Gone"):
        zoo.register(
            replace(CATALOGUE["mean"], name="lost", model="zoo.models.baselines.mean:Gone")
        )
    kind = cell()["Level"]
    zoo.register(entry_of(kind))
    with pytest.raises(ValueError, match="level names no data set of its own: give one"):
        zoo.faces.commands.Recipe.parse("level", None, [], None, ".6,.1,.15,.15", 0, "none", "cpu")
    del kind.dtype
    with pytest.raises(TypeError, match="Level needs a class attribute dtype"):
        zoo.create("level", movements())
    kind.config_class = dict
    with pytest.raises(TypeError, match="config_class of Level must be a dataclass"):
        zoo.create("level", movements())


ENTRY = """
import zoo
ENTRY = zoo.Entry(
    name="{name}", summary="from another package", model="{model}", guide=None,
    inference=zoo.Exact(), data="sequences",
)
"""


def package(home: Path, name: str, text: str, *, value: str = "") -> None:
    """An installed package that names an entry point."""
    (home / name).mkdir()
    (home / name / "__init__.py").touch()
    (home / name / "entry.py").write_text(text)
    base = "from . import base\nfrom zoo.models.baselines import mean\n"
    (home / name / "model.py").write_text(
        f"{base}from .base import Base\nclass Mine(Base): pass\nclass Own(mean.Mean): pass\n"
    )
    (home / name / "base.py").write_text(
        "from zoo.models.baselines.mean import Mean\n"
        "class Base(Mean):\n    def generate(self): ...\n"
    )
    info = home / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    points = f"[movezoo.models]\n{name} = {value or f'{name}.entry:ENTRY'}\n"
    (info / "entry_points.txt").write_text(points)


def asked(home: Path, code: str) -> subprocess.CompletedProcess[str]:
    """What another process with these packages says."""
    path = os.pathsep.join([str(home), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": path},
    )


def test_an_installed_package_joins_and_a_broken_one_is_named(tmp_path: Path) -> None:
    package(tmp_path, "whole", ENTRY.format(name="whole", model="whole.model:Mine"))
    package(tmp_path, "taken", ENTRY.format(name="pca", model="taken.model:Mine"))
    package(tmp_path, "raises", "raise SystemExit('no')\n")
    package(tmp_path, "lost", ENTRY.format(name="lost", model="lost.nowhere:Mine"))
    package(tmp_path, "odd", "ENTRY = [5]\n")
    package(tmp_path, "absent", "", value="absent.entry:NOTHING")
    package(tmp_path, "also", ENTRY.format(name="also", model="also.model:Own"))
    done = asked(
        tmp_path,
        """
        import sys
        from zoo.faces.cli import main
        assert main(["list", "--json"]) == 0
        assert "torch" not in sys.modules
        """,
    )
    rows = {row["name"]: row for row in json.loads(done.stdout)}
    assert set(rows["whole"]["can"]) == {"reconstruct", "forecast", "impute", "generate"}
    assert set(rows["also"]["can"]) == {"reconstruct", "forecast", "impute"}
    assert "lost" not in rows and rows["pca"]["summary"].startswith("Probabilistic")
    told = done.stderr.splitlines()
    assert len(told) == 5
    for name, reason in {
        "taken": "'pca' is registered already",
        "raises": "SystemExit: no",
        "lost": "no module lost.nowhere",
        "odd": "a zoo.Entry is needed; got int",
        "absent": "NOTHING",
    }.items():
        (line,) = (t for t in told if f"{name} of {name}" in t)
        assert reason in line and "does not join the zoo" in line


def test_a_model_of_an_installed_package_trains_in_every_process(tmp_path: Path) -> None:
    package(tmp_path, "whole", ENTRY.format(name="whole", model="whole.model:Mine"))
    done = asked(
        tmp_path,
        """
        import numpy as np, tempfile, zoo
        from pathlib import Path
        from zoo.studies.leaderboard import own_protocol, run_leaderboard
        if __name__ == "__main__":
            data = zoo.Sequences.from_arrays(
                np.random.default_rng(0).normal(size=(6, 20, 3)), rate=30.0
            )
            asked = own_protocol(data, seen=12, horizon=8)
            with tempfile.TemporaryDirectory() as home:
                home = Path(home)
                run_leaderboard(asked, home, models=["whole"], folds=3, root=home, jobs=2)
                zoo.fit(zoo.create("whole", data), data, run_dir=home / "run")
                print(sorted(k for k in zoo.load(home / "run").made_of if "whole" in k))
        """,
    )
    parts = ("whole", "whole.base", "whole.model")
    assert done.stdout.strip() == str([f"code of {part}" for part in parts])


def test_plugins_are_sought_once_and_only_when_asked_for() -> None:
    calls: list[Registry] = []
    registry = Registry([CATALOGUE["pca"]], discover=calls.append)
    assert registry["pca"].name == "pca" and calls == []
    assert registry.names() == ["pca"] == registry.names() and calls == [registry]
    assert registry.joined == ()
    assert issubclass(BrokenPluginWarning, UserWarning)


def test_methods_of_bases_are_found() -> None:
    found = methods("zoo.models.processes.sparse_gp:SparseGaussianProcess")
    assert {"regress", "condition", "objective", "settle"} <= found
