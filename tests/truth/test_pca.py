"""Probabilistic PCA against dense Gaussian formulas, scikit-learn and its own stationarity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyro.poutine as poutine
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import multivariate_normal
from sklearn.decomposition import PCA as OraclePCA
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.guides.exact import Config as GuideConfig
from zoo.guides.exact import ExactPosterior
from zoo.inference.factors import Factors, closed_form, expectation_maximisation
from zoo.models.frames.pca import PCA, Config
from zoo.types import Batch


def movements(missing: float = 0.0, seed: int = 0) -> Sequences:
    """Four sequences of 30 frames of 6 channels with two strong directions."""
    rng = np.random.default_rng(seed)
    loading = rng.normal(size=(2, 6))
    frames = rng.normal(size=(4, 30, 2)) @ loading + 0.3 * rng.normal(size=(4, 30, 6)) + 1.0
    frames[rng.random(frames.shape) < missing] = np.nan
    return Sequences.from_arrays(frames, rate=30.0)


def batch_of(data: Sequences) -> Batch:
    """All movements as one batch."""
    count = len(data)
    return Batch(
        values=data.values,
        mask=None if data.mask.all() else data.mask,
        inputs=None,
        start=torch.zeros(count, dtype=torch.long),
        sequence=torch.arange(count),
        movements=data.values,
        movement_mask=None,
        total=count,
        total_sequences=count,
    )


def fitted(data: Sequences, latent: int = 2) -> PCA:
    """`pca` conditioned on ``data``."""
    model = PCA(data.layout, Config(latent_dim=latent))
    model.condition(data)
    return model


def dense(model: PCA) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """μ and WW' + σ²I."""
    covariance = model.loading @ model.loading.T + model.noise.square() * torch.eye(
        6, dtype=torch.float64
    )
    return model.mean.numpy(), covariance.numpy()


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_evidence_is_the_multivariate_normal_of_the_seen_entries(missing: float) -> None:
    data = movements(missing)
    model = fitted(data)
    mean, covariance = dense(model)
    expected = 0.0
    for x, seen in zip(data.values.flatten(0, 1), data.mask.flatten(0, 1), strict=True):
        o = seen.numpy()
        if o.any():
            expected += multivariate_normal(mean[o], covariance[np.ix_(o, o)]).logpdf(x[o])
    assert float(model.log_evidence(batch_of(data))) == pytest.approx(expected, rel=1e-10)


def test_subspace_noise_and_score_equal_scikit_learn() -> None:
    data = movements()
    frames = data.values.flatten(0, 1).numpy()
    oracle = OraclePCA(2).fit(frames)
    model = fitted(data)
    axes = torch.nn.functional.normalize(model.loading, dim=0)
    angles = torch.linalg.svdvals(axes.T @ torch.from_numpy(oracle.components_.T))
    torch.testing.assert_close(angles, torch.ones(2, dtype=torch.float64))
    # scikit-learn divides by N - 1; its own σ² scaled back is the maximum-likelihood one.
    scale = (len(frames) - 1) / len(frames)
    assert float(model.noise.square()) == pytest.approx(oracle.noise_variance_ * scale)
    ours = float(model.log_evidence(batch_of(data))) / len(frames)
    assert ours == pytest.approx(oracle.score(frames), abs=1 / len(frames))
    assert ours >= oracle.score(frames)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_exact_guide_gives_the_evidence_at_every_draw(missing: float) -> None:
    data = movements(missing)
    model, batch = fitted(data), batch_of(data)
    guide = ExactPosterior(data.layout, model, GuideConfig())
    for seed in range(3):
        torch.manual_seed(seed)
        q = poutine.trace(guide).get_trace(batch)
        p = poutine.trace(poutine.replay(model, trace=q)).get_trace(batch)
        difference = p.log_prob_sum() - q.log_prob_sum()
        torch.testing.assert_close(difference, model.log_evidence(batch), rtol=1e-10, atol=1e-8)


def test_posterior_is_the_conditional_of_the_joint_gaussian() -> None:
    data = movements(0.3)
    model, batch = fitted(data), batch_of(data)
    _, covariance = dense(model)
    prediction = model.represent(batch, None, draws=1)
    x, seen = data.values[1, 4], data.mask[1, 4]
    o = seen.numpy()
    gain = model.loading[seen].T.numpy() @ np.linalg.inv(covariance[np.ix_(o, o)])
    mean = gain @ (x - model.mean)[seen].numpy()
    spread = np.eye(2) - gain @ model.loading[seen].numpy()
    np.testing.assert_allclose(prediction.location[0, 1, 4], mean, rtol=1e-9)
    assert prediction.epistemic is not None
    np.testing.assert_allclose(prediction.epistemic[0, 1, 4] ** 2, np.diag(spread), rtol=1e-9)


def test_imputation_is_gaussian_conditioning_with_joint_draws() -> None:
    data = movements()
    model = fitted(data)
    mean, covariance = dense(model)
    hidden = torch.tensor([False, True, False, False, True, False])
    holed = replace(data, mask=data.mask & ~hidden)
    draws = 4000
    torch.manual_seed(0)
    prediction = model.impute(batch_of(holed), None, draws=draws)
    h, o = hidden.numpy(), ~hidden.numpy()
    gain = covariance[np.ix_(h, o)] @ np.linalg.inv(covariance[np.ix_(o, o)])
    expected = mean[h] + gain @ (data.values[2, 5].numpy()[o] - mean[o])
    conditional = covariance[np.ix_(h, h)] - gain @ covariance[np.ix_(o, h)]
    np.testing.assert_allclose(prediction.location[0, 2, 5, hidden], expected, rtol=1e-9)
    assert prediction.epistemic is not None and prediction.noise is not None
    variance = prediction.epistemic.square() + prediction.noise.square()
    np.testing.assert_allclose(variance[0, 2, 5, hidden], np.diag(conditional), rtol=1e-9)
    assert prediction.draws is not None
    paths = prediction.draws[:, 2, 5, hidden]
    sampled = torch.cov(paths.T) + prediction.noise.square() * torch.eye(2, dtype=torch.float64)
    # Standard error of a sample covariance: √((Σ_ii Σ_jj + Σ_ij²) / draws).
    diagonal = np.diag(conditional)
    error = np.sqrt((np.outer(diagonal, diagonal) + conditional**2) / draws)
    assert (np.abs(sampled.numpy() - conditional) < 6 * error).all()


def test_em_on_complete_data_is_the_closed_form() -> None:
    values = movements().values.flatten(0, 1)
    exact = closed_form(values, 2, 1e-4)
    start = torch.ones_like(values, dtype=torch.bool)
    em = expectation_maximisation(values, start, 2, 1e-4, iterations=2000, tolerance=1e-12)
    torch.testing.assert_close(em.loading, exact.loading, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(em.noise, exact.noise)


def test_em_ends_where_the_gradient_of_the_evidence_vanishes() -> None:
    data = movements(0.3)
    values, mask = data.values.flatten(0, 1), data.mask.flatten(0, 1)
    em = expectation_maximisation(values, mask, 2, 1e-4, iterations=5000, tolerance=1e-14)

    def evidence(loading: Tensor, mean: Tensor, noise: Tensor) -> Tensor:
        factors = Factors(loading=loading, mean=mean, noise=noise)
        return factors.log_evidence(values, mask).mean()

    for gradient in torch.func.grad(evidence, argnums=(0, 1, 2))(em.loading, em.mean, em.noise):
        torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-5)


def test_a_frame_with_nothing_seen_gets_the_marginal() -> None:
    data = movements()
    model = fitted(data)
    holed = replace(data, mask=data.mask & (torch.arange(30) != 7)[:, None])
    prediction = model.impute(batch_of(holed), None, draws=2)
    _, covariance = dense(model)
    torch.testing.assert_close(prediction.location[0, 0, 7], model.mean)
    assert prediction.epistemic is not None and prediction.noise is not None
    variance = prediction.epistemic[0, 0, 7].square() + prediction.noise.square()
    np.testing.assert_allclose(variance, np.diag(covariance), rtol=1e-9)


def test_bad_data_are_refused_by_name() -> None:
    data = movements()
    with pytest.raises(ValueError, match="below the number of channels, 6"):
        PCA(data.layout, Config(latent_dim=6))
    blind = replace(data, mask=data.mask & (torch.arange(6) != 2))
    with pytest.raises(ValueError, match="channel_2 is missing in every frame"):
        fitted(blind)
    values, mask = movements(0.3).values.flatten(0, 1), movements(0.3).mask.flatten(0, 1)
    with pytest.warns(UserWarning, match="raise em_iterations"):
        expectation_maximisation(values, mask, 2, 1e-4, iterations=2, tolerance=1e-12)
