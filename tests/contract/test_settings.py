"""Settings that a user may get wrong: refused in one sentence, or completed sensibly."""

from __future__ import annotations

from typing import Any

import pytest
from support import movements, pairs

import zoo
from zoo.contract.strategies import Svi
from zoo.inference.schedules import ramp


@pytest.mark.parametrize("epochs", [1, 2, 3, 10, 150, 1499])
def test_fewer_epochs_still_reach_the_plain_bound(epochs: int) -> None:
    inference = zoo.create("vae-dmp", movements(), epochs=epochs).inference
    assert isinstance(inference, Svi)
    assert inference.epochs == epochs
    assert ramp(epochs - 1, inference.temper_epochs) == 1.0
    assert inference.temper_epochs <= 100


def test_tempering_keeps_its_share_of_the_epochs() -> None:
    assert zoo.create("vae-dmp", movements(), epochs=750).inference.temper_epochs == 50
    assert zoo.create("vae-dmp", movements(), epochs=3000).inference.temper_epochs == 100
    given = zoo.create("vae-dmp", movements(), epochs=750, temper_epochs=3).inference
    assert given.temper_epochs == 3


@pytest.mark.parametrize("steps", [1, 60, 1000])
def test_a_budget_of_steps_still_reaches_the_plain_bound(steps: int) -> None:
    inference = zoo.create("vae-dmp", movements(), max_steps=steps).inference.budgeted(50)
    assert ramp(inference.epochs - 1, inference.temper_epochs) == 1.0


@pytest.mark.parametrize("name", ["temper_epochs", "warmup_epochs"])
def test_a_ramp_that_outlasts_the_training_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}=10 and epochs=5: raise epochs or lower {name}"):
        zoo.create("vae-dmp", movements(), epochs=5, **{name: 10})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "vae-dmp: epochs must be at least 1; got 0"),
        ({"epochs": "many"}, "vae-dmp: setting epochs: .*integer.*; got 'many'"),
        ({"temper_epochs": -3}, "temper_epochs must be at least 0; got -3"),
        ({"window": 0}, "window must be at least 1; got 0"),
        ({"patience": 0}, "patience must be at least 1; got 0"),
        ({"clip": -1}, "clip must be positive; got -1"),
        ({"learning_rate": 0}, "learning_rate must be positive; got 0"),
        ({"latent_dim": 0}, "vae-dmp: latent_dim must be at least 1; got 0$"),
        ({"schedule": "step"}, "setting schedule: .*'cosine'; got 'step'"),
        ({"device": "gpu"}, "device 'gpu' cannot be used here"),
    ],
)
def test_impossible_settings_are_one_sentence(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        zoo.create("vae-dmp", movements(), **settings)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_setting_of_several_types_is_named_once() -> None:
    with pytest.raises(ValueError, match=r"fitc: setting inducing: .* or .*; got 'abc'"):
        zoo.create("fitc", pairs(), inducing="abc")
