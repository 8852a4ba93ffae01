"""The command line as a user meets it: words in, tables or JSON out, exit codes that mean it."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from support import pairs

import zoo
from zoo.catalogue import CATALOGUE
from zoo.faces.cli import main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a quick model that the command line wrote."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    words = ["fit", "dmp", "--data", "robot-arm/reaching", "--run-dir", str(folder), "--json"]
    assert main(words) == 0
    return folder


def test_list_needs_no_torch() -> None:
    code = (
        "import sys; from zoo.faces.cli import main; main(['list']); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("False")
    assert all(name in done.stdout for name in CATALOGUE.names())


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"movezoo {zoo.__version__}"


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
        (["leaderboard", "walk-setup-3"], 2, "walk-setup-1-published"),
        (["leaderboard", "arm-goals", "--folds", "2"], 2, "folds must be between 3"),
        (["leaderboard", "arm-goals", "--seen", "5"], 2, "need --data"),
        (["leaderboard", "--data", "robot-arm", "--seen", "5", "--horizon", "99"], 2, "trial"),
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


def test_a_leaderboard_on_own_movements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By name, question and group column; the command is kept; protocols say which they are."""
    monkeypatch.chdir(tmp_path)
    question = "--data robot-arm/reaching --seen 10 --horizon 8 --by operator"
    words = ["leaderboard", *question.split(), "--models", "mean", "--folds", "3", "--json"]
    assert main(words) == 0
    stored = json.loads(Path("results/leaderboard_robot-arm-reaching-10-8.json").read_text())
    assert stored["command"] == f"zoo leaderboard {question} --models mean --folds 3"
    assert stored["source"] == "own" and len(stored["details"]["groups"]) == 12
    coverage = stored["details"]["coverage_90"]["mean"]["calibrated"]
    assert np.shape(coverage["by group and channel"]) == (12, len(stored["details"]["channels"]))
    assert np.shape(coverage["by group and block"]) == (12, len(stored["details"]["blocks"]))
    assert stored["details"]["blocks"][-1][1] == 18


def test_protocols_say_which_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """Published ones that each movement is centred, the others that nothing hidden is used."""
    assert main(["leaderboard", "--json"]) == 0
    for name, summary in json.loads(capsys.readouterr().out).items():
        assert ("published protocol: " in summary) == name.endswith("-published")


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


def test_forecast_writes_labelled_arrays(run_folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "bands.nc"
    words = ["forecast", str(run_folder), "--seen", "10", "--horizon", "20", "--json"]
    assert main([*words, "--output", str(output)]) == 0
    with xarray.open_dataset(output, engine="h5netcdf") as bands:
        assert dict(bands.sizes)["time"] == 20
        assert bool((bands.lower <= bands.upper).all())
        assert set(bands.unit.values.tolist()) == {"rad"}


def test_a_forecast_may_go_beyond_what_is_known(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["forecast", str(run_folder), "--seen", "70", "--horizon", "10", "--json"]
    assert main([*words, "--figure", str(tmp_path / "bands.png")]) == 0
    assert {r["frame"] for r in json.loads(capsys.readouterr().out)} == set(range(70, 80))
    assert main(["forecast", str(run_folder), "--seen", "0"]) == 2
    assert "seen must be at least 1; got 0" in capsys.readouterr().err


def test_a_folder_is_not_overwritten_by_accident(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {f.name: f.read_bytes() for f in run_folder.iterdir()}
    words = ["fit", "dmp", "--data", "robot-arm/reaching", "--run-dir", str(run_folder)]
    assert main(words) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*words, "--resume", "--set", "kernels=7"]) == 2
    assert "kernels of the model was 20 and is 7 now" in capsys.readouterr().err
    assert main(["fit", "mean", *words[2:], "--resume"]) == 2
    assert "entry was dmp and is mean now" in capsys.readouterr().err
    assert main([*words, "--resume", "--overwrite"]) == 2
    assert {f.name: f.read_bytes() for f in run_folder.iterdir()} == before


def test_overwriting_and_resuming_are_said_aloud(tmp_path: Path) -> None:
    words = ["fit", "mean", "--data", "robot-arm", "--run-dir", str(tmp_path), "--json"]
    assert main([*words, "--calibrate", "none"]) == 0
    assert main([*words, "--calibrate", "none", "--resume"]) == 0
    other = ["fit", "last-value", *words[2:], "--calibrate", "none", "--overwrite"]
    assert main(other) == 0
    assert zoo.load(tmp_path).name == "last-value"


@pytest.mark.filterwarnings("default::UserWarning")
def test_too_few_movements_to_calibrate_on_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", "mean", "--data", "robot-arm", "--run-dir", str(tmp_path)]) == 0
    error = capsys.readouterr().err
    assert "zoo: warning: the calibration part holds 1 movement" in error and ".py" not in error
    assert not zoo.load(tmp_path).calibration


def test_settings_are_numbers_lists_and_words(tmp_path: Path) -> None:
    words = ["fit", "vae", "--data", "robot-arm", "--run-dir", str(tmp_path), "--json"]
    sets = ["epochs=1", "hidden=8,4", "clip=none", "noise=shared", "learning_rate=1e-3"]
    assert main([*words, "--calibrate", "none", *(w for s in sets for w in ("--set", s))]) == 0
    assembly = zoo.load(tmp_path).assembly
    assert assembly.model.config.hidden == (8, 4) and assembly.model.config.noise == "shared"
    assert assembly.inference.clip is None and assembly.inference.learning_rate == 1e-3


@pytest.mark.filterwarnings("default::zoo.errors.NoiseDivergenceWarning")
def test_fitc_prints_both_noise_levels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zoo.faces.commands.load_data", lambda name: pairs())
    words = ["fit", "fitc", "--data", "tiny", "--run-dir", str(tmp_path), "--set", "inducing=20"]
    words += ["--calibrate", "none"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "noise std " in out and "noise std vfe" in out and "learned by fitc" in out
    assert main([*words, "--resume", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["report"]
    assert report == zoo.load(tmp_path).report()


def test_a_report_is_in_the_units_of_the_data() -> None:
    data = pairs()
    run = zoo.fit(zoo.create("gp", data, iterations=20), data)
    louder = replace(data, targets=10 * data.targets)
    again = zoo.fit(zoo.create("gp", louder, iterations=20), louder)
    ratio = np.array(again.report()["noise_std"]) / np.array(run.report()["noise_std"])
    np.testing.assert_allclose(ratio, 10.0, rtol=1e-6)
    lengths = [np.array(r.report()["length_scale"]) for r in (run, again)]
    np.testing.assert_allclose(*lengths)
    assert zoo.fit(zoo.create("mean-regressor", data), data).report() == {}


def test_an_interrupted_fit_says_so_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [sys.executable, "-c", "import sys; from zoo.faces.cli import main; sys.exit(main())"]
    words += ["fit", "vae", "--data", "robot-arm", "--run-dir", str(tmp_path), "--json"]
    words += ["--calibrate", "none", "--set", "epochs=20000", "--set", "checkpoint_every=1"]
    words += ["--set", "patience=none"]
    handler = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    words[2] = f"{handler}; {words[2]}"
    training = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    _wait_for(tmp_path / "checkpoint.json", training)
    training.send_signal(signal.SIGINT)
    _, error = training.communicate(timeout=60)
    assert training.returncode == 130
    assert "interrupted in epoch" in error and "--resume" in error and "Traceback" not in error
    assert json.loads((tmp_path / "checkpoint.json").read_text())
    assert main(words[3:]) == 2
    assert "holds a begun training: resume='auto' (--resume) to go on" in capsys.readouterr().err
    assert main([*words[3:], "--resume", "--set", "epochs=20001"]) == 2
    assert "epochs of the training was 20000 and is 20001 now" in capsys.readouterr().err


def _wait_for(file: Path, training: subprocess.Popen[str]) -> None:
    for _ in range(600):
        if file.exists() or training.poll() is not None:
            return
        time.sleep(0.1)


def test_what_python_shows_of_things_is_a_line() -> None:
    data = zoo.load_data("robot-arm/reaching", movements=6)
    run = zoo.fit(zoo.create("dmp", data), data)
    prediction = run.forecast(data.first(10), horizon=4)
    for thing in (data, pairs(), run.assembly, run, prediction):
        text = repr(thing)
        assert len(text) < 250 and "tensor" not in text and "\n" not in text
    assert "6 movements of 76 frames at 25 Hz" in repr(data)
    assert "Prediction of forecast: sequence 6, time 4, channel 6; in rad" in repr(prediction)
