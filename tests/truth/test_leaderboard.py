"""Leaderboards: tests by hand, resumed tables, failures told, and boards on one's own data."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from support import movements, pairs

from zoo.datasets.records import Sequences
from zoo.errors import UnknownNameError
from zoo.studies.leaderboard import board, cells, own, own_protocol, statistics
from zoo.studies.leaderboard.cells import Cell
from zoo.studies.leaderboard.protocol import Fold, Protocol
from zoo.studies.result import Result

TINY = Protocol(
    name="tiny",
    summary="tiny",
    load=movements,
    source="simulated",
    need="forecast",
    models=("mean", "last-value", "nearest-neighbour"),
    seen=12,
    horizon=12,
)
NOTHING = Fold(train=(2, 3, 4), calibration=(), judged=(0,))


def test_intervals_and_adjusted_tests_are_those_of_the_textbook() -> None:
    """Student's interval against scipy; Wilcoxon's exact p by all sign changes; Holm by hand."""
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(size=8), rng.normal(0.7, size=8)
    low, high = stats.t.interval(0.95, 7, ours.mean(), stats.sem(ours))
    found = statistics.interval(ours)
    assert found.mean - found.half == pytest.approx(low)
    assert found.mean + found.half == pytest.approx(high)
    ranks = stats.rankdata(np.abs(ours - theirs))
    signs = np.array(np.meshgrid(*[(0, 1)] * 8)).reshape(8, -1)
    sums = ranks @ signs
    observed = ranks[ours > theirs].sum()
    extreme = min(observed, ranks.sum() - observed)
    p = np.mean((sums <= extreme) | (sums >= ranks.sum() - extreme))
    assert statistics.paired(ours, theirs) == pytest.approx(p)
    assert statistics.paired(ours, ours) == 1.0
    assert statistics.holm([0.04, 0.01, 0.5]) == pytest.approx([0.08, 0.03, 0.5])


def test_a_repeated_command_takes_what_was_found(tmp_path: Path) -> None:
    """Equal tables; nothing is computed twice; another seed or a damaged cell is."""
    told: list[str] = []

    def table(**options: Any) -> Result:
        where = {"root": tmp_path / "cells", "note": told.append}
        return board.run_leaderboard(TINY, tmp_path / "out", **where, **options)

    first = table()
    stamps = {f: f.stat().st_mtime_ns for f in (tmp_path / "cells").rglob("cell.json")}
    assert len(stamps) == 3 * 4 == len(told)
    again = table()
    assert {f: f.stat().st_mtime_ns for f in stamps} == stamps
    assert first.rows == again.rows
    stored = json.loads((tmp_path / "out" / "leaderboard_tiny.json").read_text())
    assert stored["details"]["scores"]["mean"]["mse"]
    assert stored["command"] == "zoo leaderboard tiny --folds 4"
    damaged = next(iter(stamps))
    damaged.write_text("{}")
    assert [row[:-1] for row in table().rows] == [row[:-1] for row in first.rows]
    assert damaged.stat().st_mtime_ns != stamps[damaged]
    table(seeds=2)
    assert len(list((tmp_path / "cells").rglob("cell.json"))) == 2 * len(stamps)


def test_cells_are_kept_by_data_and_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Same name, other values: all anew. Other code of the question: answers alone are anew."""
    asked = cell("mean", NOTHING)
    first, again = (cells.compute(asked, tmp_path, TINY) for _ in range(2))
    assert (first.reused, again.reused) == ("", "answer") and again.seconds == first.seconds
    louder = replace(movements(), values=2 * movements().values)
    other = cells.compute(asked, tmp_path, replace(TINY, load=lambda: louder))
    assert first.prediction is not None and other.prediction is not None
    assert other.reused == "" and not torch.equal(other.prediction.mean, first.prediction.mean)
    monkeypatch.setattr(cells, "code", lambda roots: {"code of zoo.evaluation.tasks": "#other"})
    assert cells.compute(asked, tmp_path, TINY).reused == "training"
    monkeypatch.setattr(
        "zoo.runs.fingerprint.hashes", lambda roots: {"zoo.models.baselines.mean": "other"}
    )
    assert cells.compute(asked, tmp_path, TINY).reused == ""


def test_two_processes_find_what_one_finds(tmp_path: Path) -> None:
    """Cells of a protocol that was made in this process, computed apart."""
    asked = own_protocol(movements(), seen=12, horizon=12)
    some = [cell("promp", Fold(train=(4, 5, 6 + k), calibration=(), judged=(k,))) for k in (0, 1)]
    apart = cells.compute_all(some, tmp_path / "two", asked, 2, lambda found: None)
    alone = cells.compute_all(some, tmp_path / "one", asked, 1, lambda found: None)
    for two, one in zip(apart, alone, strict=True):
        assert two.prediction is not None and one.prediction is not None
        assert torch.equal(two.prediction.mean, one.prediction.mean)


def cell(model: str, fold: Fold) -> Cell:
    """A cell of an entry, or of several together, with their default settings."""
    settings = tuple(() for _ in model.split("+"))
    return Cell(protocol="tiny", model=model, settings=settings, seed=0, number=0, fold=fold)


ORPHANS = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from zoo.studies.leaderboard.cells import _begin
if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, get_context("spawn"), _begin, ((),))
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 60)
    time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc").exists(), reason="processes are looked up in /proc")
def test_processes_end_with_the_command_that_began_them(tmp_path: Path) -> None:
    """Killed without a word, it leaves nobody behind."""
    script = tmp_path / "script.py"
    script.write_text(ORPHANS)
    command = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert command.stdout is not None
    with command, command.stdout:
        worker = int(command.stdout.readline())
        command.kill()
        command.wait()
        deadline = time.monotonic() + 20
        while alive(worker) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not alive(worker)


def alive(process: int) -> bool:
    """Whether a process runs; one that only waits to be reaped does not."""
    status = Path(f"/proc/{process}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_an_entry_that_fails_is_a_line_and_not_the_end(tmp_path: Path) -> None:
    """Its error is told in the findings; the others are judged."""
    broken = replace(TINY, settings={"ar": {"order": 40}})
    found = board.run_leaderboard(broken, tmp_path, models=["mean", "ar"], root=tmp_path / "cells")
    assert [row[0] for row in found.rows] == ["mean"]
    assert any("ar failed" in line for line in found.findings)


def test_a_model_that_cannot_be_judged_is_a_line_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What scoring refuses, such as a standard deviation of 0, is that model's error."""

    def refused(*_: object) -> None:
        raise ValueError("12 known entries are predicted with a standard deviation of 0")

    monkeypatch.setattr(board, "judged", refused)
    with pytest.raises(ValueError, match="no model could answer tiny: ValueError: 12 known"):
        board.run_leaderboard(TINY, tmp_path, models=["mean"], root=tmp_path / "cells")


def test_errors_of_zero_are_drawn(tmp_path: Path) -> None:
    """Movements that stand still, forecast exactly."""
    still = Sequences.from_arrays(np.zeros((6, 24, 2)), rate=30.0, name="still")
    asked = own_protocol(still, seen=12, horizon=12)
    where: dict[str, Any] = {"models": ["mean"], "folds": 3, "root": tmp_path / "cells"}
    found = board.run_leaderboard(asked, tmp_path, **where)
    assert found.rows[0][1] == "0 ± 0"
    assert (tmp_path / "leaderboard_still-12-12.png").exists()


def test_few_folds_and_a_single_model_are_a_board(tmp_path: Path) -> None:
    """The least of everything: one model, three folds; two are refused with the reason."""
    some: dict[str, Any] = {"models": ["nearest-neighbour"], "root": tmp_path / "cells"}
    found = board.run_leaderboard(TINY, tmp_path, folds=3, **some)
    assert [row[0] for row in found.rows] == ["nearest-neighbour"]
    with pytest.raises(ValueError, match=r"folds must be between 3 .* and 8, .*; got 2"):
        board.run_leaderboard(TINY, tmp_path, folds=2, **some)


def test_one_calibrating_group_corrects_nothing_and_says_so(tmp_path: Path) -> None:
    """Eight folds of one movement each: raw bands only."""
    where: dict[str, Any] = {"models": ["mean"], "root": tmp_path / "cells"}
    found = board.run_leaderboard(TINY, tmp_path, folds=8, **where)
    assert "No band was calibrated" in " ".join(found.findings)
    assert found.sections[0].rows[0][2] == "" != found.sections[0].rows[0][1]


def test_an_ensemble_of_entries_is_one_model(tmp_path: Path) -> None:
    """Its predictions are the average of the members'."""
    names = ["mean", "last-value", "mean+last-value"]
    found = [cells.compute(cell(name, NOTHING), tmp_path, TINY).prediction for name in names]
    means = [p.mean for p in found if p is not None]
    torch.testing.assert_close(means[2], (means[0] + means[1]) / 2)


def test_own_movements_make_a_board(tmp_path: Path) -> None:
    """Forecast or imputed, in their own groups; the table says that nothing hidden is used."""
    where: dict[str, Any] = {"models": ["mean", "kernel-ridge"], "root": tmp_path / "cells"}
    forecast = own_protocol(movements(), seen=10, horizon=8)
    imputed = own_protocol(movements(), hidden=["joint_2", "joint_5"])
    for asked in (forecast, imputed):
        found = board.run_leaderboard(asked, tmp_path, **where)
        assert len(found.rows) == 2
        assert "nothing of what is hidden is used" in found.title
        assert found.source == "own"
    assert found.details["channels"] == ["joint_2", "joint_5"]
    assert (tmp_path / "leaderboard_tiny-without-joint_2-joint_5.json").exists()


def test_what_own_movements_cannot_be_asked_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too many frames, unknown or all channels, no such group, both questions at once."""
    data = movements()
    with pytest.raises(ValueError, match=r"at most 24, .*'tiny'; got 20 and 8"):
        own_protocol(data, seen=20, horizon=8)
    with pytest.raises(UnknownNameError, match="no channel or joint 'knee' to hide"):
        own_protocol(data, hidden=["knee"])
    with pytest.raises(ValueError, match="hidden names all 7 channels"):
        own_protocol(data, hidden=["joint"])
    with pytest.raises(ValueError, match="no group column 'day'; there are trial, subject"):
        own_protocol(data, seen=10, horizon=8, by="day")
    with pytest.raises(ValueError, match="got both"):
        own_protocol(data, seen=10, horizon=8, hidden=["joint_1"])
    with pytest.raises(ValueError, match="need --data"):
        own.asked_for("arm-goals", None, 10, 0, "", "trial")
    monkeypatch.setattr(own, "load_data", lambda name: pairs())
    with pytest.raises(TypeError, match="forces holds Pairs"):
        own.asked_for(None, "forces", 10, 5, "", "trial")


def test_unknown_protocols_and_models_are_named(tmp_path: Path) -> None:
    """What there is, in the error."""
    with pytest.raises(UnknownNameError, match="walk-setup-2-published"):
        board.run_leaderboard("walk", tmp_path)
    with pytest.raises(UnknownNameError, match="that can forecast"):
        board.run_leaderboard("arm-goals", tmp_path, models=["pca"])
