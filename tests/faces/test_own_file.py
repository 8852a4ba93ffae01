"""From a file of one's own to a forecast with bands: in one command, and in five lines."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import zoo
from zoo.faces.cli import main


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table of sixteen trials with times and units, in the working folder."""
    monkeypatch.chdir(tmp_path)
    rng, lines = np.random.default_rng(0), ["trial,time,hip [rad],knee [rad]"]
    for trial in range(16):
        hip, knee = rng.normal(1, 0.2, 2)
        for t in range(30):
            wave = np.sin(t / 29 * np.pi) + 0.01 * rng.normal(size=2)
            lines.append(f"{trial},{t / 30},{hip * wave[0]},{knee * wave[1]}")
    Path("walk.csv").write_text("\n".join(lines), encoding="utf-8")
    return Path("walk.csv")


@pytest.mark.filterwarnings("ignore::zoo.errors.FewGroupsWarning")
def test_one_command(walk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit", "promp", "--data", "walk.csv", "--run-dir", "own", "--output", "bands.csv"]
    assert main(words) == 0, capsys.readouterr().err
    with open("bands.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {r["channel"] for r in rows} == {"hip", "knee"} and {r["unit"] for r in rows} == {"rad"}
    assert all(float(r["low_90"]) < float(r["high_90"]) for r in rows)
    assert main(["evaluate", "own"]) == 0
    assert main(["evaluate", "own", "--data", "walk.xyz"]) == 2
    assert "no data set 'walk.xyz'" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::zoo.errors.FewGroupsWarning")
def test_five_lines_whose_run_the_command_line_takes(
    walk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = zoo.load_data("walk.csv")
    train, _, calib, test = data.split(by="trial", parts=(0.6, 0.1, 0.15, 0.15), seed=0)
    run = zoo.fit(zoo.create("promp", train), train, run_dir="own").calibrate(calib)
    low, high = run.forecast(test.first(10), horizon=20).interval(0.9)
    assert bool((low < high).all())
    run.save("own")
    assert main(["evaluate", "own"]) == 0, capsys.readouterr().err
