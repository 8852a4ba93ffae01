"""What a leaderboard's models see: nothing of the future by default, all of it where published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support import movements

from zoo.datasets.records import Sequences
from zoo.prediction.prediction import Prediction
from zoo.studies.leaderboard import PROTOCOLS, cells, own_protocol
from zoo.studies.leaderboard.cells import Cell
from zoo.studies.leaderboard.protocol import Protocol

QUICK = ("mean", "last-value", "ar", "nearest-neighbour", "kernel-ridge", "dmp", "promp", "pca-dmp")
SEEN = 12
HIDDEN = ("joint_2", "joint_5")


def answer(asked: Protocol, data: Sequences, model: str, folder: Path) -> Prediction:
    """What a model trained on the first fold's training part says of the others."""
    fold = asked.folds(data, 4)[0]
    cell = Cell(protocol=asked.name, model=model, settings=((),), seed=0, number=0, fold=fold)
    found = cells.compute(cell, folder, replace(asked, load=lambda: data))
    assert found.prediction is not None, found.error
    return found.prediction


def spoiled(data: Sequences, rows: Sequence[int], asked: Protocol) -> Sequences:
    """The same data with noise for everything that is hidden in some movements."""
    hidden = torch.zeros_like(data.mask)
    if asked.need == "forecast":
        hidden[list(rows), SEEN:] = True
    else:
        inside = torch.tensor([c in HIDDEN for c in data.channels])
        hidden[list(rows)] = inside
    noise = torch.randn(data.values.shape, generator=torch.Generator().manual_seed(0))
    return replace(data, values=torch.where(hidden, 5 * noise.to(data.values), data.values))


def same(one: Prediction, two: Prediction) -> bool:
    """Whether two answers agree bit for bit."""
    first, second = one.predictive, two.predictive
    parts = ("location", "noise", "epistemic", "draws")
    pairs = [(getattr(first, p), getattr(second, p)) for p in parts]
    return all(a is b if a is None or b is None else torch.equal(a, b) for a, b in pairs)


def test_a_forecast_shows_the_first_frames_and_asks_for_those_after_them() -> None:
    """SEEN frames of every movement, and of the truth the 7 that follow."""
    data = movements()
    question = own_protocol(data, seen=SEEN, horizon=7).question(data)
    assert torch.equal(question.given.values, data.values[:, :SEEN])
    assert torch.equal(question.truth, data.values[:, SEEN : SEEN + 7])
    assert question.horizon == 7 and bool(question.mask.all())


def test_an_imputation_hides_the_channels_named_and_asks_for_them() -> None:
    """The others are observed in every frame."""
    data = movements()
    question = own_protocol(data, hidden=HIDDEN).question(data)
    inside = torch.tensor([c in HIDDEN for c in data.channels])
    assert torch.equal(question.given.mask, (~inside).expand_as(data.mask))
    assert torch.equal(question.mask, inside.expand_as(data.mask))
    assert torch.equal(question.truth[question.mask], data.values[question.mask])


@pytest.mark.parametrize("model", QUICK)
def test_the_default_protocol_sees_nothing_of_what_is_judged(model: str, tmp_path: Path) -> None:
    """Noise for the judged movements' future leaves all predictions their bits."""
    data = movements()
    asked = own_protocol(data, seen=SEEN, horizon=12)
    other = spoiled(data, asked.folds(data, 4)[0].judged, asked)
    assert not torch.equal(asked.question(data).truth, asked.question(other).truth)
    kept = [answer(asked, d, model, tmp_path / str(i)) for i, d in enumerate((data, other))]
    assert same(*kept)


@pytest.mark.parametrize("model", ["mean", "kernel-ridge", "pca", "promp"])
def test_an_imputation_sees_nothing_of_what_is_hidden(model: str, tmp_path: Path) -> None:
    """Noise for the judged movements' hidden channels leaves all predictions their bits."""
    data = movements()
    asked = own_protocol(data, hidden=HIDDEN)
    other = spoiled(data, asked.folds(data, 4)[0].judged, asked)
    kept = [answer(asked, d, model, tmp_path / str(i)) for i, d in enumerate((data, other))]
    assert same(*kept)


def test_the_published_protocol_has_hindsight(tmp_path: Path) -> None:
    """The same noise moves its predictions: the law above can fail."""
    data = movements()
    asked = replace(own_protocol(data, seen=SEEN, horizon=12), centred=True)
    other = spoiled(data, asked.folds(data, 4)[0].judged, asked)
    kept = [answer(asked, d, "last-value", tmp_path / str(i)) for i, d in enumerate((data, other))]
    assert not same(*kept)
    assert "those to be forecast included" in asked.protocol


def test_only_the_published_protocols_centre() -> None:
    """Theirs are means of zero over all frames; the others leave the recorded angles alone."""
    assert {name for name, asked in PROTOCOLS.items() if asked.centred} == {
        "walk-setup-1-published",
        "walk-setup-2-published",
    }
    for asked in PROTOCOLS.values():
        data = movements()
        ready = asked.prepared(data)
        if asked.centred:
            torch.testing.assert_close(ready.values.mean(1), torch.zeros(8, 7).to(data.values))
        else:
            assert torch.equal(ready.values, data.values)
            assert not asked.published


def test_published_figures_are_those_of_the_publications() -> None:
    """In deg², of walks 35_31–34."""
    figures = {n: {p.name: p.mse for p in PROTOCOLS[n].published} for n in PROTOCOLS}
    assert figures["walk-setup-1-published"] == {
        "SDE Matching": 4.50,
        "NCDSSM": 5.69,
        "Latent ODE": 5.98,
        "ARCTA": 7.62,
        "ODE²VAE-KL": 8.09,
        "Latent NSF": 8.62,
    }
    assert figures["walk-setup-2-published"] == {
        "Latent NSF": 3.41,
        "SDE Matching": 4.26,
        "NCDSSM": 4.74,
        "Latent SDE": 9.52,
    }


@pytest.mark.parametrize("count", [3, 4, 8])
def test_no_group_is_in_two_parts_of_a_fold(count: int) -> None:
    """Every group is judged once and calibrates once; parts have the sizes that are told."""
    data = movements()
    asked = own_protocol(data, seen=SEEN, horizon=12)
    folds = asked.folds(data, count)
    for part in ("judged", "calibration"):
        assert sorted(row for fold in folds for row in getattr(fold, part)) == list(range(8))
    for fold in folds:
        assert sorted((*fold.train, *fold.calibration, *fold.judged)) == list(range(8))
    whole = movements().windows(10, stride=5)
    by_trial = own_protocol(whole, seen=5, horizon=5).folds(whole, count)
    for fold in by_trial:
        names = [
            {whole.groups["trial"][row] for row in part}
            for part in (fold.train, fold.calibration, fold.judged)
        ]
        assert not (names[0] & names[1] or names[0] & names[2] or names[1] & names[2])


def test_sixteen_trials_in_four_folds_are_eight_four_and_four() -> None:
    """The sizes of the stored leaderboards."""
    data = movements()
    two = [data, replace(data, groups={"trial": tuple(f"b{i}" for i in range(8))})]
    sixteen = replace(
        data,
        values=torch.cat([d.values for d in two]),
        mask=torch.cat([d.mask for d in two]),
        lengths=torch.cat([d.lengths for d in two]),
        groups={"trial": tuple(t for d in two for t in d.groups["trial"])},
    )
    for fold in PROTOCOLS["walk-setup-2"].folds(sixteen, 4):
        assert (len(fold.train), len(fold.calibration), len(fold.judged)) == (8, 4, 4)
