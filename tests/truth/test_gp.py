"""The exact Gaussian process against scipy, its own Pyro program, and data drawn from it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from pyro.distributions import MultivariateNormal
from pyro.infer import Predictive
from scipy.stats import multivariate_normal

from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs
from zoo.errors import TooManyItemsError
from zoo.guides.exact import Config, ExactPosterior
from zoo.inference.elbo import bound
from zoo.inference.loader import whole
from zoo.inference.marginal import evaluator, fit_marginal
from zoo.models.processes import gp

KINDS = pytest.mark.parametrize(
    "settings", [{}, {"shared": True}, {"ard": True}], ids=["own", "shared", "ard"]
)


def pairs(items=40, missing=5, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, size=(items, 3))
    y = np.sin(x @ rng.normal(size=(3, 2))) + 0.2 * rng.normal(size=(items, 2))
    y[rng.permutation(items)[:missing], 0] = np.nan
    return Pairs.from_arrays(x, y)


def conditioned(data, **settings):
    model = gp.GaussianProcess(data.layout, gp.Config(**settings))
    model.condition(data)
    rng = np.random.default_rng(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.from_numpy(rng.normal(scale=0.3, size=parameter.shape)))
    return model


def covariance(model, a, b, target):
    kernel = 0 if model.config.shared else target
    length = model.length[kernel].detach().numpy()
    return np.exp(-0.5 * (((a[:, None] - b[None]) / length) ** 2).sum(-1)), kernel


def solved(model, data, target):
    """Observed inputs and targets, C = κ + ρI, and the best σ_f²."""
    rows = data.mask[:, target].numpy()
    x, y = data.inputs.numpy()[rows], data.targets.numpy()[rows, target]
    k, kernel = covariance(model, x, x, target)
    c = k + model.noise[kernel].item() * np.eye(len(y))
    return x, y, c, y @ np.linalg.solve(c, y) / len(y)


@KINDS
def test_objective_is_the_evidence(settings):
    data = pairs()
    model = conditioned(data, **settings)
    parts = [solved(model, data, p) for p in range(2)]
    expected = -sum(multivariate_normal(cov=s * c).logpdf(y) for _, y, c, s in parts)
    assert model.objective().item() == pytest.approx(expected, rel=1e-9)


@KINDS
def test_gradients_are_the_differences(settings):
    model = conditioned(pairs(), **settings)
    evaluate = evaluator(model)
    x = torch.nn.utils.parameters_to_vector(model.parameters()).detach().numpy().copy()
    _, gradient = evaluate(x)
    d = np.random.default_rng(0).normal(size=x.shape)
    steps = [evaluate(x + h * d)[0] for h in (-2e-4, -1e-4, 1e-4, 2e-4)]
    slope = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / 12e-4
    assert gradient @ d == pytest.approx(slope, rel=1e-6)


@KINDS
def test_posterior_is_the_formula(settings):
    data = pairs()
    model = conditioned(data, **settings)
    model.settle()
    new = pairs(seed=3).inputs
    p = model.regress(new, draws=4)
    assert p.draws.shape == (4, len(new), 2)
    for target in range(2):
        x, y, c, signal = solved(model, data, target)
        cross, kernel = covariance(model, x, new.numpy(), target)
        mean = cross.T @ np.linalg.solve(c, y)
        variance = signal * (1 - (cross * np.linalg.solve(c, cross)).sum(0))
        np.testing.assert_allclose(p.location[0, :, target].numpy(), mean, atol=1e-9)
        np.testing.assert_allclose(p.epistemic[0, :, target].square().numpy(), variance, atol=1e-9)
        noise = math.sqrt(model.noise[kernel].item() * signal)
        assert p.noise[target].item() == pytest.approx(noise, rel=1e-9)


@KINDS
def test_the_bound_is_the_dense_evidence_at_every_draw(settings):
    data = pairs()
    model = conditioned(data, **settings)
    parts = [solved(model, data, p) for p in range(2)]
    evidence = sum(multivariate_normal(cov=s * c).logpdf(y) for _, y, c, s in parts)
    model.settle()
    guide = ExactPosterior(data.layout, model, Config())
    found = [bound(model, guide, whole(data)).elbo.item() for _ in range(5)]
    np.testing.assert_allclose(found, evidence, rtol=1e-8)


def test_the_bound_is_not_the_evidence_of_a_guide_with_a_flipped_sign():
    data = pairs()
    model = conditioned(data)
    evidence = -model.objective().item()
    model.settle()
    guide = ExactPosterior(data.layout, model, Config())
    truth = model.posterior_sites(whole(data))

    def flipped(batch):
        law = truth.of["f"]({})
        wrong = MultivariateNormal(-law.loc, scale_tril=law.scale_tril)
        return replace(truth, of={"f": lambda _: wrong})

    model.posterior_sites = flipped
    found = [bound(model, guide, whole(data)).elbo.item() for _ in range(5)]
    assert max(found) < evidence - 10


def test_the_posterior_of_f_is_the_formula_at_the_training_inputs():
    data = pairs()
    model = conditioned(data)
    model.settle()
    f = model.posterior_sites(whole(data)).of["f"]({})
    p = model.regress(data.inputs, draws=0)
    torch.testing.assert_close(f.mean.mT, p.location[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(f.variance.mT, p.epistemic[0].square(), rtol=0, atol=1e-6)


def test_prior_draws_have_the_covariance_of_the_evidence():
    data = pairs(items=6, missing=0)
    model = conditioned(data)
    model.settle()
    torch.manual_seed(0)
    draw = Predictive(model, num_samples=20_000, parallel=True)
    y = draw(whole(data).unobserved())["y"].detach().squeeze()
    assert y.shape == (20_000, 2, 6)
    for target in range(2):
        _, _, c, signal = solved(model, data, target)
        ours = np.cov(y[:, target].numpy().T) / signal
        error = np.sqrt((c**2 + np.outer(np.diag(c), np.diag(c))) / 20_000)
        assert (np.abs(ours - c) < 6 * error).all()


def test_more_items_than_memory_are_refused_by_name():
    rng = np.random.default_rng(0)
    data = Pairs.from_arrays(rng.normal(size=(41_000, 2)), rng.normal(size=(41_000, 1)))
    with pytest.raises(TooManyItemsError, match=r"41000 items need some 188.3 GB.*'fitc' or 'vfe'"):
        gp.GaussianProcess(data.layout, gp.Config()).condition(data)
    with pytest.raises(TooManyItemsError, match=r"memory=0.0001 GB"):
        conditioned(pairs(), memory=1e-4)


def drawn_from_the_prior(items=200, length=0.7, noise=0.3, targets=3):
    rng = np.random.default_rng(5)
    x = rng.uniform(-2, 2, size=(items, 2))
    k = np.exp(-0.5 * ((x[:, None] - x[None]) ** 2).sum(-1) / length**2)
    root = np.linalg.cholesky(k + 1e-9 * np.eye(items))
    f = root @ rng.normal(size=(items, targets))
    return x, f + noise * rng.normal(size=f.shape)


def test_coverage_and_parameters_on_data_drawn_from_the_model():
    x, y = drawn_from_the_prior()
    train = Pairs.from_arrays(x[:120], y[:120])
    model = gp.GaussianProcess(train.layout, gp.Config(shared=True))
    rows = fit_marginal(model, train, MarginalLikelihood(), seed=0)
    assert rows[-1]["objective"] < rows[0]["objective"]
    assert model.length.item() == pytest.approx(0.7, rel=0.2)
    p = model.regress(torch.from_numpy(x[120:]), draws=0)
    half = 1.6448536269514722 * (p.noise.square() + p.epistemic[0].square()).sqrt().numpy()
    covered = np.abs(y[120:] - p.location[0].numpy()) < half
    assert abs(covered.mean() - 0.9) < 6 * math.sqrt(0.09 / covered.size)


def test_restarts_keep_the_best():
    data = pairs()
    model = gp.GaussianProcess(data.layout, gp.Config())
    rows = fit_marginal(model, data, MarginalLikelihood(restarts=3), seed=0)
    ends = [[r["objective"] for r in rows if r["restart"] == k][-1] for k in range(3)]
    assert model.objective().item() == pytest.approx(min(ends), rel=1e-9)


def test_data_of_the_wrong_kind_are_refused():
    data = pairs()
    model = gp.GaussianProcess(data.layout, gp.Config())
    with pytest.raises(TypeError, match="needs Pairs; got str"):
        model.condition("data")
    with pytest.raises(ValueError, match="noise must be positive; got 0"):
        gp.Config(noise=0.0)
    with pytest.raises(ValueError, match=r"noise_floor must be below noise; got 0.2 and 0.1"):
        gp.Config(noise_floor=0.2)
