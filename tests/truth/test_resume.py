"""One folder, one training: what determines a run is compared in words, and nothing is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from support import movements, pairs

import zoo
from zoo.catalogue import CATALOGUE
from zoo.datasets.records import Sequences
from zoo.errors import DamagedRunError, OtherTrainingError, RunExistsError, RunLockedError
from zoo.inference.resume.codehash import hashes
from zoo.runs.assembly import Assembly, assemble
from zoo.runs.training import Learned, learn
from zoo.studies.kept import timed
from zoo.studies.kept import trained as trained_once

ROOT = Path(__file__).resolve().parents[2]
TRAIN = movements()[:6]
QUICK: dict[str, Any] = {"epochs": 2, "latent_dim": 2, "batch_size": 16, "checkpoint_every": 1}


def vae(data: Any = TRAIN, *, seed: int = 0, entry: str = "vae", **settings: Any) -> Assembly:
    """A short training by stochastic variational inference."""
    return zoo.create(entry, data, seed=seed, **{**QUICK, **settings})


def bits(run: zoo.Run) -> list[bytes]:
    """All that a training made."""
    modules = [m for m in (run.model, run.assembly.guide) if m is not None]
    return [v.numpy().tobytes() for m in modules for v in m.state_dict().values()]


def shifted(**changes: Any) -> Sequences:
    """The training data with something else about them."""
    return replace(TRAIN, **changes)


HOLED = TRAIN.mask.clone()
HOLED[0, 3, 1] = False
CHANGES: dict[str, tuple[Callable[[], tuple[Assembly, Any]], str]] = {
    "model": (lambda: (vae(latent_dim=3), TRAIN), "latent_dim of the model was 2 and is 3 now"),
    "guide": (
        lambda: (vae(encoder_floor=0.01), TRAIN),
        r"encoder_floor of the guide was \S+ and is 0.01 now",
    ),
    "entry": (
        lambda: (zoo.create("mean", TRAIN), TRAIN),
        "entry was vae and is mean now",
    ),
    "scaling": (
        lambda: (vae(scaling="range"), TRAIN),
        "scaling was standard and is range now",
    ),
    "strategy": (
        lambda: (vae(learning_rate=0.5), TRAIN),
        "learning_rate of the training was 0.001 and is 0.5 now",
    ),
    "seed": (lambda: (vae(seed=1), TRAIN), "seed was 0 and is 1 now"),
    "values": (
        lambda: (vae(), shifted(values=TRAIN.values + 1e-3)),
        "values of the training data changed",
    ),
    "mask": (lambda: (vae(), shifted(mask=HOLED)), "mask of the training data changed"),
    "groups": (
        lambda: (vae(), shifted(groups={"trial": tuple("aabbcc")})),
        "groups of the training data changed",
    ),
    "units": (
        lambda: _with(shifted(units=("deg",) * len(TRAIN.channels))),
        "units of the training data changed",
    ),
    "channels": (
        lambda: _with(shifted(channels=tuple(f"c{i}" for i in range(len(TRAIN.channels))))),
        "channels of the training data changed",
    ),
    "rate": (
        lambda: _with(shifted(rate=60.0)),
        "rate of the training data was 30.0 and is 60.0 now",
    ),
}


def _with(data: Sequences) -> tuple[Assembly, Sequences]:
    return vae(data), data


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, zoo.Run]:
    """A finished training and its folder."""
    folder = tmp_path_factory.mktemp("resume") / "run"
    return folder, zoo.fit(vae(), TRAIN, run_dir=folder)


@pytest.mark.parametrize("resume", ["auto", "must"])
@pytest.mark.parametrize("change", CHANGES)
def test_another_training_is_refused_by_what_differs(
    trained: tuple[Path, zoo.Run], change: str, resume: Any
) -> None:
    """Five of five such refits once came back with the old weights."""
    make, words = CHANGES[change]
    assembly, data = make()
    with pytest.raises(OtherTrainingError, match=words):
        zoo.fit(assembly, data, run_dir=trained[0], resume=resume)
    assert bits(zoo.load(trained[0])) == bits(trained[1])


def test_validation_data_count(trained: tuple[Path, zoo.Run]) -> None:
    with pytest.raises(OtherTrainingError, match="validation data was absent and is Sequences now"):
        zoo.fit(vae(), TRAIN, val=movements()[6:], run_dir=trained[0], resume="auto")


def test_other_initial_parameters_are_another_training(trained: tuple[Path, zoo.Run]) -> None:
    assembly = vae()
    with torch.no_grad():
        next(iter(assembly.model.parameters())).add_(1.0)
    with pytest.raises(OtherTrainingError, match="initial parameters changed"):
        zoo.fit(assembly, TRAIN, run_dir=trained[0], resume="auto")


def test_a_changed_module_is_named(
    trained: tuple[Path, zoo.Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = hashes

    def edited(roots: Any) -> dict[str, str]:
        return real(roots) | {"zoo.models.frames.vae": "another"}

    monkeypatch.setattr("zoo.runs.fingerprint.hashes", edited)
    with pytest.raises(
        OtherTrainingError, match=r"holds another .*: code of zoo.models.frames.vae chang"
    ):
        zoo.fit(vae(), TRAIN, run_dir=trained[0], resume="auto")


@pytest.mark.parametrize(
    ("name", "settings"),
    [("vae", QUICK), ("mean", {}), ("pca", {"latent_dim": 2}), ("gp", {"iterations": 4})],
)
def test_the_same_call_returns_the_same_bits_without_training(
    name: str,
    settings: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Variational, closed-form and marginal-likelihood runs alike, and the duration stays."""
    data = pairs() if CATALOGUE[name].data == "pairs" else TRAIN
    first = zoo.fit(zoo.create(name, data, **settings), data, run_dir=tmp_path)
    monkeypatch.setattr("zoo.runs.fitting.learn", _never)
    again = zoo.fit(zoo.create(name, data, **settings), data, run_dir=tmp_path, resume="auto")
    assert bits(again) == bits(first)
    assert (again.seconds, again.history) == (first.seconds, first.history)
    assert again.made_of == first.made_of
    zoo.fit(
        zoo.create(name, data, **settings), data, run_dir=tmp_path, resume="auto", progress=True
    )
    assert f"{name}: trained before in" in capsys.readouterr().err


def _never(*_: object) -> None:
    raise AssertionError("a finished training was repeated")


def test_settings_that_change_no_bits_do_not_count(trained: tuple[Path, zoo.Run]) -> None:
    folder, run = trained
    again = zoo.fit(vae(checkpoint_every=7), TRAIN, run_dir=folder, resume="auto")
    assert bits(again) == bits(run)
    other_name = shifted(name="the same, renamed")
    assert bits(zoo.fit(vae(), other_name, run_dir=folder, resume="auto")) == bits(run)


def test_a_finished_run_comes_back_as_fit_gave_it(tmp_path: Path) -> None:
    """Its calibration is not the training's; the folder keeps it."""
    run = zoo.fit(zoo.create("mean", TRAIN), TRAIN, run_dir=tmp_path)
    run.calibrate(movements()[6:], method="scale").save(tmp_path)
    again = zoo.fit(zoo.create("mean", TRAIN), TRAIN, run_dir=tmp_path, resume="auto")
    assert not again.calibration and zoo.load(tmp_path).calibration


def test_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    run = zoo.fit(vae(), TRAIN, run_dir=tmp_path)
    with pytest.raises(RunExistsError, match=r"finished run: resume='auto' \(--resume\).*overwrit"):
        zoo.fit(vae(), TRAIN, run_dir=tmp_path)
    with pytest.raises(ValueError, match="choose one"):
        zoo.fit(vae(), TRAIN, run_dir=tmp_path, resume="auto", overwrite=True)
    other = zoo.fit(zoo.create("mean", TRAIN), TRAIN)
    with pytest.raises(RunExistsError, match="holds another run, of vae on 'tiny'"):
        other.save(tmp_path)
    assert bits(zoo.load(tmp_path)) == bits(run)
    new = zoo.fit(vae(seed=1), TRAIN, run_dir=tmp_path, overwrite=True)
    assert bits(zoo.load(tmp_path)) == bits(new) != bits(run)
    other.save(tmp_path, overwrite=True)
    with pytest.raises(OtherTrainingError, match="does not tell how it was trained"):
        zoo.fit(zoo.create("mean", TRAIN), TRAIN, run_dir=tmp_path, resume="auto")


def test_a_begun_training_is_not_lost_either(tmp_path: Path) -> None:
    """Interrupted inside: refused unasked, refused for another, and gone on with for the same."""
    whole = zoo.fit(vae(epochs=4), TRAIN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoo.inference.svi.warn_of_collapse", lambda *_: None)
        patch.setattr("zoo.inference.svi._Training._row", _stopping(after=2))
        with pytest.raises(KeyboardInterrupt, match="resume='auto' goes on"):
            zoo.fit(vae(epochs=4), TRAIN, run_dir=tmp_path)
    with pytest.raises(RunExistsError, match="holds a begun training"):
        zoo.fit(vae(epochs=4), TRAIN, run_dir=tmp_path)
    with pytest.raises(OtherTrainingError, match="seed was 0 and is 1 now"):
        zoo.fit(vae(epochs=4, seed=1), TRAIN, run_dir=tmp_path, resume="auto")
    resumed = zoo.fit(vae(epochs=4), TRAIN, run_dir=tmp_path, resume="must")
    assert bits(resumed) == bits(whole)


def test_a_resumed_training_took_as_long_as_all_its_epochs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The wall clock of the last session alone is not its duration."""
    rows = [{"epoch": 0, "seconds": 600.0}, {"epoch": 1, "seconds": 700.0}]

    def resumed(*told: Any) -> Learned:
        return replace(learn(*told), history=rows)

    monkeypatch.setattr("zoo.runs.fitting.learn", resumed)
    assert zoo.fit(vae(), TRAIN).seconds == 1300.0


def _stopping(after: int) -> Callable[..., Any]:
    from zoo.inference.svi import _Training

    real, count = _Training._row, iter(range(99))

    def row(self: Any, c: float, beta: float) -> Any:
        if next(count) == after:
            raise KeyboardInterrupt
        return real(self, c, beta)

    return row


def test_a_begun_optimisation_of_the_evidence_is_kept_too(tmp_path: Path) -> None:
    data = pairs()

    def made(iterations: int = 4) -> Assembly:
        return zoo.create("gp", data, iterations=iterations)

    whole = zoo.fit(made(), data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoo.inference.marginal._Log.report", _interrupting(after=2))
        with pytest.raises(KeyboardInterrupt):
            zoo.fit(made(), data, run_dir=tmp_path)
    with pytest.raises(RunExistsError, match="begun"):
        zoo.fit(made(), data, run_dir=tmp_path)
    with pytest.raises(OtherTrainingError, match="iterations of the training was 4 and is 5 now"):
        zoo.fit(made(5), data, run_dir=tmp_path, resume="auto")
    assert bits(zoo.fit(made(), data, run_dir=tmp_path, resume="auto")) == bits(whole)


def _interrupting(after: int) -> Callable[..., None]:
    from zoo.inference.marginal import _Log

    real, count = _Log.report, iter(range(99))

    def report(self: Any, *told: Any) -> None:
        if next(count) == after:
            raise KeyboardInterrupt
        real(self, *told)

    return report


def test_must_finds_nothing_in_an_empty_folder(tmp_path: Path) -> None:
    for name in ("mean", "pca"):
        with pytest.raises(FileNotFoundError, match="holds no training"):
            zoo.fit(zoo.create(name, TRAIN), TRAIN, run_dir=tmp_path, resume="must")


def test_what_is_damaged_says_what_to_do(tmp_path: Path) -> None:
    zoo.fit(vae(), TRAIN, run_dir=tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(DamagedRunError, match=r"run.json.*overwrite=True \(--overwrite\) to begin"):
        zoo.fit(vae(), TRAIN, run_dir=tmp_path, resume="auto")
    (tmp_path / "run.json").unlink()
    next(tmp_path.glob("checkpoint-*")).write_bytes(b"")
    with pytest.raises(DamagedRunError, match=r"checkpoint.*damaged.*overwrite=True"):
        zoo.fit(vae(), TRAIN, run_dir=tmp_path, resume="auto")
    whole = zoo.fit(vae(), TRAIN, run_dir=tmp_path, overwrite=True)
    assert bits(whole) == bits(zoo.load(tmp_path))


def test_a_training_that_failed_leaves_the_folder_free(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoo.runs.fitting.learn", _never)
        with pytest.raises(AssertionError):
            zoo.fit(vae(), TRAIN, run_dir=tmp_path)
    assert bits(zoo.fit(vae(), TRAIN, run_dir=tmp_path)) == bits(zoo.fit(vae(), TRAIN))


def test_every_member_of_an_ensemble_is_compared(tmp_path: Path) -> None:
    def members(count: int, **settings: Any) -> list[Assembly]:
        return [vae(seed=s, **settings) for s in range(count)]

    first = zoo.fit_ensemble(members(2), TRAIN, run_dir=tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoo.runs.fitting.learn", _never)
        again = zoo.fit_ensemble(members(2), TRAIN, run_dir=tmp_path, resume="auto")
    assert [bits(r) for r in again.members] == [bits(r) for r in first.members]
    with pytest.raises(OtherTrainingError, match="latent_dim of the model was 2 and is 1 now"):
        zoo.fit_ensemble(members(2, latent_dim=1), TRAIN, run_dir=tmp_path, resume="auto")
    with pytest.raises(RunExistsError):
        zoo.fit_ensemble(members(2), TRAIN, run_dir=tmp_path)
    narrow = zoo.fit_ensemble(members(2, latent_dim=1), TRAIN, run_dir=tmp_path, overwrite=True)
    assert narrow.members[1].model.config.latent_dim == 1


def test_an_experiment_says_what_it_reuses_and_keeps_its_duration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Equal data, settings and code: taken from disk. Anything else: trained beside it."""
    monkeypatch.chdir(tmp_path)
    with timed() as first:
        whole = trained_once(vae(), TRAIN, "E0", "six movements")
    assert first == [whole.seconds] and "reused" not in capsys.readouterr().err
    with timed() as again:
        assert bits(trained_once(vae(), TRAIN, "E0", "six movements")) == bits(whole)
    assert again == first and "vae (six-movements): reused from runs/E0" in capsys.readouterr().err
    trained_once(vae(latent_dim=1), TRAIN, "E0", "six movements")
    trained_once(vae(movements()), movements(), "E0", "six movements")
    trained_once(zoo.create("mean", TRAIN), TRAIN, "E0", "six movements")
    assert "reused" not in capsys.readouterr().err
    assert len(list((tmp_path / "runs" / "E0").iterdir())) == 3


SLOW = """
import sys
import zoo
sys.path.insert(0, sys.argv[2])
from support import movements
data = movements()[:6]
zoo.fit(zoo.create("vae", data, epochs=100000, patience=None), data, run_dir=sys.argv[1])
"""


def test_a_second_writer_is_refused_and_a_kill_frees_the_folder(tmp_path: Path) -> None:
    """Two processes in one folder: the second is told at once; kill −9 leaves no lock behind."""
    words = [sys.executable, "-c", SLOW, str(tmp_path), str(ROOT / "tests")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    first = subprocess.Popen(words, env=environment)
    try:
        _wait_for(tmp_path / "checkpoint.json", first)
        for resume in ("never", "auto"):
            with pytest.raises(RunLockedError, match=f"process {first.pid} is writing"):
                zoo.fit(vae(), TRAIN, run_dir=tmp_path, resume=resume)  # type: ignore[arg-type]
        with pytest.raises(RunLockedError):
            zoo.fit(vae(), TRAIN).save(tmp_path)
        first.send_signal(signal.SIGKILL)
        first.wait(timeout=60)
        with pytest.raises(OtherTrainingError):
            zoo.fit(vae(), TRAIN, run_dir=tmp_path, resume="auto")
    finally:
        first.kill()
        first.wait(timeout=60)


def _wait_for(file: Path, training: subprocess.Popen[bytes]) -> None:
    for _ in range(1200):
        if file.exists():
            return
        assert training.poll() is None, "the training ended by itself"
        try:
            training.wait(timeout=0.1)
        except subprocess.TimeoutExpired:
            continue


MODEL = '''
"""A model of its own, outside the package."""
from zoo.models.baselines.mean import Config, Mean
from .part import SHIFT

class Mine(Mean):
    """The mean, shifted."""
    config_class = Config
    def condition(self, data):
        super().condition(data)
        self.mean = self.mean + SHIFT  # a comment
'''


def test_a_model_outside_the_package_is_hashed_with_its_own_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An edit of what its file imports is another training; an edit of a comment is none."""
    from zoo.inference.resume import codehash

    home = tmp_path / "mine"
    home.mkdir()
    (home / "__init__.py").touch()
    (home / "model.py").write_text(textwrap.dedent(MODEL))
    (home / "part.py").write_text("SHIFT = 1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = replace(CATALOGUE["mean"], model="mine.model:Mine")

    def fitted(resume: Any) -> zoo.Run:
        assembly = assemble(entry, TRAIN.layout, {}, seed=0, device="cpu")
        return zoo.fit(assembly, TRAIN, run_dir=tmp_path / "run", resume=resume)

    made_of = fitted("never").made_of
    assert {
        "code of mine",
        "code of mine.model",
        "code of mine.part",
        "code of zoo.models.baselines.mean",
    } <= (set(made_of))
    (home / "model.py").write_text(textwrap.dedent(MODEL).replace("# a comment", "# another"))
    codehash._read.cache_clear()
    fitted("auto")
    (home / "part.py").write_text("SHIFT = 2.0\n")
    codehash._read.cache_clear()
    with pytest.raises(OtherTrainingError, match=r"training: code of mine.part changed\."):
        fitted("auto")


def test_the_code_of_a_result_is_all_that_it_imports() -> None:
    """Model, guide and harness with what they import; no other model, no scores, no catalogue."""
    found = zoo.fit(vae(), TRAIN)
    assert found.made_of == {}
    from zoo.runs.fingerprint import fingerprint

    code = {k.removeprefix("code of ") for k in fingerprint(vae(), TRAIN) if k.startswith("code ")}
    assert {
        "zoo.models.frames.vae",
        "zoo.guides.amortised",
        "zoo.inference.svi",
        "zoo.runs.training",
    } <= code
    assert {"zoo.nn.mlp", "zoo.datasets.records.scaling", "zoo.types"} <= code
    assert not code & {
        "zoo.catalogue",
        "zoo.models.processes.gp",
        "zoo.evaluation.scores",
        "zoo.faces.cli",
    }


def test_a_module_without_source_is_named() -> None:
    with pytest.raises(ModuleNotFoundError, match="math"):
        hashes(["math"])
