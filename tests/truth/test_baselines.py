"""The baselines against the same numbers by other roads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro.poutine as poutine
import pytest
import torch

from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NotFittedError
from zoo.inference.loader import whole
from zoo.models.baselines import autoregression, last_value, mean, nearest_neighbour
from zoo.models.baselines.analogues import interpolated
from zoo.models.baselines.autoregression import Autoregression
from zoo.models.baselines.last_value import LastValue
from zoo.models.baselines.mean import Mean, MeanRegressor
from zoo.models.baselines.nearest_neighbour import NearestNeighbour
from zoo.prediction.prediction import Prediction

A_1 = np.array([[1.2, 0.1], [-0.2, 0.9]])
A_2 = np.array([[-0.5, 0.0], [0.1, -0.3]])
ROOT_Q = np.array([[0.3, 0.0], [0.1, 0.2]])
MODELS = [(Mean, mean), (LastValue, last_value), (Autoregression, autoregression)]
ALL = [*MODELS, (NearestNeighbour, nearest_neighbour)]


def simulate(movements: int = 6, frames: int = 40, seed: int = 0) -> Sequences:
    """Movements of a known vector autoregression of order 2, of unequal length."""
    rng = np.random.default_rng(seed)
    arrays = []
    for i in range(movements):
        x = [rng.normal(size=2), rng.normal(size=2)]
        for _ in range(frames - i):
            x.append(0.1 + A_1 @ x[-1] + A_2 @ x[-2] + ROOT_Q @ rng.normal(size=2))
        arrays.append(np.array(x[2:]))
    groups = {"trial": range(movements), "subject": [i // 2 for i in range(movements)]}
    return Sequences.from_arrays(arrays, rate=30.0, channels=["hip", "knee"], groups=groups)


def with_holes(data: Sequences, share: float = 0.1) -> Sequences:
    keep = torch.rand(data.mask.shape, generator=torch.Generator().manual_seed(1)) > share
    mask = data.mask & keep
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))


def fitted(kind, home, data, **settings):  # type: ignore[no-untyped-def]
    model = kind(data.layout, home.Config(**settings))
    model.condition(data)
    return model


def prediction(predictive, data: Sequences) -> Prediction:  # type: ignore[no-untyped-def]
    return Prediction(
        predictive=predictive,
        axes=("sequence", "time", "channel"),
        names=data.channels,
        units=data.units,
        task="forecast",
    )


def test_mean_equals_the_moments_of_numpy_over_ragged_movements_with_holes() -> None:
    data = with_holes(simulate())
    model = fitted(Mean, mean, data)
    arrays = data.arrays
    for t in (0, 5, 20):
        frame = np.array([a[t] for a in arrays if len(a) > t])
        count = (~np.isnan(frame)).sum(0)
        np.testing.assert_allclose(model.mean[t].numpy(), np.nanmean(frame, 0), rtol=1e-12)
        spread = np.nanstd(frame, 0, ddof=1)
        np.testing.assert_allclose(model.deviation[t].numpy(), spread, rtol=1e-10)
        np.testing.assert_allclose(model.error[t].numpy(), spread / np.sqrt(count), rtol=1e-10)
    everything = np.concatenate(arrays)
    np.testing.assert_allclose(model.mean[-1].numpy(), np.nanmean(everything, 0), rtol=1e-10)
    beyond = model.forecast(whole(data), None, horizon=4, draws=3).location[0, :, -1]
    torch.testing.assert_close(beyond, model.mean[-1].expand(len(data), 2))


def test_mean_regressor_equals_the_moments_of_numpy() -> None:
    y = np.array([[1.0, 4.0], [2.0, np.nan], [6.0, 8.0]])
    pairs = Pairs.from_arrays(np.zeros((3, 1)), y)
    model = fitted(MeanRegressor, mean, pairs)
    answer = model.regress(torch.zeros(5, 1).double(), draws=2)
    assert answer.location.shape == (1, 5, 2)
    np.testing.assert_allclose(answer.location[0, 0].numpy(), [3, 6])
    np.testing.assert_allclose(answer.noise.numpy(), np.nanstd(y, 0, ddof=1))
    log_density = poutine.trace(model).get_trace(whole(pairs)).log_prob_sum()
    normal = torch.distributions.Normal(model.mean, model.deviation)
    expected = normal.log_prob(pairs.targets)[pairs.mask].sum()
    torch.testing.assert_close(log_density, expected)


def test_last_value_spread_is_the_root_mean_square_of_the_increments() -> None:
    data = with_holes(simulate())
    model = fitted(LastValue, last_value, data)
    for lead in (1, 2, 7):
        steps = np.concatenate([a[lead:] - a[:-lead] for a in data.arrays])
        expected = np.sqrt(np.nanmean(steps**2, 0))
        np.testing.assert_allclose(model.spread[lead - 1].numpy(), expected, rtol=1e-10)
    longest = len(model.spread)
    far = model.forecast(whole(data.first(5)), None, horizon=4 * longest, draws=2).epistemic
    torch.testing.assert_close(far[0, -1], 2 * model.spread[-1])


def test_last_value_counts_the_lead_from_the_frame_last_seen() -> None:
    data = simulate()
    model = fitted(LastValue, last_value, data)
    seen = data.first(10)
    mask = seen.mask.clone()
    mask[0, 7:, 0] = False
    mask[1, :, 1] = False
    batch = whole(replace(seen, mask=mask, values=torch.where(mask, seen.values, 0.0)))
    answer = model.forecast(batch, None, horizon=3, draws=5)
    assert answer.location[0, 0, :, 0].tolist() == [float(seen.values[0, 6, 0])] * 3
    torch.testing.assert_close(answer.epistemic[0, :, 0], model.spread[3:6, 0])
    torch.testing.assert_close(answer.location[0, 1, :, 1], model.mean[1].expand(3))
    torch.testing.assert_close(answer.epistemic[1, :, 1], model.deviation[1].expand(3))


def test_last_value_draws_of_a_random_walk_have_its_covariance() -> None:
    rng = np.random.default_rng(0)
    walks = [np.cumsum(rng.normal(size=(300, 1)), 0) for _ in range(60)]
    data = Sequences.from_arrays(walks, rate=30.0)
    model = fitted(LastValue, last_value, data)
    count = 20_000
    torch.manual_seed(0)
    draws = model.forecast(whole(data[:1].first(2)), None, horizon=6, draws=count).draws
    steps = draws[:, 0, :, 0] - data.values[0, 1, 0]
    lead = torch.arange(1.0, 7).double()
    expected = torch.minimum(lead[:, None], lead)
    variance = (expected**2 + lead[:, None] * lead) / count
    # 2 % for the variogram itself, which 60 walks of 300 steps fit.
    tolerance = 6 * variance.sqrt() + 0.02 * expected
    assert bool(((steps.T.cov() - expected).abs() < tolerance).all())


def test_gaps_are_interpolated_as_numpy_does() -> None:
    data = with_holes(simulate(), 0.4)
    filled = interpolated(data.values, data.mask, torch.zeros(2).double())
    time = np.arange(data.values.shape[1])
    for i in range(len(data)):
        for c in range(2):
            known = data.mask[i, :, c].numpy()
            expected = np.interp(time, time[known], data.values[i, known, c].numpy())
            np.testing.assert_allclose(filled[i, :, c].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize(("kind", "home"), ALL)
def test_forecasts_have_joint_draws_with_the_marginal_spread(kind, home) -> None:  # type: ignore[no-untyped-def]
    data = simulate(movements=10)
    model = fitted(kind, home, with_holes(data))
    torch.manual_seed(0)
    seen = whole(with_holes(data[:3].first(10)))
    answer = prediction(model.forecast(seen, None, horizon=7, draws=4000), data)
    draws = answer.sample(4000)
    assert draws.shape == (4000, 3, 7, 2)
    center = (draws.mean(0) - answer.mean).abs() / answer.std
    assert float(center.max()) < 6 / math.sqrt(4000)
    # A mixture's kurtosis is below 6 here: its standard deviation errs by less than twice the
    # Gaussian's.
    assert float((draws.std(0) / answer.std - 1).abs().max()) < 12 / math.sqrt(2 * 4000)


@pytest.mark.parametrize(("kind", "home"), ALL)
def test_what_is_missing_cannot_matter(kind, home) -> None:  # type: ignore[no-untyped-def]
    data = with_holes(simulate())
    poisoned = replace(data, values=torch.where(data.mask, data.values, 99.0))
    first, second = fitted(kind, home, data), fitted(kind, home, poisoned)
    for name, value in first.state_dict().items():
        assert bool(value.isfinite().all())
        assert torch.equal(value, second.state_dict()[name])
    seen, wrong = whole(data.first(9)), whole(poisoned.first(9))
    here, there = (
        poutine.trace(m).get_trace(b).log_prob_sum() for m, b in ((first, seen), (first, wrong))
    )
    torch.testing.assert_close(here, there)
    assert bool(here.isfinite())


@pytest.mark.parametrize(("kind", "home"), ALL)
def test_a_model_without_data_says_so(kind, home) -> None:  # type: ignore[no-untyped-def]
    data = simulate()
    model = kind(data.layout, home.Config())
    with pytest.raises(NotFittedError, match="no data yet"):
        model.forecast(whole(data.first(9)), None, horizon=2, draws=2)
    with pytest.raises(TypeError, match="needs Sequences; got Pairs"):
        model.condition(Pairs.from_arrays(np.zeros((3, 1)), np.zeros((3, 2))))
    blind = replace(data, mask=data.mask & torch.tensor([True, False]))
    with pytest.raises(ValueError, match="channel knee is missing in every frame"):
        model.condition(blind)


def test_too_little_data_is_named() -> None:
    with pytest.raises(ValueError, match="at least 2 frames; the longest has 1"):
        fitted(NearestNeighbour, nearest_neighbour, simulate().first(1))
    with pytest.raises(ValueError, match="at least 41 frames; the longest has 40"):
        fitted(NearestNeighbour, nearest_neighbour, simulate(), context=40)
    with pytest.raises(ValueError, match="at least 2 movements"):
        fitted(NearestNeighbour, nearest_neighbour, simulate(movements=1))
    with pytest.raises(ValueError, match="no group column 'day'; there are trial, subject"):
        fitted(NearestNeighbour, nearest_neighbour, simulate(), leave_out="day")


@pytest.mark.parametrize(
    ("home", "settings", "message"),
    [
        (mean, {"noise_floor": 0.0}, "noise_floor must be positive"),
        (last_value, {"noise_floor": -1.0}, "noise_floor must be positive"),
        (autoregression, {"order": 0}, "order must be at least 1"),
        (autoregression, {"coupling": "all"}, "coupling must be 'channel' or 'vector'; got 'all'"),
        (autoregression, {"ridge": 0.0}, "ridge must be positive"),
        (autoregression, {"shrinkage": 1.5}, "shrinkage must be at most 1; got 1.5"),
        (nearest_neighbour, {"neighbours": 0}, "neighbours must be at least 1"),
        (nearest_neighbour, {"decay": 0.0}, "decay must be positive"),
        (nearest_neighbour, {"align": "first"}, "'mean' or 'fading'; got 'first'"),
    ],
)
def test_settings_without_a_meaning_are_refused(home, settings, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        home.Config(**settings)
