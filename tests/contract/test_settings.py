"""Settings that a user may get wrong: refused in one sentence, or completed sensibly."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
from pydantic.dataclasses import is_pydantic_dataclass
from support import movements, pairs

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.registry import load
from zoo.contract.settings import made
from zoo.contract.strategies import MarginalLikelihood, Svi
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
        ({"epochs": "many"}, "vae-dmp: epochs must be a whole number; got 'many'"),
        ({"temper_epochs": -3}, "temper_epochs must be at least 0; got -3"),
        ({"window": 0}, "window must be at least 1; got 0"),
        ({"patience": 0}, "patience must be at least 1; got 0"),
        ({"clip": -1}, "clip must be positive; got -1"),
        ({"learning_rate": 0}, "learning_rate must be positive; got 0"),
        ({"latent_dim": 0}, "vae-dmp: latent_dim must be at least 1; got 0$"),
        ({"schedule": "step"}, "schedule must be 'constant' or 'cosine'; got 'step'"),
        ({"latent_dim": "3"}, "latent_dim must be a whole number; got '3'$"),
        ({"latent_dim": True}, "latent_dim must be a whole number; got True$"),
        ({"latent_dim": 3.0}, "latent_dim must be a whole number; got 3.0$"),
        ({"noise_std": True}, "noise_std must be a number; got True$"),
        ({"fixed_noise": 1}, "fixed_noise must be True or False; got 1$"),
        ({"clip": float("inf")}, "clip must be finite; got inf$"),
        ({"device": "gpu"}, "device 'gpu' cannot be used here"),
    ],
)
def test_impossible_settings_are_one_sentence(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        zoo.create("vae-dmp", movements(), **settings)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_setting_of_several_types_is_named_once() -> None:
    with pytest.raises(ValueError, match=r"fitc: inducing must be .* or .*; got 'abc'"):
        zoo.create("fitc", pairs(), inducing="abc")


def test_a_bound_inside_of_several_types_is_told_alone() -> None:
    with pytest.raises(ValueError, match=r"^vae: hidden must be at least 1; got 0$"):
        zoo.create("vae", movements(), hidden=(36, 0))


def test_numbers_that_lose_nothing_are_taken() -> None:
    given = {"hidden": [36, 20], "latent_dim": np.int64(3), "noise_floor": 1}
    config = zoo.create("vae", movements(), **given).model.config
    assert (config.hidden, config.latent_dim, config.noise_floor) == ((36, 20), 3, 1.0)
    assert type(config.latent_dim) is int and type(config.noise_floor) is float


def test_strategies_are_refused_without_an_entry_too() -> None:
    with pytest.raises(ValueError, match=r"^epochs must be at least 1; got 0$"):
        Svi(epochs=0)
    with pytest.raises(ValueError, match=r"^there is no setting 'epoch'; got 5$"):
        Svi(epoch=5)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match=r"^restarts must be at least 1; got 0$"):
        MarginalLikelihood(restarts=0)


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A dataclass of one's own, without pydantic."""

    order: int = 1
    sizes: tuple[int, ...] = ()
    floor: float = 0.1


def test_plain_dataclasses_are_as_strict() -> None:
    assert made(Plain, {"sizes": [1, 2], "floor": 1}) == Plain(sizes=(1, 2), floor=1.0)
    with pytest.raises(ValueError, match=r"^order must be a whole number; got '3'$"):
        made(Plain, {"order": "3"})


@pytest.mark.parametrize("name", zoo.list_models())
def test_settings_are_strict_frozen_and_keyword_only(name: str) -> None:
    entry = CATALOGUE[name]
    parts = [load(part).config_class for part in (entry.model, entry.guide) if part is not None]
    for kind in (*parts, type(entry.inference)):
        assert is_pydantic_dataclass(kind)
        assert kind.__pydantic_config__["strict"] and kind.__pydantic_config__["extra"] == "forbid"
        assert kind.__dataclass_params__.frozen and all(f.kw_only for f in fields(kind))
