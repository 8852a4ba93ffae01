"""`ar` against numpy, dense Gaussians, simulation and a plain AR(2) on real walks."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyro.poutine as poutine
import pytest
import torch
from numpy.typing import NDArray

import zoo
from zoo.datasets.records import Sequences
from zoo.inference.loader import whole
from zoo.models.baselines.autoregression import Autoregression, Config
from zoo.models.baselines.chain_selection import RIDGES, ChainSettings
from zoo.models.baselines.chains import Chain, lags_up_to
from zoo.types import Batch

A_1 = np.array([[1.2, 0.1], [-0.2, 0.9]])
A_2 = np.array([[-0.5, 0.0], [0.1, -0.3]])
ROOT_Q = np.array([[0.3, 0.0], [0.1, 0.2]])
DATA = os.environ.get("MOVEZOO_DATA", "")
real = pytest.mark.skipif(
    not Path(DATA, "cmu-mocap/35/35.asf").is_file(),
    reason="MOVEZOO_DATA names no folder with cmu-mocap/35",
)
Array = NDArray[np.float64]


def simulate(movements: int = 6, frames: int = 40) -> Sequences:
    """Movements of a known vector autoregression of order 2, of unequal length."""
    rng = np.random.default_rng(0)
    arrays = []
    for i in range(movements):
        x = [rng.normal(size=2), rng.normal(size=2)]
        for _ in range(frames - i % 6):
            x.append(0.1 + A_1 @ x[-1] + A_2 @ x[-2] + ROOT_Q @ rng.normal(size=2))
        arrays.append(np.array(x[2:]))
    return Sequences.from_arrays(
        arrays, rate=30.0, channels=["hip", "knee"], groups={"trial": range(movements)}
    )


def with_holes(data: Sequences, share: float = 0.1) -> Sequences:
    """The data with entries missing at random."""
    keep = torch.rand(data.mask.shape, generator=torch.Generator().manual_seed(1)) > share
    mask = data.mask & keep
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))


def fitted(data: Sequences, **settings: object) -> Autoregression:
    """A model of the data, with the bands of the Gaussian alone."""
    model = Autoregression(data.layout, Config(**settings))  # type: ignore[arg-type]
    model.condition(data)
    model.lead_ratio, model.channel_ratio = torch.ones(1).double(), torch.ones(2).double()
    return model


def ridge_regression(arrays: list[Array], lags: tuple[int, ...], ridge: float) -> Array:
    """(1 + lags × inputs, outputs) by augmented least squares on centred runs without a gap."""
    longest = max(lags, default=0)
    runs = [np.hstack([a[longest - lag : len(a) - lag] for lag in (*lags, 0)]) for a in arrays]
    both = np.concatenate(runs)
    both = both[~np.isnan(both).any(1)]
    width = arrays[0].shape[1]
    x, y = both[:, :-width], both[:, -width:]
    centre, level = x.mean(0), y.mean(0)
    penalty = math.sqrt(len(x) * ridge) * np.eye(x.shape[1])
    target = np.vstack([y - level, np.zeros((x.shape[1], width))])
    beta, *_ = np.linalg.lstsq(np.vstack([x - centre, penalty]), target, rcond=None)
    return np.vstack([level - centre @ beta, beta])


def rolled(beta: list[Array], lags: tuple[int, ...], path: Array, steps: int) -> Array:
    """Frames after ``path``, one at a time, by as many lags as reach back."""
    frames = list(path)
    for _ in range(steps):
        j = sum(lag <= len(frames) for lag in lags)
        frames.append(
            beta[j][0] + np.hstack([frames[-lag] for lag in lags[:j]] or [[]]) @ beta[j][1:]
        )
    return np.array(frames[len(path) :])


def levels(arrays: list[Array], order: int, ridge: float) -> list[Array]:
    """Regressions of all levels of a vector autoregression."""
    lags = lags_up_to(order)
    return [ridge_regression(arrays, lags[:j], ridge) for j in range(len(lags) + 1)]


def dense(model: Autoregression, frames: int) -> torch.distributions.MultivariateNormal:
    """A whole movement as a linear map of its innovations, column by column."""
    chain, width = model.chain, model.intercept.shape[1]
    nothing = torch.zeros(1, 0, width).double()
    mean = chain.rolled(nothing, frames)[0].flatten()
    unit = torch.eye(frames * width).double().view(-1, 1, frames, width)
    response = chain.rolled(nothing, frames, unit).flatten(1).T - mean[:, None]
    Q = torch.block_diag(*(model.innovation[chain.level(t)] for t in range(frames)))
    return torch.distributions.MultivariateNormal(mean, response @ Q @ response.T)


@pytest.mark.parametrize("holes", [False, True])
def test_every_level_is_a_ridge_regression(holes: bool) -> None:
    """Of all channels on all, or of each on its own past; gaps are left out."""
    data = with_holes(simulate()) if holes else simulate()
    for ridge in (1e-9, 0.3):
        model = fitted(data, order=4, coupling="vector", ridge=ridge)
        for j, beta in enumerate(levels(data.arrays, 4, ridge)):
            found = torch.cat([model.intercept[j][None], *model.coefficients[j, :j].mT])
            np.testing.assert_allclose(found.numpy(), beta, atol=1e-7)
        model = fitted(data, order=2, coupling="channel", ridge=ridge)
        for c in range(2):
            beta = ridge_regression([a[:, [c]] for a in data.arrays], (1, 2), ridge)
            own = [model.intercept[2, c], *model.coefficients[2, :, c, c]]
            np.testing.assert_allclose(own, beta[:, 0], atol=1e-7)
        assert float(model.coefficients[:, :, 0, 1].abs().max()) == 0


def test_innovations_are_those_of_held_out_movements() -> None:
    """Q by loops over the folds, and its share without correlations."""
    data = simulate()
    model = fitted(data, order=2, coupling="vector", ridge=0.01, shrinkage=0.25)
    residuals = []
    for f in range(4):
        train = [a for i, a in enumerate(data.arrays) if i % 4 != f]
        beta = ridge_regression(train, (1, 2), 0.01)
        for a in data.arrays[f::4]:
            past = np.hstack([np.ones((len(a) - 2, 1)), a[1:-1], a[:-2]])
            residuals.append(a[2:] - past @ beta)
    every = np.concatenate(residuals)
    Q = every.T @ every / len(every)
    expected = 0.75 * Q + np.diag(0.25 * np.diag(Q) + 1e-8)
    np.testing.assert_allclose(model.innovation[2].numpy(), expected, rtol=1e-8)


def test_it_recovers_the_parameters_of_its_own_data() -> None:
    """Within six standard errors."""
    data = simulate(movements=20, frames=400)
    model = fitted(data, order=2, coupling="vector", ridge=1e-9, shrinkage=0.0)
    past = np.concatenate([np.hstack([a[1:-1], a[:-2]]) for a in data.arrays])
    q = ROOT_Q @ ROOT_Q.T
    error = np.sqrt(np.outer(np.diag(q), np.diag(np.linalg.inv(len(past) * np.cov(past.T)))))
    found = np.hstack(list(model.coefficients[2].numpy()))
    assert (np.abs(found - np.hstack([A_1, A_2])) < 6 * error).all()
    tolerance = 6 * math.sqrt(2 / len(past)) * q.max()
    np.testing.assert_allclose(model.innovation[2].numpy(), q, atol=tolerance)


def test_the_choice_has_the_least_error_of_held_out_forecasts() -> None:
    """Against loops over orders, ridges, folds and starts; the data's own order wins."""
    data = simulate(movements=8)
    frames = max(map(len, data.arrays))
    score = {}
    for order in (1, 2, 4):
        for ridge in RIDGES:
            square, count = 0.0, 0
            for f in range(4):
                beta = levels([a for i, a in enumerate(data.arrays) if i % 4 != f], order, ridge)
                for a in data.arrays[f::4]:
                    for k in (3, frames // 4, frames // 2, 3 * frames // 4):
                        ahead = rolled(beta, lags_up_to(order), a[:k], len(a) - k)
                        square += float(((ahead - a[k:]) ** 2).sum())
                        count += ahead.size
            score[ChainSettings(order, True, ridge)] = square / count
    model = Autoregression(data.layout, Config(coupling="vector"))
    held_out = model._held_out(data)
    assert held_out.chosen(list(score)) == min(score, key=lambda c: score[c])
    model.condition(data)
    assert model.lags.tolist() == [1, 2]


@pytest.mark.parametrize("known", [1, 10])
def test_forecast_moments_equal_simulation(known: int) -> None:
    """After a whole memory, and after one frame of it."""
    data = simulate()
    model = fitted(data, order=4, coupling="vector")
    horizon, count = 8, 20_000
    start = data[:2].first(known)
    torch.manual_seed(0)
    answer = model.forecast(whole(start), None, horizon=horizon, draws=count)
    chain, rng = model.chain, torch.Generator().manual_seed(1)
    path = [x.expand(count, 2, 2) for x in start.values.unbind(1)]
    for _ in range(horizon):
        j = chain.level(len(path))
        root = torch.linalg.cholesky(model.innovation[j])
        x = chain.intercept[j] + torch.randn(count, 2, 2, generator=rng).double() @ root.T
        for lag, A in zip(chain.lags[:j], chain.coefficients[j], strict=False):
            x = x + path[-lag] @ A.T
        path.append(x)
    walked = torch.stack(path[known:], 2)
    for draws in (walked, answer.draws):
        error = answer.epistemic / math.sqrt(count)
        assert bool(((draws.mean(0) - answer.location[0]).abs() < 6 * error).all())
        ratio = draws.std(0) / answer.epistemic
        assert bool(((ratio - 1).abs() < 6 / math.sqrt(2 * count)).all())
    flat = walked[:, 0].flatten(1).T.corrcoef() - answer.draws[:, 0].flatten(1).T.corrcoef()
    assert float(flat.abs().max()) < 6 * math.sqrt(2 / count)


@pytest.mark.parametrize("coupling", ["channel", "vector"])
def test_conditioning_equals_that_of_the_dense_gaussian(coupling: str) -> None:
    """Means, standard deviations and covariances of draws, for three patterns of gaps."""
    data = simulate()
    model = fitted(data, order=4, coupling=coupling)
    holed = with_holes(data[:3].first(13), 0.3)
    torch.manual_seed(0)
    count = 20_000
    mean, spread, draws = model._conditional(holed.values, holed.mask, count)
    joint = dense(model, 13)
    centre, C = joint.mean, joint.covariance_matrix
    for i in range(3):
        o = holed.mask[i].flatten()
        gain = C[~o][:, o] @ torch.linalg.inv(C[o][:, o])
        expected = centre[~o] + gain @ (holed.values[i].flatten()[o] - centre[o])
        rest = C[~o][:, ~o] - gain @ C[o][:, ~o]
        torch.testing.assert_close(mean[i].flatten()[~o], expected, rtol=1e-7, atol=1e-8)
        torch.testing.assert_close(
            spread[i].flatten()[~o], rest.diag().sqrt(), rtol=1e-6, atol=1e-8
        )
        found = draws[:, i].flatten(1)[:, ~o].T.cov()
        size = rest.diag()
        error = ((size[:, None] * size + rest**2) / count).sqrt()
        assert bool(((found - rest).abs() < 6 * error).all())
        assert torch.equal(mean[i].flatten()[o], holed.values[i].flatten()[o])


def test_a_gap_far_back_does_not_matter_and_a_near_one_widens_the_band() -> None:
    """The last frames suffice where they were observed."""
    data = simulate()
    model = fitted(data, order=2)
    start = data[:3].first(9)

    def without(frame: int) -> Batch:
        mask = start.mask.clone()
        mask[0, frame, 0] = False
        return whole(replace(start, mask=mask, values=torch.where(mask, start.values, 0.0)))

    full = model.forecast(whole(start), None, horizon=5, draws=2)
    far = model.forecast(without(3), None, horizon=5, draws=2)
    near = model.forecast(without(-2), None, horizon=5, draws=2)
    torch.testing.assert_close(far.location, full.location)
    torch.testing.assert_close(near.location[:, 1:], full.location[:, 1:])
    torch.testing.assert_close(near.epistemic[1:], full.epistemic[1:])
    assert bool((near.epistemic[0, :2, 0] > full.epistemic[0, :2, 0]).all())


def test_the_program_has_the_density_of_the_dense_gaussian() -> None:
    """Without gaps it is the log density of whole movements."""
    data = simulate()
    model = fitted(data, order=4, coupling="vector")
    batch = whole(data[:4].first(15))
    trace = poutine.trace(model).get_trace(batch)
    expected = dense(model, 15).log_prob(batch.values.flatten(1)).sum()
    torch.testing.assert_close(trace.log_prob_sum(), expected, rtol=1e-7, atol=0)


def test_a_growing_chain_is_shrunk_and_a_stable_one_left() -> None:
    """All modes by one factor: roots 1.1 and 0.9 become 1 and 0.9/1.1."""
    A = torch.tensor([[[[2.0]], [[-0.99]]]]).double()
    growing = Chain((1, 2), torch.zeros(3, 1).double(), A.expand(3, 2, 1, 1))
    after = growing.stable().coefficients[-1].flatten()
    torch.testing.assert_close(after, torch.tensor([2 / 1.1, -0.99 / 1.1**2]).double())
    still = Chain((1, 2), torch.zeros(3, 1).double(), 0.9 * A.expand(3, 2, 1, 1))
    assert still.stable() is still


def test_bands_are_as_wide_as_held_out_errors() -> None:
    """Movements of two kinds: the Gaussian of the mixture alone would be too sure."""
    rng = np.random.default_rng(0)
    time = np.arange(60)[:, None]
    speeds = rng.uniform(0.1, 0.4, 40)
    arrays = [
        np.sin(s * time + rng.uniform(0, 6)) + 0.01 * rng.normal(size=(60, 1)) for s in speeds
    ]
    data = Sequences.from_arrays(arrays, rate=30.0)
    model = Autoregression(data.layout, Config())
    model.condition(data[:24])
    answer = model.forecast(whole(data[24:].first(20)), None, horizon=40, draws=2)
    z = (data.values[24:, 20:] - answer.location[0]) / answer.epistemic
    assert 0.8 < float(z.square().mean().sqrt()) < 1.25
    holes = data[24:].mask.clone()
    holes[:, 20:40] = False
    filled = model.impute(whole(replace(data[24:], mask=holes)), None, draws=2)
    z = ((data.values[24:] - filled.location[0]) / filled.epistemic)[~holes]
    assert 0.7 < float(z.square().mean().sqrt()) < 1.4


def test_too_little_data_is_named() -> None:
    """Two frames, a demanded order that nobody has, and one movement alone."""
    with pytest.raises(ValueError, match=r"at least 3 frames .* the longest has 2"):
        fitted(simulate(movements=4).first(2))
    with pytest.raises(ValueError, match=r"order 39 needs 5 runs of 40 frames"):
        fitted(simulate(), order=39)
    with pytest.raises(ValueError, match=r"order 40 .* leave 0"):
        fitted(simulate(), order=40)
    with pytest.raises(ValueError, match=r"\(6 where there is one alone\); the longest has 5"):
        fitted(simulate(movements=1).first(5))
    alone = fitted(simulate(movements=1))
    assert alone.fold.tolist() == [0, 1]


def test_wide_data_have_a_short_memory() -> None:
    """p times the channels bounds the matrices whose eigenvalues and inverses are needed."""
    values = list(np.random.default_rng(0).normal(size=(3, 12, 600)))
    data = Sequences.from_arrays(values, rate=30.0)
    model = Autoregression(data.layout, Config(ridge=1.0))
    found = model._choices(model._held_out(data), data.channels)
    assert {choice.order for choice in found} == {1, 2}


@real
def test_on_real_walks_it_is_no_worse_than_a_ridge_ar_2_chosen_by_cross_validation() -> None:
    """Setup 2's question: 100 frames observed and 200 to forecast, less training means only."""
    walks = zoo.load_data("cmu-mocap/35-walk", frames=None).frames(0, 300)
    values = walks.values.numpy()
    scale, centre = values[4:].std((0, 1)), values[4:].mean((0, 1))
    x = (values - centre) / scale

    def wrong(train: Array, test: Array, ridge: float) -> Array:
        beta = levels(list(train), 2, ridge)[2]
        a, b = test[:, 98], test[:, 99]
        missed = []
        for t in range(100, 300):
            a, b = b, beta[0] + np.hstack([b, a]) @ beta[1:]
            missed.append(((b - test[:, t]) * scale) ** 2)
        return np.mean(missed)

    def left_out(ridge: float) -> float:
        parts = [np.arange(12) % 4 == f for f in range(4)]
        return float(np.mean([wrong(x[4:][~here], x[4:][here], ridge) for here in parts]))

    bar = wrong(x[4:], x[:4], min((10.0**-k for k in range(8)), key=left_out))
    run = zoo.fit(zoo.create("ar", walks[4:], seed=0), walks[4:])
    ahead = run.forecast(walks[:4].first(100), horizon=200, draws=2)
    truth = walks.values[:4, 100:]
    assert float((ahead.mean - truth).square().mean()) < bar
    low, high = ahead.interval(0.9)
    inside = (truth > low) & (truth < high)
    assert 0.85 < float(inside.double().mean()) < 0.95
