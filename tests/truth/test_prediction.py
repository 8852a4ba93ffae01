"""Predictive distributions against scipy and Monte Carlo."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from zoo.errors import NoDensityError, NoJointSamplesError, NoSpreadError
from zoo.prediction import mixtures
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Deferred, Predictive

SHAPE = (3, 4, 2)


def prediction(**parts: Any) -> Prediction:
    """A prediction of three movements of four frames and two joints."""
    return Prediction(
        predictive=Predictive(**parts),
        axes=("sequence", "time", "channel"),
        names=("hip", "knee"),
        units=("rad", "rad"),
        task="forecast",
        rate=30.0,
    )


def mixture(components: int = 7, dtype: torch.dtype = torch.float64, **parts: Any) -> Prediction:
    """A mixture with noise that differs between components and coordinates."""
    generator = torch.Generator().manual_seed(0)
    location = 2 * torch.randn(components, *SHAPE, generator=generator, dtype=torch.float64)
    noise = 0.2 + torch.rand(components, *SHAPE, generator=generator, dtype=torch.float64)
    return prediction(location=location.to(dtype), noise=noise.to(dtype), **parts)


def noise_of(p: Prediction) -> torch.Tensor:
    noise = p.predictive.noise
    assert noise is not None
    return noise


def within_six_errors(draws: torch.Tensor, value: torch.Tensor) -> bool:
    error = draws.double().std(0) / math.sqrt(len(draws))
    return bool(((draws.double().mean(0) - value.double()).abs() <= 6 * error).all())


def test_a_gaussian_is_the_one_of_scipy() -> None:
    p = prediction(location=torch.full((1, *SHAPE), 1.5).double(), noise=torch.tensor([2.0, 0.5]))
    ours, scipys = p.quantile(0.975)[0, 0], stats.norm.ppf(0.975, 1.5, [2.0, 0.5])
    np.testing.assert_allclose(ours.numpy(), scipys, rtol=1e-7)
    value = torch.tensor([3.0, 1.0]).double()
    density = stats.norm.logpdf(value.numpy(), 1.5, [2.0, 0.5])
    np.testing.assert_allclose(p.log_prob(value)[0, 0].numpy(), density, rtol=1e-7)


def test_mixture_moments_density_and_distribution_function() -> None:
    p = mixture()
    m, s = p.predictive.location.numpy(), p.aleatoric.numpy()
    y = np.linspace(-3, 3, 24).reshape(SHAPE)
    noise = noise_of(p).numpy()
    cdf = stats.norm.cdf(y, m, noise).mean(0)
    density = np.log(stats.norm.pdf(y, m, noise).mean(0))
    np.testing.assert_allclose(p.cdf(torch.from_numpy(y)).numpy(), cdf, rtol=1e-12)
    np.testing.assert_allclose(p.log_prob(torch.from_numpy(y)).numpy(), density, rtol=1e-12)
    np.testing.assert_allclose(p.std.numpy() ** 2, s**2 + m.var(0), rtol=1e-12)


@pytest.mark.parametrize("level", [1e-12, 0.001, 0.3, 0.5, 0.9, 0.999])
def test_mixture_quantiles_invert_the_distribution_function(level: float) -> None:
    p = mixture()
    noise = noise_of(p).numpy()
    reached = stats.norm.cdf(p.quantile(level).numpy(), p.predictive.location, noise).mean(0)
    np.testing.assert_allclose(reached, level, rtol=1e-8)


@pytest.mark.parametrize("level", [1e-6, 0.05, 0.5, 0.975, 1 - 1e-6])
def test_float32_quantiles_agree_with_float64(level: float) -> None:
    exact, single = mixture().quantile(level), mixture(dtype=torch.float32).quantile(level)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=1e-4, atol=1e-4)


def test_far_tails_keep_their_digits() -> None:
    p = prediction(location=torch.zeros(1, *SHAPE), noise=torch.ones(2))
    assert float(p.quantile(1e-300)[0, 0, 0]) == pytest.approx(stats.norm.ppf(1e-300), rel=1e-6)
    far = mixture()
    score = far.normal_score(far.predictive.location.amax(0) + 15)
    back = mixtures.quantile(far.predictive.location, far.predictive.spread, float(score[0, 0, 0]))
    assert float(back[0, 0, 0]) == pytest.approx(
        float(far.predictive.location[:, 0, 0, 0].max()) + 15, rel=1e-9
    )


def test_separated_components_have_a_quantile_in_either_mode() -> None:
    location = torch.tensor([-50.0, 50.0]).double().view(2, 1, 1, 1).expand(2, *SHAPE)
    p = prediction(location=location, noise=torch.full((2,), 1e-3).double())
    torch.testing.assert_close(p.quantile(0.25), torch.full(SHAPE, -50.0).double())
    torch.testing.assert_close(p.quantile(0.75), torch.full(SHAPE, 50.0).double())


def test_draws_without_noise_have_empirical_quantiles_and_no_density() -> None:
    draws = torch.randn(101, *SHAPE, dtype=torch.float64)
    p = prediction(location=draws, joint=True)
    torch.testing.assert_close(p.quantile(0.3), draws.quantile(0.3, 0))
    share = (draws <= draws[5]).double().mean(0)
    torch.testing.assert_close(p.cdf(draws[5]), share.clamp(0.5 / 101, 1 - 0.5 / 101))
    with pytest.raises(NoDensityError):
        p.log_prob(draws[0])


@pytest.mark.parametrize("joint", [True, False])
def test_samples_have_the_moments_of_the_mixture(joint: bool) -> None:
    p = mixture(joint=True)
    draws = p.sample(4000, joint=joint, seed=1)
    assert within_six_errors(draws, p.mean)
    assert within_six_errors((draws - p.mean).square(), p.std.square())


def test_joint_draws_come_from_the_paths_with_noise() -> None:
    paths = torch.randn(50, *SHAPE).cumsum(2)
    p = prediction(
        location=torch.zeros(1, *SHAPE),
        epistemic=torch.ones(1),
        noise=torch.full((2,), 1e-4),
        draws=paths,
    )
    drawn = p.sample(50)
    nearest = torch.cdist(drawn.flatten(1), paths.flatten(1)).min(1)
    assert float(nearest.values.max()) < 1e-2
    assert len(nearest.indices.unique()) == 50


def test_a_seed_gives_the_same_draws_and_leaves_the_global_stream_alone() -> None:
    before = torch.random.get_rng_state()
    first, second = mixture(joint=True).sample(5, seed=3), mixture(joint=True).sample(5, seed=3)
    assert torch.equal(first, second)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("parts", [{}, {"joint": True, "epistemic": torch.ones(2)}])
def test_marginals_alone_give_no_joint_draws(parts: dict[str, Any]) -> None:
    with pytest.raises(NoJointSamplesError, match="joint=False"):
        mixture(**parts).sample(3)
    assert mixture(**parts).sample(3, joint=False).shape == (3, *SHAPE)


def test_an_affine_map_moves_every_part() -> None:
    p = mixture()
    scale, shift = torch.tensor([3.0, -0.5]).double(), torch.tensor([1.0, 2.0]).double()
    moved = replace(p, predictive=p.predictive.affine(scale, shift))
    torch.testing.assert_close(moved.mean, p.mean * scale + shift)
    torch.testing.assert_close(moved.std, p.std * scale.abs())
    torch.testing.assert_close(moved.quantile(0.9)[..., 1], p.quantile(0.1)[..., 1] * -0.5 + 2.0)


def test_a_deterministic_prediction_says_so() -> None:
    p = prediction(location=torch.zeros(1, *SHAPE))
    for ask in (lambda: p.std, lambda: p.interval(0.9), lambda: p.sample(2), lambda: p.cdf(p.mean)):
        with pytest.raises(NoSpreadError, match="deterministic"):
            ask()


@pytest.mark.usefixtures("unannotated")
def test_parts_that_do_not_fit_are_refused() -> None:
    location = torch.zeros(2, *SHAPE)
    with pytest.raises(ValueError, match="noise has shape"):
        Predictive(location=location, noise=torch.ones(3))
    with pytest.raises(ValueError, match="draws have shape"):
        Predictive(location=location, draws=torch.ones(3, 4))
    with pytest.raises(ValueError, match="1 units for 2 channels"):
        replace(mixture(), units=("rad",))
    with pytest.raises(ValueError, match=r"value has shape \(5,\)"):
        mixture().log_prob(torch.zeros(5))
    with pytest.raises(ValueError, match="between 0 and 1"):
        mixture().quantile(1.0)


def test_seconds_count_from_the_start_of_the_movement() -> None:
    later = replace(mixture(), offset=3)
    assert later.seconds is not None
    np.testing.assert_allclose(later.seconds.numpy(), [0.1, 4 / 30, 5 / 30, 0.2])


@pytest.mark.parametrize("deferred", [False, True])
def test_rows_and_concat_are_inverse(deferred: bool) -> None:
    """Every part of a mixture, put together again from its rows in any order."""
    torch.manual_seed(0)
    paths = torch.randn(5, 4, 6, 2)
    p = Predictive(
        location=torch.randn(3, 4, 6, 2),
        noise=torch.rand(2),
        epistemic=torch.rand(3, 4, 1, 1),
        draws=Deferred((5, 4, 6, 2), lambda: paths.clone()) if deferred else paths,
    )
    order = torch.tensor([2, 0, 3, 1])
    parts = [p.rows(order[:1]), p.rows(order[1:3]), p.rows(order[3:])]
    again = Predictive.concat(parts).rows(order.argsort())
    assert torch.equal(again.location, p.location)
    assert again.draws is not None and torch.equal(again.draws, paths)
    assert again.noise is not None and torch.equal(again.noise, p.noise.expand(3, 4, 6, 2))
    assert again.epistemic is not None
    assert torch.equal(again.epistemic, p.epistemic.expand(3, 4, 6, 2))


def test_what_one_part_lacks_cannot_be_joined() -> None:
    """No spread is made up, and none is dropped."""
    sure = Predictive(location=torch.zeros(1, 2, 3))
    wide = Predictive(location=torch.zeros(1, 2, 3), noise=torch.ones(3))
    with pytest.raises(ValueError, match="1 of 2 distributions to be joined have noise"):
        Predictive.concat([sure, wide])


def test_no_draws_are_none() -> None:
    assert Predictive(location=torch.zeros(1, 2, 3), draws=torch.zeros(0, 2, 3)).draws is None
