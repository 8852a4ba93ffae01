"""The command line as a user meets it: words in, tables or JSON out, exit codes that mean it."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest

from zoo.catalogue import CATALOGUE
from zoo.cli import main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a quick model that the command line wrote."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    words = ["fit", "dmp", "--data", "robot-arm/reaching", "--run-dir", str(folder), "--json"]
    assert main(words) == 0
    return folder


def test_list_needs_no_torch() -> None:
    code = "import sys; from zoo.cli import main; main(['list']); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("False")
    assert all(name in done.stdout for name in CATALOGUE.names())


def test_list_filters_by_capability(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "*dmp*", "--can", "forecast", "--json"]) == 0
    names = [row["name"] for row in json.loads(capsys.readouterr().out)]
    assert "vae-dmp" in names and "gp" not in names


def test_readme_table_is_the_catalogue(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--markdown"]) == 0
    assert capsys.readouterr().out.strip() in (ROOT / "README.md").read_text(encoding="utf-8")


def test_card_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["card", "vae-dmp"]) == 0
    text = capsys.readouterr().out
    assert "latent_dim" in text and "§6.2" in text


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["card", "vae-dpm"], 2, "did you mean vae-dmp"),
        (["data", "robot-amr"], 2, "robot-arm"),
        (["fit", "dmp", "--run-dir", "x", "--set", "kernels"], 2, "KEY=VALUE"),
        (["fit", "dmp", "--run-dir", "x", "--parts", "1,2"], 2, "four shares"),
        (["fit", "dmp", "--run-dir", "x", "--calibrate", "magic"], 2, "conformal"),
        (["evaluate", "nowhere"], 1, "not a movezoo run"),
        (["experiment", "E9.9"], 2, "E6.1"),
        (["list", "--can", "fly"], 2, "forecast"),
        (["nonsense"], 2, "nonsense"),
    ],
)
def test_mistakes_are_one_line_with_a_code(
    words: list[str],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == code
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_data_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "robot-arm", "--json"]) == 0
    description = json.loads(capsys.readouterr().out)
    assert description["movements"] == 5 and description["provenance"] == "simulated"


def test_evaluate_prints_scores(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(run_folder), "--task", "forecast", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert "forecast" in json.dumps(table)


def test_forecast_writes_bands(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, figure = tmp_path / "bands.csv", tmp_path / "bands.png"
    words = ["forecast", str(run_folder), "--seen", "10", "--horizon", "20"]
    assert main([*words, "--output", str(output), "--figure", str(figure)]) == 0
    with open(output, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {int(r["frame"]) for r in rows} == set(range(10, 30))
    assert all(float(r["low_90"]) <= float(r["mean"]) <= float(r["high_90"]) for r in rows)
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert "90 % band" in capsys.readouterr().out
