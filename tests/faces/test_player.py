"""The player: everything in one page, what was given is what moves, mistakes are named."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import zoo
from zoo.datasets.bodies import Arm, Human, body_for
from zoo.datasets.robot_arm import end_effector
from zoo.datasets.skeleton import Bone, Skeleton
from zoo.evaluation.figures.postures import posture_map, posture_strip, posture_strips
from zoo.faces.cli import main
from zoo.faces.play import Player, Track, play
from zoo.faces.screening import screen_run

BROWSER = shutil.which("chromium")
BODY = Human(
    Skeleton(
        name="toy",
        bones=(
            Bone(name="root", parent=None, dof=("rx",)),
            Bone(name="lleg", parent="root", direction=(0.0, -1.0, 0.0), length=1.0, dof=("rx",)),
            Bone(name="rleg", parent="root", direction=(0.0, -1.0, 0.0), length=1.0, dof=("rx",)),
        ),
    )
)


@pytest.fixture(scope="module")
def arm() -> zoo.Sequences:
    """Reaches of the robot arm."""
    return zoo.load_data("robot-arm")


@pytest.fixture(scope="module")
def run(arm: zoo.Sequences) -> zoo.Run:
    """A model that reconstructs, forecasts and generates."""
    return zoo.fit(zoo.create("promp", arm), arm)


def told(page: str) -> dict:
    """The data that a page embeds."""
    found = re.search(r'type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_page_moves_what_it_was_given(arm: zoo.Sequences) -> None:
    """Last joint of the embedded data is the tool by forward kinematics, to half a millimetre."""
    data = told(play(arm, item=2).page())
    flat = torch.tensor(data["tracks"][0]["mean"], dtype=torch.float64)
    tool = flat.view(76, data["joints"], 3)[:, -1]
    x, y, z = end_effector(arm.values[2].double()).unbind(-1)
    torch.testing.assert_close(tool, torch.stack([x, z, -y], -1), atol=6e-4, rtol=0)
    assert data["rate"] == arm.rate
    assert len(data["edges"]) == len(data["sides"]) == 6


def test_a_run_is_screened_with_its_spread_and_its_switch(run: zoo.Run, arm: zoo.Sequences) -> None:
    """Forecasts begin where they begin, with joint draws; the switch is marked."""
    data = told(screen_run(run, arm, item=1, seen=10, onto=3).page())
    tracks = {t["name"]: t for t in data["tracks"]}
    assert list(tracks) == ["data", "reconstruction", "forecast", "switched to", "switch"]
    assert tracks["forecast"]["start"] == 10
    assert len(tracks["forecast"]["mean"]) == 66 * 7 * 3
    assert len(tracks["forecast"]["draws"]) == 12
    assert tracks["data"]["draws"] == []
    assert [10, "forecast begins"] in data["marks"]
    assert [38, "switch ends"] in data["marks"]


def test_the_page_asks_nothing_of_the_network_and_cannot_be_broken_out_of(
    arm: zoo.Sequences,
) -> None:
    """No address, no foreign script; a hostile name stays text in page and notebook."""
    nasty = "</script><script>alert(1)</script>"
    player = play(arm, names=[nasty], title=nasty)
    page = player.page()
    assert not re.search(r"https?://|@import|src\s*=\s*['\"]", page)
    assert nasty not in page
    assert told(page)["tracks"][0]["name"] == nasty
    inside = re.search(r'srcdoc="(.*)"></iframe>', player._repr_html_(), re.DOTALL)
    assert inside is not None
    assert html.unescape(inside[1]) == page


def test_mistakes_are_named(arm: zoo.Sequences, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies, items, unlike channels, holes."""
    with pytest.raises(ValueError, match="between 0 and 4"):
        play(arm, item=5)
    with pytest.raises(ValueError, match="at least 1"):
        play()
    other = replace(arm, channels=tuple("abcdef"))
    with pytest.raises(ValueError, match="same channels"):
        play(arm, other)
    with pytest.raises(ValueError, match="at least 1 movement"):
        Player(body=Arm(), tracks=())
    holed = Track(name="holed", mean=torch.full((2, 7, 3), torch.nan))
    with pytest.raises(ValueError, match="not finite"):
        Player(body=Arm(), tracks=(holed,)).page()
    monkeypatch.setattr("zoo.datasets.bodies.load_skeleton", lambda subject: BODY.skeleton)
    for foreign in ("angle", "elbow_rx"):
        with pytest.raises(ValueError, match=f"'{foreign}' moves no body"):
            body_for(["lleg_rx", foreign])


def test_limbs_have_sides() -> None:
    """By the names of bones, so that left and right can be told apart."""
    assert BODY.sides == ("left", "right")
    quarter = BODY.place(torch.tensor([[torch.pi / 2]]), ["lleg_rx"])
    torch.testing.assert_close(quarter[0, 1].abs(), torch.tensor([0.0, 0.0, 1.0]).double())


def test_postures_are_drawn_where_they_belong() -> None:
    """As many bodies as frames and points, rows to one scale; a map keeps each in its cell."""
    from matplotlib.figure import Figure

    strip, plane = Figure().subplots(2)
    names = ["lleg_rx", "rleg_rx"]
    posture_strip(strip, torch.randn(13, 2), names, body=BODY, every=6)
    assert len(strip.lines) == 3 * 2
    one, other = Figure().subplots(2)
    posture_strips(
        [one, other], {"a": torch.zeros(13, 2), "b": torch.randn(13, 2)}, names, body=BODY
    )
    assert one.get_xlim() == other.get_xlim()
    assert one.get_ylim() == other.get_ylim()
    assert (one.get_xticks() == other.get_xticks()).all()
    assert [one.get_title("left"), other.get_title("left")] == ["a", "b"]
    posture_map(plane, torch.randn(2, 3, 2), names, [0.0, 1.0, 2.0], [0.0, 5.0], body=BODY)
    assert len(plane.lines) == 2 * 3 * 2
    assert plane.get_aspect() == 1 / 5  # cells are square on paper, so that bodies keep their shape
    for k, line in enumerate(plane.lines):
        column, row = (k // 2) % 3, (k // 2) // 3
        assert abs(line.get_xdata() - column).max() < 0.5
        assert abs(line.get_ydata() - 5 * row).max() < 2.5


def test_the_command_writes_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], run: zoo.Run
) -> None:
    """Data by name, a run by its folder; a movement that is not there is one line."""
    assert main(["play", "robot-arm", "--output", str(tmp_path / "arm.html")]) == 0
    assert "76 frames" in capsys.readouterr().out
    folder = run.save(tmp_path / "run")
    page = tmp_path / "run.html"
    command = ["play", str(folder), "--data", "robot-arm", "--onto", "2", "--output", str(page)]
    assert main(command) == 0
    assert "switch" in capsys.readouterr().out
    refused = {
        "robot-arm --movement 9": "between 0 and 4",
        "robot-arm --onto 2": "onto needs a trained model, and robot-arm is a data set",
        "runs/none": "runs/none is no folder with a run, and no data set",
        "pendulum": "moves no body known here",
    }
    for words, reason in refused.items():
        assert main(["play", *words.split(), "--output", str(page)]) == 2
        assert reason in capsys.readouterr().err


@pytest.mark.skipif(BROWSER is None, reason="no chromium to open the page with")
def test_a_browser_plays_it(tmp_path: Path, run: zoo.Run, arm: zoo.Sequences) -> None:
    """Bodies are on the stage, move with the time line, and the script runs without error."""
    page = screen_run(run, arm, seen=10).save(tmp_path / "arm.html")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    options += ["--virtual-time-budget=1500", f"--user-data-dir={tmp_path / 'browser'}"]

    def browse(*extra: str) -> subprocess.CompletedProcess[str]:
        command = [str(BROWSER), *options, *extra]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)

    def stage(address: str) -> NDArray[np.float32]:
        shot = tmp_path / "shot.png"
        done = browse(f"--screenshot={shot}", "--window-size=1000,640", address)
        assert "CONSOLE" not in done.stderr
        return matplotlib.image.imread(shot)[50:400, 20:-20, :3]

    begin, later = page.as_uri(), f"{page.as_uri()}#frame=60"
    assert 'data-frame="0"' in browse("--dump-dom", begin).stdout
    assert 'data-frame="60"' in browse("--dump-dom", later).stdout
    assert ">Pause</button>" in browse("--dump-dom", f"{begin}#play").stdout
    first, second = stage(begin), stage(later)
    assert (abs(first - first[0, 0]).max(-1) > 0.2).mean() > 2e-3
    assert (abs(first - second).max(-1) > 0.2).mean() > 1e-3
