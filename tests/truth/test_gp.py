"""The exact Gaussian process against scipy, its own Pyro program, and data drawn from it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from pyro import poutine
from scipy.stats import multivariate_normal

from zoo.datasets.records import Pairs
from zoo.inference.loader import whole
from zoo.inference.marginal import evaluator, fit_marginal
from zoo.models import gp
from zoo.strategies import MarginalLikelihood

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
def test_program_has_the_objective_as_its_density(settings):
    data = pairs()
    model = conditioned(data, **settings)
    expected = -model.objective().item()
    model.settle()
    trace = poutine.trace(model).get_trace(whole(data))
    assert trace.log_prob_sum().item() == pytest.approx(expected, rel=1e-9)


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
    with pytest.raises(ValueError, match="noise_floor < noise"):
        gp.Config(noise=0.0)
