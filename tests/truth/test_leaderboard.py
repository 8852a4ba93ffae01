"""Leaderboards: paired tests by hand, bands that never see their own group, resumed tables."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from support import movements

from zoo.datasets.records import Sequences
from zoo.errors import UnknownNameError
from zoo.leaderboard import board, cells, judge, protocols
from zoo.leaderboard.cells import Cell
from zoo.leaderboard.protocols import Protocol
from zoo.prediction import Prediction, Predictive

TINY = Protocol(
    summary="tiny",
    load=movements,
    source="simulated",
    need="forecast",
    models=("mean", "last-value", "nearest-neighbour"),
    seen=12,
)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Protocol:
    """A protocol of eight small movements, known by name."""
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", TINY)
    return TINY


def test_intervals_and_adjusted_tests_are_those_of_the_textbook() -> None:
    """Student's interval against scipy; Wilcoxon's exact p by all sign changes; Holm by hand."""
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(size=8), rng.normal(0.7, size=8)
    low, high = stats.t.interval(0.95, 7, ours.mean(), stats.sem(ours))
    found = judge.interval(ours)
    assert found.mean - found.half == pytest.approx(low)
    assert found.mean + found.half == pytest.approx(high)
    ranks = stats.rankdata(np.abs(ours - theirs))
    signs = np.array(np.meshgrid(*[(0, 1)] * 8)).reshape(8, -1)
    sums = ranks @ signs
    observed = ranks[ours > theirs].sum()
    extreme = min(observed, ranks.sum() - observed)
    p = np.mean((sums <= extreme) | (sums >= ranks.sum() - extreme))
    assert judge.paired(ours, theirs) == pytest.approx(p)
    assert judge.paired(ours, ours) == 1.0
    assert judge.holm([0.04, 0.01, 0.5]) == pytest.approx([0.08, 0.03, 0.5])


def test_a_band_is_never_calibrated_on_the_group_it_is_judged_by() -> None:
    """One group's errors blown up a thousandfold leave its own calibrated width untouched."""
    truth = torch.randn(10, 6, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prediction = Prediction(
        predictive=Predictive(location=torch.zeros(1, 10, 6, 2).double(), noise=torch.ones(2)),
        axes=("sequence", "time", "channel"),
        names=("a", "b"),
        units=("rad", "rad"),
        task="forecast",
    )
    wild = truth.clone()
    wild[3] *= 1000
    rows, groups = list(range(10)), list("abcdefghij")
    widths = [
        judge.judged([(rows, prediction)], t, torch.ones_like(t).bool(), groups)[
            "calibrated_width_90"
        ]
        for t in (truth, wild)
    ]
    assert widths[0][3] == pytest.approx(widths[1][3])
    assert (widths[1][[0, 1, 2, 4, 5]] > widths[0][[0, 1, 2, 4, 5]]).any()


def test_no_model_sees_the_movements_it_is_asked_about(tiny: Protocol) -> None:
    """Folds part the rows; groups stay together; impossible numbers of folds are named."""
    data = movements()
    for count in (None, 2, 3, 8):
        folds = tiny.folds(data, count)
        assert sorted(row for rows in folds for row in rows) == list(range(8))
    subjects = replace(tiny, by="subject").folds(data, None)
    assert subjects == [[0, 1, 2, 3], [4, 5, 6, 7]]
    with pytest.raises(ValueError, match="between 2 and 8"):
        tiny.folds(data, 9)


def test_a_repeated_command_takes_what_was_found(tiny: Protocol, tmp_path: Path) -> None:
    """Equal tables; nothing is computed twice; another seed or a damaged cell is."""
    told: list[str] = []

    def table(**options: object) -> Sequences | object:
        where = {"root": tmp_path / "cells", "note": told.append}
        return board.run_leaderboard("tiny", tmp_path / "out", **where, **options)

    first = table()
    stamps = {f: f.stat().st_mtime_ns for f in (tmp_path / "cells").rglob("cell.json")}
    assert len(stamps) == 3 * 8 == len(told)
    again = table()
    assert {f: f.stat().st_mtime_ns for f in stamps} == stamps
    assert first.rows == again.rows
    stored = json.loads((tmp_path / "out" / "leaderboard_tiny.json").read_text())
    assert stored["details"]["scores"]["mean"]["mse"]
    damaged = next(iter(stamps))
    damaged.write_text("{}")
    assert [row[:-1] for row in table().rows] == [row[:-1] for row in first.rows]
    assert damaged.stat().st_mtime_ns != stamps[damaged]
    table(seeds=2)
    assert len(list((tmp_path / "cells").rglob("cell.json"))) == 2 * len(stamps)


def test_cells_are_kept_by_data_and_code(
    tiny: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same name, other values: all anew. Other code of the question: answers alone are anew."""
    cell = Cell(protocol="tiny", model="mean", settings=((),), seed=0, fold=0, rows=(0,))
    first = cells.compute(cell, tmp_path, tiny)
    again = cells.compute(cell, tmp_path, tiny)
    assert (first.reused, again.reused) == ("", "answer") and again.seconds == first.seconds
    louder = replace(movements(), values=2 * movements().values)
    other = cells.compute(cell, tmp_path, replace(tiny, load=lambda: louder))
    assert other.reused == "" and not torch.equal(other.prediction.mean, first.prediction.mean)
    monkeypatch.setattr(cells, "code", lambda roots: {"code of zoo.tasks": "#other"})
    assert cells.compute(cell, tmp_path, tiny).reused == "training"
    monkeypatch.setattr("zoo.fingerprint.hashes", lambda roots: {"zoo.models.mean": "other"})
    assert cells.compute(cell, tmp_path, tiny).reused == ""


def test_two_processes_find_what_one_finds(tmp_path: Path) -> None:
    """Cells of a protocol that every process knows, computed apart."""
    some = [
        Cell(protocol="arm-goals", model="promp", settings=((),), seed=0, fold=k, rows=(k,))
        for k in range(2)
    ]
    apart = cells.compute_all(some, tmp_path / "two", 2, lambda found: None)
    alone = cells.compute_all(some, tmp_path / "one", 1, lambda found: None)
    for two, one in zip(apart, alone, strict=True):
        assert two.prediction is not None and one.prediction is not None
        assert torch.equal(two.prediction.mean, one.prediction.mean)


ORPHANS = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from zoo.leaderboard.cells import _begin
if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, get_context("spawn"), _begin)
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


def test_an_entry_that_fails_is_a_line_and_not_the_end(
    tiny: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its error is told in the findings; the others are judged."""
    broken = replace(tiny, settings={"ar": {"order": 40}})
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", broken)
    found = board.run_leaderboard("tiny", tmp_path, models=["mean", "ar"], root=tmp_path / "cells")
    assert [row[0] for row in found.rows] == ["mean"]
    assert any("ar failed" in line for line in found.findings)


def test_an_ensemble_of_entries_is_one_model(tiny: Protocol, tmp_path: Path) -> None:
    """Its predictions are the average of the members'."""
    names = ["mean", "last-value", "mean+last-value"]
    found = {}
    for name in names:
        parts = tuple(() for _ in name.split("+"))
        cell = Cell(protocol="tiny", model=name, settings=parts, seed=0, fold=0, rows=(0, 1))
        found[name] = cells.compute(cell, tmp_path).prediction
    means = [p.mean for p in found.values() if p is not None]
    torch.testing.assert_close(means[2], (means[0] + means[1]) / 2)


def test_unknown_protocols_and_models_are_named(tmp_path: Path) -> None:
    """What there is, in the error."""
    with pytest.raises(UnknownNameError, match="walk-setup-2"):
        board.run_leaderboard("walk", tmp_path)
    with pytest.raises(UnknownNameError, match="that can forecast"):
        board.run_leaderboard("arm-goals", tmp_path, models=["pca"])
