"""Between users' data and a model: units and rows come back right, leaks and mistakes are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support import CHANNELS, assembly_of, data_of, movements, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.datasets.records import Pairs, Sequences
from zoo.evaluation.calibration.calibration import Calibration
from zoo.evaluation.questions import Setup
from zoo.prediction.prediction import Prediction
from zoo.runs.units import fingerprints

QUICK = Setup(draws=10)
LENGTHS = (24, 20, 24, 18, 24, 20, 22, 24)


def ragged() -> Sequences:
    """Movements of four lengths, three times over, with a joint and a frame missing."""
    arrays = [a[:n].copy() for a, n in zip(movements().arrays, LENGTHS, strict=True)] * 3
    arrays[2][:, 3] = np.nan
    arrays[4][5] = np.nan
    like = movements()
    return Sequences.from_arrays(arrays, rate=30.0, channels=like.channels, units="rad")


def beyond(prediction: Prediction) -> torch.Tensor:
    """Frames after the end of their movement."""
    assert prediction.lengths is not None
    return torch.arange(prediction.shape[1]) >= prediction.lengths[:, None]


@pytest.mark.parametrize("name", ["pca", "dmp", "mean"])
def test_a_movement_is_answered_as_it_is_alone(name: str) -> None:
    """Exact models: rows of a ragged answer are those of each movement by itself."""
    run, data = run_of(name), ragged()
    together = run.reconstruct(data)
    assert bool(beyond(together).any())
    for row in (0, 1, 3, 6):
        alone = run.reconstruct(data[row])
        frames = alone.shape[1]
        torch.testing.assert_close(together.mean[row, :frames], alone.mean[0])
        torch.testing.assert_close(together.std[row, :frames], alone.std[0])


@pytest.mark.filterwarnings("ignore:.* were (trained|calibrated) on")
@pytest.mark.parametrize("method", ["conformal", "isotonic", "scale"])
@pytest.mark.parametrize("name", ["pca", "mean", "vae", "ar"])
def test_ragged_movements_are_scored_and_calibrated(name: str, method: str) -> None:
    """Frames beyond an end have no spread: they count nowhere and warn of nothing."""
    run = replace(run_of(name), calibration=Calibration())
    run.calibrate(ragged(), method=method, setup=QUICK)
    for row in zoo.evaluate(run, ragged(), setup=QUICK).rows:
        assert all(np.isfinite(e.value) for e in row.scores.values.values()), row.task
        assert row.scores["crps"] is not None


@pytest.mark.filterwarnings("ignore:.* were trained on")
@pytest.mark.parametrize("method", ["conformal", "isotonic", "scale"])
def test_a_ragged_answer_is_finite_everywhere(method: str) -> None:
    run = replace(run_of("pca"), calibration=Calibration())
    answer = run.calibrate(ragged(), method=method).reconstruct(ragged())
    parts = [answer.mean, answer.std, *answer.interval(0.9), answer.cdf(answer.mean)]
    assert all(bool(part.isfinite().all()) for part in [*parts, answer.sample(40)])


@pytest.mark.filterwarnings("ignore::zoo.errors.OtherPeopleWarning")
@pytest.mark.parametrize("name", ["pca", "gp"])
def test_what_was_trained_on_is_noticed(name: str) -> None:
    data = data_of(CATALOGUE[name])
    half = len(data) // 2
    run = zoo.fit(assembly_of(CATALOGUE[name]), data[:half])
    with pytest.warns(UserWarning, match=f"^2 of {half + 2} movements or items given for eval"):
        zoo.evaluate(run, data[half - 2 :])
    with pytest.warns(UserWarning, match=f"^{half} of {half} .* given for calibration"):
        run.calibrate(data[:half], method="scale")
    zoo.evaluate(run, data[half:])


def test_what_was_calibrated_on_is_noticed(tmp_path: Path) -> None:
    """Bands are right by construction where they were fitted: said after saving and loading too."""
    data = data_of(CATALOGUE["pca"])
    run = zoo.fit(assembly_of(CATALOGUE["pca"]), data[:4])
    ensemble = zoo.Ensemble(members=(run,))
    for found in (run, ensemble):
        found.calibrate(data[4:6], method="scale")
        again = type(found).load(found.save(tmp_path / found.name)) if found is ensemble else found
        with pytest.warns(UserWarning, match=r"^1 of 2 .* for evaluation were calibrated on"):
            zoo.evaluate(again, data[5:7])
        zoo.evaluate(again, data[6:])
    loaded = zoo.load(run.save(tmp_path / "run"))
    assert loaded.calibrated_on == run.calibrated_on and len(run.calibrated_on) == 2


def test_fingerprints_tell_apart_all_that_differs() -> None:
    """The last feature of wide inputs counts, padding does not."""
    x = np.zeros((3, 500))
    x[1, -1] = 1.0
    first, second, third = fingerprints(Pairs.from_arrays(x, np.ones((3, 2))))
    assert first == third != second
    whole, part = fingerprints(movements()), fingerprints(movements()[[2, 0]])
    assert part == [whole[2], whole[0]] and len(set(whole)) == len(whole)
    longer = Sequences.from_arrays([movements().arrays[0], np.zeros((99, CHANNELS))], rate=30.0)
    assert fingerprints(longer)[0] == whole[0]


def test_validation_data_of_another_layout_are_refused() -> None:
    swapped = replace(movements(), channels=movements().channels[::-1])
    with pytest.raises(ValueError, match="channels 0 of the data is 'joint_6'"):
        zoo.fit(assembly_of(CATALOGUE["vae"]), movements(), val=swapped)


def test_settings_of_numpy_survive_saving(tmp_path: Path) -> None:
    assembly = zoo.create("pca", movements(), latent_dim=np.int64(2), em_tolerance=np.float32(0.5))
    again = zoo.load(zoo.fit(assembly, movements()).save(tmp_path))
    assert again.model.config == assembly.model.config


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="goal must be finite"):
        run_of("dmp").generate(movements()[:2], goal=np.full(CHANNELS, np.nan))
    with pytest.raises(TypeError, match="gp predicts Pairs; got Sequences"):
        run_of("gp").regress(movements())
    with pytest.raises(ValueError, match="'tiny' holds no movement"):
        run_of("pca").reconstruct(movements()[:0])
