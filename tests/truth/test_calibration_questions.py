"""A calibration belongs to its questions and people; bands follow the errors observed."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support import movements

import zoo
from zoo.datasets.records import Sequences
from zoo.errors import FewGroupsWarning, OtherPeopleWarning, OtherQuestionWarning
from zoo.evaluation.calibration.adapted import Adapted, difficulty, rehearsal
from zoo.evaluation.calibration.asked import Asked
from zoo.evaluation.calibration.calibration import Calibration
from zoo.evaluation.calibration.grid import corrections, lengths_of, observed_difficulty
from zoo.evaluation.calibration.recalibration import RECALIBRATIONS, recalibrate
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

FRAMES, CHANNELS, CALIBRATION, NEW = 60, 4, 60, 400
ON_GRID, BETWEEN = (8, 17, 30, 45), (6, 12, 23, 37)


class LastValue:
    """A forecaster of the last frame, who takes all steps for independent and of unit size."""

    capabilities = ("forecast",)

    def forecast(self, data: Sequences, *, horizon: int, draws: int, seed: int) -> Prediction:
        lead = torch.arange(1.0, horizon + 1)[:, None].double()
        last = data.values[:, -1:].double().expand(-1, horizon, -1)
        return Prediction(
            predictive=Predictive(location=last[None], noise=lead.sqrt().expand(-1, CHANNELS)),
            axes=("sequence", "time", "channel"),
            names=data.channels,
            units=data.units,
            task="forecast",
        )

    def regress(self, data: Any, *, draws: int, seed: int) -> Prediction:
        raise AssertionError("only forecasts are calibrated here")

    reconstruct = impute = regress


def walks(count: int, seed: int, size: float = 1.0, subject: str = "a") -> Sequences:
    """Random walks of which each has steps of its own size, four times larger at the end."""
    rng = np.random.default_rng(seed)
    growth = np.linspace(1, 4, FRAMES)[None, :, None]
    own = size * np.exp(0.3 * rng.normal(size=(count, 1, 1)))
    steps = 3 * own * growth * rng.normal(size=(count, FRAMES, CHANNELS))
    return of_person(Sequences.from_arrays(list(steps.cumsum(1)), rate=30.0), [subject] * count)


def of_person(data: Sequences, people: Sequence[str]) -> Sequences:
    """The movements, each a trial of its person."""
    trials = tuple(str(i) for i in range(len(data)))
    return replace(data, groups={"trial": trials, "subject": tuple(people)})


def covered(calibration: Calibration, data: Sequences, seen: int) -> float:
    """Share of what follows ``seen`` frames inside the 90 % band."""
    run, known = LastValue(), data.first(seen)
    raw = run.forecast(known, horizon=FRAMES - seen, draws=2, seed=0)
    part = calibration.part(Asked.of("forecast", known, FRAMES - seen), data.groups)
    assert part is not None
    correction: Any = part.correction
    if part.adaptive:
        factor = observed_difficulty(run, known, draws=2, seed=0)
        assert factor is not None
        correction = Adapted(correction=correction, factor=factor)
    low, high = raw.recalibrated(correction).interval(0.9)
    truth = data.values[:, seen:]
    return float(((truth >= low) & (truth <= high)).double().mean())


@pytest.fixture(scope="module")
def grid() -> Calibration:
    """Calibrated over the default grid, without adaptation."""
    found = corrections(LastValue(), walks(CALIBRATION, 0), "conformal", adapt=False)
    return Calibration().joined(found)


@pytest.mark.parametrize("seen", [*ON_GRID, *BETWEEN])
def test_bands_hold_after_every_length_of_a_grid_and_between(grid: Calibration, seen: int) -> None:
    """The errors of 60 calibration walks of unlike size leave some 2 % of doubt."""
    assert [part.asked.observed for part in grid.parts] == list(lengths_of(FRAMES))
    assert abs(covered(grid, walks(NEW, 1), seen) - 0.9) < 0.045


def test_one_length_is_not_right_for_others_and_says_so() -> None:
    """What the grid is there for: after 4 frames steps are a fraction of those after 45."""
    setup = zoo.Setup(seen=4, horizon=10)
    found = corrections(LastValue(), walks(CALIBRATION, 0), "conformal", setup=setup, adapt=False)
    single = Calibration().joined(found)
    with pytest.warns(OtherQuestionWarning, match="forecast of 15 frames after 45: its bands are"):
        assert covered(single, walks(NEW, 1), 45) < 0.7


@pytest.mark.parametrize("size", [0.3, 1.0, 5.0])
def test_adapted_bands_hold_for_people_whose_errors_are_larger_or_smaller(size: float) -> None:
    """Their size shows in the frames observed; without adaptation bands hold far too little."""
    found = corrections(LastValue(), walks(CALIBRATION, 0), "conformal")
    adaptive = Calibration().joined(found)
    people = walks(NEW, 1, size)
    for seen in (17, 23, 30):
        assert abs(covered(adaptive, people, seen) - 0.9) < 0.05
    plain = corrections(LastValue(), walks(CALIBRATION, 0), "conformal", adapt=False)
    if size == 5:
        assert covered(Calibration().joined(plain), people, 30) < 0.5


def test_a_rehearsal_asks_about_observed_frames_alone() -> None:
    """Half of them are shown; the difficulty is the mean absolute standardised error."""
    data = walks(3, 2)
    known = data.first(17)
    question = rehearsal(known)
    assert question is not None
    assert torch.equal(question.given.values, data.values[:, :8])
    assert torch.equal(question.truth, data.values[:, 8:17])
    raw = LastValue().forecast(question.given, horizon=9, draws=2, seed=0)
    z = (data.values[:, 8:17] - data.values[:, 7:8]) / torch.arange(1.0, 10.0).sqrt()[:, None]
    expected = z.abs().mean((1, 2))
    torch.testing.assert_close(difficulty(raw, question.truth, question.mask), expected)
    hidden = torch.zeros_like(question.mask)
    hidden[:, :, 0] = True
    torch.testing.assert_close(difficulty(raw, question.truth, hidden), z[..., 0].abs().mean(1))
    assert rehearsal(data.first(3)) is None


@pytest.mark.parametrize("kind", RECALIBRATIONS)
def test_an_adapted_correction_is_that_of_a_wider_prediction(kind: str) -> None:
    """Quantiles, distribution function, draws and rows."""
    data = walks(40, 3)
    raw = LastValue().forecast(data.first(30), horizon=30, draws=2, seed=0)
    inner = recalibrate(kind, raw, data.values[:, 30:], data.mask[:, 30:], data.groups)
    factor = torch.linspace(0.5, 2, 40).double()
    adapted = raw.recalibrated(Adapted(correction=inner, factor=factor))
    wide = replace(raw, predictive=raw.predictive.stretched(factor.view(-1, 1, 1)))
    plain = wide.recalibrated(inner)
    for level in (0.05, 0.5, 0.95):
        torch.testing.assert_close(adapted.quantile(level), plain.quantile(level))
    torch.testing.assert_close(adapted.cdf(raw.mean + 1), plain.cdf(raw.mean + 1))
    draws = adapted.sample(400, seed=0, joint=False)
    inside = (draws <= adapted.quantile(0.9)).double().mean()
    assert abs(float(inside) - 0.9) < 0.01
    some = torch.tensor([3, 17])
    torch.testing.assert_close(adapted.rows(some).quantile(0.9), adapted.quantile(0.9)[some])


@pytest.mark.parametrize("kind", RECALIBRATIONS)
def test_a_blend_begins_at_one_correction_and_ends_at_the_other(kind: str) -> None:
    """Between them its quantiles are between theirs."""
    data, other = walks(40, 3), walks(40, 4, 3.0)
    raw = LastValue().forecast(data.first(30), horizon=30, draws=2, seed=0)
    one, two = (
        recalibrate(
            kind, raw, x.values[:, 30:], x.mask[:, 30:], {"walk": list(map(str, range(40)))}
        )
        for x in (
            data,
            replace(other, values=other.values - other.values[:, 29:30] + data.values[:, 29:30]),
        )
    )
    quantiles = [raw.recalibrated(one.blend(two, share)).quantile(0.9) for share in (0.0, 0.5, 1.0)]
    torch.testing.assert_close(quantiles[0], raw.recalibrated(one).quantile(0.9))
    torch.testing.assert_close(quantiles[2], raw.recalibrated(two).quantile(0.9))
    assert bool(((quantiles[0] < quantiles[1]) & (quantiles[1] < quantiles[2])).all())


@pytest.fixture(scope="module")
def run() -> zoo.Run:
    """Calibrated on movements of one person."""
    data = of_person(movements(), "p" * 8)
    found = zoo.fit(zoo.create("promp", data[:4]), data[:4])
    with pytest.warns(FewGroupsWarning):
        return found.calibrate(data[4:])


def test_questions_like_those_of_the_calibration_are_answered_in_silence(run: zoo.Run) -> None:
    """On the grid and between, the same channels and the same share of frames hidden."""
    data = of_person(movements(), "p" * 8)
    frames = int(data.lengths.min())
    low, *_, high = lengths_of(frames)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seen in range(low, high + 1):
            found = run.forecast(data.first(seen), horizon=frames - seen)
            assert found.recalibration is not None
        assert run.reconstruct(data).recalibration is not None
        zoo.evaluate(run, replace(data, values=data.values + 0.01))


def test_other_questions_warn_by_name(run: zoo.Run) -> None:
    data = of_person(movements(), "p" * 8)
    frames = int(data.lengths.min())
    with pytest.warns(OtherQuestionWarning, match=rf"forecast of {2 * frames} frames after 10"):
        run.forecast(data.first(10), horizon=2 * frames)
    values = data.values.clone()
    values[:, :, 0] = torch.nan
    holed = Sequences.from_arrays(
        list(values.numpy()), rate=data.rate, channels=data.channels, units=data.units
    )
    with pytest.warns(OtherQuestionWarning, match=f"imputation of {data.channels[0]}: its bands"):
        run.impute(holed)
    gap = data.values.clone()
    gap[:, 3 : frames - 3] = torch.nan
    holed = Sequences.from_arrays(
        list(gap.numpy()), rate=data.rate, channels=data.channels, units=data.units
    )
    with pytest.warns(OtherQuestionWarning, match=f"imputation of {frames - 6} frames"):
        run.impute(holed)


def test_other_people_warn_by_name_unless_people_are_the_groups(run: zoo.Run) -> None:
    data = of_person(movements(), "q" * 8)
    with pytest.warns(OtherPeopleWarning, match="calibrated on subject p; these are of subject q"):
        run.reconstruct(data)
    several = of_person(movements(), "aabbaabb")
    train, rest = several[:4], several[4:]
    people = zoo.fit(zoo.create("promp", train), train)
    with pytest.warns(FewGroupsWarning, match="on 2 groups; the most that so few can promise"):
        people.calibrate(rest, by="subject", tasks=["reconstruct"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        people.reconstruct(data)
    assert "67% for a 90% band of a new subject" in repr(people.calibration)
    with pytest.raises(ValueError, match="no group column 'lab'; there are trial, subject"):
        people.calibrate(rest, by="lab")


def test_what_is_promised_is_told_and_kept(run: zoo.Run, tmp_path: Any) -> None:
    """Question, method, number of groups, promise and people; the same after loading."""
    told = repr(run.calibration)
    assert "forecast of" in told and "conformal on 4 groups (movement)" in told
    assert "80% for a 90% band of a new movement of subject p" in told
    again = zoo.load(run.save(tmp_path / "run"))
    assert repr(again.calibration) == told
    data = of_person(movements(), "p" * 8).first(13)
    one, two = (r.forecast(data, horizon=8).interval(0.9) for r in (run, again))
    assert torch.equal(one[0], two[0])


def test_the_latest_correction_of_a_question_is_kept() -> None:
    data = walks(10, 5)
    setup = zoo.Setup(seen=17, horizon=20)
    kinds = ("scale", "isotonic")
    found = [corrections(LastValue(), data, kind, setup=setup)[0] for kind in kinds]
    assert [p.correction.kind for p in Calibration().joined(found).parts] == ["isotonic"]


def test_a_task_that_was_not_calibrated_says_that_its_bands_are_raw() -> None:
    """Beside calibrated bands raw ones would be taken for such."""
    data = of_person(movements(), "p" * 8)
    run = zoo.fit(zoo.create("promp", data[:4]), data[:4])
    before = run.reconstruct(data[4:]).interval(0.9)
    run.calibrate(data[4:], tasks=["forecast"], method="scale")
    with pytest.warns(OtherQuestionWarning, match="reconstruct: its bands are raw.*for forecast"):
        after = run.reconstruct(data[4:])
    assert after.recalibration is None and torch.equal(after.interval(0.9)[0], before[0])


def test_too_few_frames_for_bands_that_follow_them_say_so() -> None:
    data = of_person(movements(), "p" * 8)
    run = zoo.fit(zoo.create("mean", data[:4]), data[:4])
    setup = zoo.Setup(seen=4, horizon=10)
    run.calibrate(data[4:], tasks=["forecast"], method="scale", setup=setup)
    with (
        pytest.warns(OtherQuestionWarning, match="bands are those of another question"),
        pytest.warns(OtherQuestionWarning, match="too few frames are observed.*these are raw"),
    ):
        found = run.forecast(data.first(3), horizon=10)
    assert found.recalibration is None
