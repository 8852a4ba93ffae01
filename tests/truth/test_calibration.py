"""Recalibration against crepes, scikit-learn, closed forms, and on groups that it never saw."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from crepes import ConformalRegressor  # type: ignore[import-untyped]
from safetensors.torch import load, save
from scipy import stats
from sklearn.isotonic import IsotonicRegression

from zoo.errors import FewGroupsWarning, NoDensityError, UnknownNameError
from zoo.evaluation.answers import Answer
from zoo.evaluation.calibration.conformal import Conformal
from zoo.evaluation.calibration.odd import tempered
from zoo.evaluation.calibration.pool import Pool
from zoo.evaluation.calibration.promise import promised
from zoo.evaluation.calibration.recalibration import (
    RECALIBRATIONS,
    recalibrate,
    recalibration_from_state,
)
from zoo.evaluation.calibration.scale import Scale
from zoo.evaluation.calibration.stretch import crossed, standardised
from zoo.evaluation.scores import score
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

KINDS = tuple(RECALIBRATIONS)


def items(truth: torch.Tensor, **parts: Any) -> Prediction:
    parts = {"location": torch.zeros(1, *truth.shape).double()} | parts
    return Prediction(
        predictive=Predictive(**parts),
        axes=("item", "target"),
        names=tuple(f"f_{i}" for i in range(truth.shape[1])),
        units=("N",) * truth.shape[1],
        task="regress",
    )


def walks(count: int, seed: int, channels: int = 6) -> tuple[Prediction, torch.Tensor]:
    """Overconfident forecasts whose errors are smooth in time, vary by walk, channel and lead."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    lead = torch.linspace(0.5, 2, 30, dtype=torch.float64)[:, None]
    joint = torch.linspace(0.5, 2, channels, dtype=torch.float64)
    paths = normal(20, count, 30, channels)
    angle = torch.linspace(0, 3, 30, dtype=torch.float64)[:, None]
    smooth = normal(count, 1, channels) * angle.cos() + normal(count, 1, channels) * angle.sin()
    truth = 2 * lead * joint * (0.25 * normal(count, 1, 1)).exp() * smooth
    prediction = Prediction(
        predictive=Predictive(location=0.7 * paths, noise=torch.full((1,), 0.7), joint=True),
        axes=("sequence", "time", "channel"),
        names=tuple(f"joint_{i}" for i in range(channels)),
        units=("rad",) * channels,
        task="forecast",
    )
    return prediction, truth


def covered(prediction: Prediction, truth: torch.Tensor, level: float) -> torch.Tensor:
    low, high = prediction.interval(level)
    return ((truth >= low) & (truth <= high)).double()


def test_one_entry_a_group_gives_the_intervals_of_crepes() -> None:
    rng = np.random.default_rng(0)
    sigma, residual = rng.uniform(0.5, 2, 83), rng.standard_t(4, 83)
    truth = torch.from_numpy(residual)[:, None]
    raw = items(truth, noise=torch.from_numpy(sigma)[:, None])
    mended = raw.recalibrated(recalibrate("conformal", raw, truth, by=()))
    oracle = ConformalRegressor().fit(residual, sigmas=sigma)
    for level in (0.5, 0.8, 0.9, 0.95):
        low, high = mended.interval(level)
        theirs = oracle.predict_int(np.zeros(83), sigmas=sigma, confidence=level)
        np.testing.assert_allclose(torch.cat([low, high], 1).numpy(), theirs, rtol=1e-6)


def test_groups_that_stand_or_fall_together_give_the_hierarchical_quantile() -> None:
    """With equal entries in a group, 30 groups are worth 30 entries: the ⌈31 p⌉-th of them."""
    sizes = torch.randn(30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    truth = sizes[:, None].expand(30, 40)
    raw = items(truth, noise=torch.ones(40).double())
    found = recalibrate("conformal", raw, truth, by=())
    assert isinstance(found, Conformal)
    high = raw.recalibrated(found).interval(0.9)[1]
    by_hand = sizes.abs().sort().values[math.ceil(31 * 0.9) - 1]
    assert float(high[0, 0]) == pytest.approx(float(by_hand), rel=1e-6)
    assert found.reach == pytest.approx(0.96)


def test_independent_entries_are_corrected_less_than_dependent_ones() -> None:
    generator = torch.Generator().manual_seed(2)
    truth = torch.randn(12, 400, generator=generator, dtype=torch.float64)
    raw = items(truth, noise=torch.ones(400).double())
    found = recalibrate("conformal", raw, truth, by=())
    assert isinstance(found, Conformal)
    assert found.reach == pytest.approx(0.99)
    half = float(raw.recalibrated(found).interval(0.9)[1][0, 0])
    assert half == pytest.approx(stats.norm.ppf(0.95), rel=0.06)


def test_scale_is_the_maximum_of_the_likelihood() -> None:
    truth = 3 * torch.randn(500, 1, generator=torch.Generator().manual_seed(3)).double()
    raw = items(truth, noise=torch.full((1,), 2.0).double())
    found = recalibrate("scale", raw, truth, by=())
    assert isinstance(found, Scale)
    factor = float(found.stretch.of(raw)[0])
    assert factor == pytest.approx(float((truth / 2).square().mean().sqrt()))

    def likelihood(by: float) -> float:
        noise = torch.full((1,), 2.0 * factor * by).double()
        return float(items(truth, noise=noise).log_prob(truth).mean())

    assert likelihood(1.0) > max(likelihood(0.99), likelihood(1.01))


def test_channel_factors_follow_many_groups_and_shrink_with_few() -> None:
    spreads = torch.tensor([0.5, 1.0, 2.0]).double()
    generator = torch.Generator().manual_seed(4)
    truth = spreads * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    raw = items(truth, noise=torch.ones(3).double())
    many = recalibrate("scale", raw, truth)
    assert isinstance(many, Scale)
    torch.testing.assert_close(many.stretch.of(raw), spreads, rtol=0.06, atol=0)
    equal = torch.randn(6, 30, generator=generator, dtype=torch.float64)
    few = items(equal, noise=torch.ones(30).double())
    shrunk = recalibrate("scale", few, equal)
    assert isinstance(shrunk, Scale)
    own = equal.square().mean(0).log().std()
    assert float(shrunk.stretch.channel.square().log().std()) < 0.5 * float(own)


def test_isotonic_is_the_isotonic_regression_of_the_pit() -> None:
    rng = np.random.default_rng(5)
    truth = torch.from_numpy(rng.gamma(2.0, 1.0, 2000) - 1.5)[:, None]
    raw = items(truth, noise=torch.ones(1).double())
    mended = raw.recalibrated(recalibrate("isotonic", raw, truth, by=()))
    value = torch.linspace(-1.4, 3, 2000).double()[:, None]
    pit, observed = stats.norm.cdf(truth[:, 0]), stats.rankdata(truth[:, 0]) / 2000
    oracle = IsotonicRegression(out_of_bounds="clip").fit(pit, observed)
    expected = oracle.predict(stats.norm.cdf(value[:, 0]))
    np.testing.assert_allclose(mended.cdf(value)[:, 0].numpy(), expected, atol=0.012)


@pytest.mark.parametrize("groups", [3, 9, 19])
@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.95])
def test_what_groups_promise_is_what_ranks_give(groups: int, level: float) -> None:
    """Simulated: n scores, the k-th smallest as band, a new score: it holds k / (n + 1) of them."""
    generator = torch.Generator().manual_seed(groups)
    scores = torch.rand(20_000, groups + 1, generator=generator)
    rank = min(math.ceil((groups + 1) * level - 1e-9), groups)
    band = scores[:, :groups].sort(1).values[:, rank - 1]
    held = float((scores[:, groups] <= band).double().mean())
    error = 5 * math.sqrt(0.25 / 20_000)
    assert held == pytest.approx(rank / (groups + 1), abs=error)
    assert promised(level, groups) <= held + error
    assert promised(level, groups) == pytest.approx(min(level, groups / (groups + 1)))


@pytest.mark.parametrize("count", [2, 3, 8])
def test_few_groups_say_what_they_can_promise(count: int) -> None:
    """Their number, n / (n + 1), and by how much the bands became wider, counted here again."""
    raw, truth = walks(count, 700)
    with pytest.warns(
        FewGroupsWarning, match=f"on {count} groups.* is {count / (count + 1):.0%},"
    ) as w:
        found = recalibrate("conformal", raw, truth)
    widths = [
        float((p.interval(0.9)[1] - p.interval(0.9)[0]).mean())
        for p in (raw.recalibrated(found), raw)
    ]
    assert f"{widths[0] / widths[1]:.2f} times as wide" in str(w[0].message)


def test_nine_groups_and_other_methods_promise_in_silence() -> None:
    """⌈10 · 0.9⌉ = 9: a 90 % band has a guarantee; stretching never had one."""
    raw, truth = walks(9, 701)
    recalibrate("conformal", raw, truth)
    few, known = walks(3, 702)
    for kind in ("scale", "isotonic"):
        recalibrate(kind, few, known)


def test_factors_do_not_see_the_scores_that_set_the_level() -> None:
    """Pure noise in 40 channels of 6 groups: factors with their own scores would look too good."""
    generator = torch.Generator().manual_seed(9)
    inside = []
    for _ in range(40):
        truth = torch.randn(56, 40, generator=generator, dtype=torch.float64)
        truth *= (0.5 * torch.randn(40, generator=generator)).exp()
        with pytest.warns(FewGroupsWarning):
            found = recalibrate(
                "conformal", items(truth[:6], noise=torch.ones(1).double()), truth[:6]
            )
        raw = items(truth[6:], noise=torch.ones(1).double())
        inside.append(float(covered(raw.recalibrated(found), truth[6:], 0.9).mean()))
    assert np.mean(inside) > 0.885


@pytest.mark.parametrize("kind", KINDS)
def test_a_calibrated_prediction_stays_nominal(kind: str) -> None:
    generator = torch.Generator().manual_seed(6)
    truth = torch.randn(4000, 1, generator=generator, dtype=torch.float64)
    calib, test = truth[:2000], truth[2000:]
    raw = items(calib, noise=torch.ones(1).double())
    mended = raw.recalibrated(recalibrate(kind, raw, calib))
    for level in (0.5, 0.9):
        error = math.sqrt(level * (1 - level) * 2 / 2000)
        assert abs(float(covered(mended, test, level).mean()) - level) < 6 * error


@pytest.mark.parametrize("kind", KINDS)
def test_overconfidence_is_mended_on_groups_never_seen(kind: str) -> None:
    """16 walks to calibrate, 100 others to check, twelve times: 90 ± 3 % on average."""
    shares, channels = [], []
    for seed in range(12):
        calib, known = walks(16, 2 * seed)
        raw, truth = walks(100, 2 * seed + 1)
        mended = raw.recalibrated(recalibrate(kind, calib, known))
        inside = covered(mended, truth, 0.9)
        assert float(covered(raw, truth, 0.9).mean()) < 0.7
        shares.append(float(inside.mean()))
        channels.append(inside.mean((0, 1)))
    assert np.mean(shares) == pytest.approx(0.9, abs=0.03)
    assert float(torch.stack(channels).mean(0).sub(0.9).abs().max()) < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_quantile_distribution_function_and_draws_agree(kind: str) -> None:
    calib, known = walks(24, 100)
    raw, truth = walks(6, 101)
    mended = raw.recalibrated(recalibrate(kind, calib, known))
    for level in (0.03, 0.5, 0.8):
        reached = mended.cdf(mended.quantile(level))
        torch.testing.assert_close(reached, torch.full_like(reached, level), rtol=0, atol=1e-6)
    draws = mended.sample(2000, joint=False)
    for level in (0.1, 0.5, 0.9):
        below = (draws <= mended.quantile(level)).double().mean(0)
        error = math.sqrt(level * (1 - level) / 2000)
        assert float((below - level).abs().max()) < 6 * error + 0.01
    assert mended.sample(20).shape == (20, *raw.shape)
    assert score(mended, truth)["crps"] is not None


def test_only_scale_keeps_a_density() -> None:
    raw, truth = walks(12, 200)
    assert score(raw.recalibrated(recalibrate("scale", raw, truth)), truth)["nll"] is not None
    for kind in ("conformal", "isotonic"):
        mended = raw.recalibrated(recalibrate(kind, raw, truth))
        assert score(mended, truth)["nll"] is None
        assert score(mended, truth)["nll_raw"] == score(raw, truth)["nll"]
        with pytest.raises(NoDensityError, match=f"{kind.title()} corrects quantiles only"):
            mended.log_prob(truth)


@pytest.mark.parametrize("kind", KINDS)
def test_a_stored_recalibration_is_the_same_bit_for_bit(kind: str) -> None:
    raw, truth = walks(12, 300)
    found = recalibrate(kind, raw, truth)
    meta, tensors = found.state()
    text, payload = json.dumps(meta, allow_nan=False), save(tensors)
    again = recalibration_from_state(json.loads(text), load(payload))
    for level in (0.05, 0.5, 0.99):
        first, second = (raw.recalibrated(r).quantile(level) for r in (found, again))
        assert torch.equal(first, second)


@pytest.mark.parametrize("kind", KINDS)
def test_masked_entries_and_padding_do_not_count(kind: str) -> None:
    raw, truth = walks(12, 400)
    mask = torch.ones(raw.shape, dtype=torch.bool)
    mask[3, 20:] = False
    mask[:, :, 2] &= torch.arange(30) < 25
    spoiled = torch.where(mask, truth, 1e6)
    first, second = (recalibrate(kind, raw, y, mask) for y in (truth, spoiled))
    assert torch.equal(first.quantile(raw, 0.9), second.quantile(raw, 0.9))


@pytest.mark.parametrize("kind", KINDS)
def test_float32_and_other_horizons(kind: str) -> None:
    raw, truth = walks(12, 500)
    found = recalibrate(kind, raw, truth)
    p = raw.predictive
    longer = Prediction(
        predictive=Predictive(
            location=torch.cat([p.location, p.location], 2).float(),
            noise=torch.full((1,), 0.7),
            joint=True,
        ),
        axes=raw.axes,
        names=raw.names,
        units=raw.units,
        task="forecast",
    ).recalibrated(found)
    assert longer.quantile(0.9).dtype == torch.float32
    exact = raw.recalibrated(found).quantile(0.9)
    torch.testing.assert_close(longer.quantile(0.9)[:, :30].double(), exact, rtol=1e-3, atol=1e-3)


def test_what_cannot_be_calibrated_is_refused_with_its_reason() -> None:
    raw, truth = walks(4, 600)
    with pytest.raises(UnknownNameError, match="no recalibration 'platt'"):
        recalibrate("platt", raw, truth)
    with pytest.raises(ValueError, match="at least 2 groups"):
        recalibrate("scale", raw, truth, groups={"subject": ("35",) * 4})
    found = recalibrate("scale", raw, truth)
    other, _ = walks(4, 601, channels=5)
    with pytest.raises(ValueError, match="5 channels; this recalibration was fitted on 6"):
        other.recalibrated(found).quantile(0.9)
    still = items(torch.zeros(5, 1), noise=torch.zeros(1).double())
    with pytest.raises(ValueError, match="standard deviation of 0"):
        recalibrate("scale", still, torch.ones(5, 1))


@pytest.mark.parametrize("by", [("channel",), ("time",), ("channel", "time")])
def test_the_factors_of_a_group_are_those_of_the_others(by: tuple[Any, ...]) -> None:
    """A truth blown up in a channel and at the end moves all factors but those of its group."""
    raw, truth = walks(12, 3)
    wild = truth.clone()
    wild[4, 20:, 2] *= 100
    found = []
    for told in (truth, wild):
        answer = Answer.of(raw, told)
        found.append(crossed(standardised(answer).abs(), answer, by, 1, common=False))
    assert torch.equal(found[0][4], found[1][4])
    others = torch.arange(12) != 4
    assert not torch.equal(found[0][others], found[1][others])


def test_groups_of_many_and_of_few_entries_weigh_the_same() -> None:
    """Thirty entries of one group are half of the weight, the one of another is the rest."""
    scores = torch.full((31, 1), 1.0, dtype=torch.float64)
    scores[30] = 5.0
    groups = {"trial": ["long"] * 30 + ["short"]}
    answer = Answer.of(items(scores, noise=torch.ones(1)), scores, None, groups)
    found = Pool.of(scores, answer).quantile(torch.tensor([0.4, 0.6], dtype=torch.float64))
    assert found.tolist() == [1.0, 5.0]


def test_one_odd_group_of_three_does_not_blow_up_every_band() -> None:
    """Of three groups of many entries N(0, 1) one is three times as far off: it counts as 1.5.

    Stretching then takes a² = (1 + 1 + 1.5²) / 3, not 11 / 3, whose 90 % band holds 98 % or more.
    """
    entries = torch.randn(3, 4000, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    truth = entries * torch.tensor([1.0, 3.0, 1.0])[:, None]
    raw = items(truth, noise=torch.ones(1).double())
    found = recalibrate("scale", raw, truth, by=())
    half = float(raw.recalibrated(found).interval(0.9)[1][0, 0])
    expected = stats.norm.ppf(0.95) * math.sqrt(4.25 / 3)
    assert half == pytest.approx(expected, rel=4 / math.sqrt(2 * 4000))
    with pytest.warns(FewGroupsWarning):
        found = recalibrate("conformal", raw, truth, by=())
    half = float(raw.recalibrated(found).interval(0.9)[1][0, 0])
    assert 0.9 < stats.norm.cdf(half) - stats.norm.cdf(-half) < 0.98


def test_where_groups_can_promise_no_group_is_tempered() -> None:
    """Nine groups: the guarantee counts the odd one as it is; of eight it is winsorised."""
    raw, truth = walks(9, 5)
    truth[2] *= 10
    for count in (8, 9):
        index = torch.arange(count)
        answer = Answer.of(raw.rows(index), truth[index])
        z = standardised(answer)
        sizes = tempered(z, answer).abs().mean((1, 2))
        if count == 9:
            assert torch.equal(sizes, z.abs().mean((1, 2)))
        else:
            assert float(sizes[2]) == pytest.approx(1.5 * float(z.abs().mean((1, 2)).quantile(0.5)))
            others = index != 2
            assert bool((sizes <= z.abs().mean((1, 2)) + 1e-12).all())
            expected = z.abs().mean((1, 2))[others].clamp(max=sizes[2])
            torch.testing.assert_close(sizes[others], expected)
