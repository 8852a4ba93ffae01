"""Where movements begin and end: windows and whole movements, and what lies after the end."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from support import FRAMES, movements, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.datasets.records import Sequences
from zoo.errors import MovementLengthError, WindowsWarning
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run

NAMES = CATALOGUE.names(can="forecast")
ENDING = ["vae-dmp", "vae-dmp-single", "ae-dmp", "sparse-ae-dmp", "ae-then-dmp"]
WHOLE = ("ae-dmp", "sparse-ae-dmp", "ae-then-dmp")
LENGTHS = (24, 20, 16, 24, 18, 22, 17, 19)
PHASED = {"dmp", "promp", "pca-dmp", *ENDING}


def of_windows(name: str) -> Run:
    """The run as if it had been trained on windows half as long."""
    run = run_of(name)
    layout = replace(run.assembly.layout, windows=True, frames=FRAMES // 2)
    return replace(run, assembly=replace(run.assembly, layout=layout))


def forecast(run: Run, data: Sequences) -> None:
    run.forecast(data, horizon=2, draws=2)


@pytest.mark.parametrize("name", NAMES)
def test_windows_and_whole_movements_are_told_apart(name: str) -> None:
    middle = movements().windows(8, stride=5)
    asked = (of_windows(name), movements().first(20)), (run_of(name), middle)
    for run, data in asked:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            forecast(run, data)
        found = [w for w in said if w.category is WindowsWarning]
        assert bool(found) == (name in PHASED)


@pytest.mark.parametrize("name", NAMES)
def test_beginnings_are_welcome_either_way(name: str) -> None:
    forecast(of_windows(name), movements().first(10))
    forecast(run_of(name), movements().windows(8, stride=20)[:1])
    forecast(of_windows(name), movements().windows(8, stride=5))


@pytest.mark.parametrize("name", ENDING)
def test_nothing_is_said_of_frames_after_the_end(name: str) -> None:
    run, longer = run_of(name), movements().resampled(FRAMES + 6)
    longer = replace(longer, rate=30.0, time_normalised=False)
    run.forecast(movements().first(20), horizon=4, draws=2)
    with pytest.raises(MovementLengthError, match="forecast at most 4, or"):
        run.forecast(movements().first(20), horizon=5, draws=2)
    with pytest.raises(MovementLengthError, match="end after 24 frames; got 2 frames after 24"):
        run.forecast(movements(), horizon=2, draws=2)
    with pytest.raises(MovementLengthError, match="end after 24 frames; got 30 frames"):
        run.impute(holed(longer), draws=2)
    with pytest.raises(MovementLengthError, match=r"data\.windows\(24\)"):
        run.reconstruct(longer, draws=2)


@pytest.mark.parametrize("name", [*ENDING, "vae-dmp-rhythmic"])
def test_a_part_of_a_movement_is_imputed(name: str) -> None:
    part = holed(movements().first(15))
    assert run_of(name).impute(part, draws=3).shape[1] == 15


def test_a_rhythmic_movement_goes_on() -> None:
    assert run_of("vae-dmp-rhythmic").forecast(movements(), horizon=9, draws=2).shape[1] == 9


@pytest.mark.parametrize("name", [*ENDING, "vae-dmp-rhythmic"])
def test_movements_of_unlike_length_are_learned_and_asked_about(name: str) -> None:
    cut = [x[:n] for x, n in zip(movements().arrays, LENGTHS, strict=True)]
    unlike = Sequences.from_arrays(cut, rate=30.0)
    few = {"epochs": 2, "batch_size": 16} | ({} if name in WHOLE else {"window": 10})
    run = zoo.fit(zoo.create(name, unlike, **few), unlike)
    for task in (run.reconstruct, run.represent):
        assert frames_of(task(unlike, draws=2)) == list(LENGTHS)
    forecast(run, unlike.first(10))
    assert frames_of(run.impute(holed(unlike), draws=2)) == list(LENGTHS)


@pytest.mark.parametrize("name", [*ENDING, "vae-dmp-rhythmic"])
def test_movements_without_a_movement_in_them_are_refused_by_name(name: str) -> None:
    short = Sequences.from_arrays([np.zeros((9, 2)), np.ones((2, 2))], rate=30.0)
    with pytest.raises(MovementLengthError, match="at least 3 frames; got one of 2: leave it out"):
        zoo.create(name, short)


def frames_of(answer: Prediction) -> list[int]:
    """Length of every movement of an answer."""
    lengths = answer.lengths
    assert lengths is not None
    return lengths.tolist()


def holed(data: Sequences) -> Sequences:
    """Three frames missing."""
    mask = data.mask.clone()
    mask[:, 8:11] = False
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))
