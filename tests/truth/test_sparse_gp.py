"""FITC and VFE against the dense formula, the exact Gaussian process and gpytorch."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import gpytorch
import numpy as np
import pytest
import torch
from pyro import poutine
from pyro.distributions import MultivariateNormal
from pyro.infer import Predictive
from scipy.stats import multivariate_normal

from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs
from zoo.errors import FewerInducingWarning, NoiseDivergenceWarning
from zoo.guides.exact import Config, ExactPosterior
from zoo.inference import elbo
from zoo.inference.loader import Loader, whole
from zoo.inference.marginal import evaluator, fit_marginal
from zoo.models.processes import gp, sparse_gp
from zoo.types import Sites

BOUNDS = ("fitc", "vfe")


def pairs(items=80, features=3, targets=2, missing=0, noise=0.2, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, size=(items, features))
    f = np.sin(x @ rng.normal(size=(features, targets)) * 1.5)
    y = f + noise * rng.normal(size=f.shape)
    y[rng.permutation(items)[:missing], 0] = np.nan
    return Pairs.from_arrays(x, y)


def conditioned(data, log_length=-0.3, log_noise=-2.5, **settings):
    config = sparse_gp.Config(**{"inducing": 20, "compare": False, **settings})
    model = sparse_gp.SparseGaussianProcess(data.layout, config)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model.condition(data)
    with torch.no_grad():
        model.log_length.fill_(log_length)
        model.log_noise.fill_(log_noise)
    return model


def gram(a, b, length):
    return np.exp(-0.5 * ((a[:, None] - b[None]) ** 2).sum(-1) / length**2)


def dense_objective(model, data):
    """−Σ_p log N(y_p; 0, σ_f²(Q + Λ)), σ_f² at its best value, by N×N matrices."""
    x, z = data.inputs.numpy(), model.inducing.detach().numpy()
    length, noise = model.length.item(), model.noise.item()
    k_uu = gram(z, z, length) + model.config.jitter * np.eye(len(z))
    total = 0.0
    for p in range(data.targets.shape[1]):
        rows = data.mask[:, p].numpy()
        y, k_fu = data.targets[:, p].numpy()[rows], gram(x[rows], z, length)
        q = k_fu @ np.linalg.solve(k_uu, k_fu.T)
        left = np.diag(1 - np.diag(q))
        fitc = model.config.bound == "fitc"
        c = q + left * fitc + noise * np.eye(len(y))
        signal = y @ np.linalg.solve(c, y) / len(y)
        total -= multivariate_normal(cov=signal * c).logpdf(y)
        total += 0 if fitc else np.trace(left) / (2 * noise)
    return total


@pytest.mark.parametrize("missing", [0, 11])
@pytest.mark.parametrize("bound", BOUNDS)
def test_objective_is_the_dense_formula(bound, missing):
    data = pairs(missing=missing)
    model = conditioned(data, bound=bound)
    expected = dense_objective(model, data)
    assert model.objective().item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "settings", [{}, {"ard": True}, {"learn_inducing": True}], ids=["fixed", "ard", "learned"]
)
@pytest.mark.parametrize("bound", BOUNDS)
def test_gradients_are_the_differences(bound, settings):
    data = pairs(missing=7)
    model = conditioned(data, bound=bound, jitter=1e-4, **settings)
    evaluate = evaluator(model)
    trained = [p for p in model.parameters() if p.requires_grad]
    x = torch.nn.utils.parameters_to_vector(trained).detach().numpy().copy()
    _, gradient = evaluate(x)
    rng = np.random.default_rng(0)
    for _ in range(3):
        d = rng.normal(size=x.shape) / math.sqrt(x.size)
        steps = [evaluate(x + h * d)[0] for h in (-2e-4, -1e-4, 1e-4, 2e-4)]
        slope = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / 12e-4
        assert gradient @ d == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("bound", BOUNDS)
def test_gradients_equal_autograd_through_the_formula(bound):
    data = pairs()
    model = conditioned(data, bound=bound)
    gradients = torch.autograd.grad(model.objective(), (model.log_length, model.log_noise))
    x, z, y = data.inputs, model.inducing, data.targets
    square = lambda a, b: (a[:, None] - b[None]).square().sum(-1)  # noqa: E731
    scale = -0.5 * torch.exp(-2 * model.log_length)
    k_fu = torch.exp(scale * square(x, z))
    k_uu = torch.exp(scale * square(z, z)) + model.config.jitter * torch.eye(len(z))
    q = k_fu @ torch.linalg.solve(k_uu, k_fu.mT)
    left = 1 - q.diagonal()
    c = q + torch.diag(left * (bound == "fitc") + model.noise)
    signal = (y * torch.linalg.solve(c, y)).sum(0) / len(y)
    objective = 0.5 * (len(y) * signal.log().sum() + y.shape[1] * torch.logdet(c))
    if bound == "vfe":
        objective = objective + y.shape[1] * left.sum() / (2 * model.noise)
    expected = torch.autograd.grad(objective, (model.log_length, model.log_noise))
    for ours, theirs in zip(gradients, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=0)


def test_objective_of_many_features_in_single_precision():
    """Image-like inputs: far from 0, of large norm, given in float32."""
    rng = np.random.default_rng(0)
    x = (100 + rng.normal(size=(60, 3000))).astype(np.float32).astype(np.float64)
    data = Pairs.from_arrays(x, rng.normal(size=(60, 2)))
    model = conditioned(data.to(dtype=torch.float32), log_length=4.0)
    expected = dense_objective(model, data.to(dtype=torch.float32).to(dtype=torch.float64))
    assert model.objective().item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("bound", BOUNDS)
def test_all_inputs_inducing_is_the_exact_process(bound):
    data = pairs(missing=9)
    sparse = conditioned(data, bound=bound, inducing=80, jitter=1e-10)
    exact = gp.GaussianProcess(data.layout, gp.Config(shared=True))
    exact.condition(data)
    with torch.no_grad():
        exact.log_length.fill_(-0.3)
        exact.log_noise.fill_(-2.5)
    assert sparse.objective().item() == pytest.approx(exact.objective().item(), rel=1e-7)
    sparse.settle()
    exact.settle()
    ours, theirs = (m.regress(pairs(seed=1).inputs, draws=0) for m in (sparse, exact))
    torch.testing.assert_close(ours.location, theirs.location, rtol=0, atol=1e-6)
    torch.testing.assert_close(ours.epistemic, theirs.epistemic, rtol=0, atol=1e-6)
    torch.testing.assert_close(ours.noise, theirs.noise, rtol=1e-6, atol=0)


def test_vfe_bounds_the_evidence_and_tightens():
    data = pairs()
    exact = gp.GaussianProcess(data.layout, gp.Config(shared=True))
    exact.condition(data)
    with torch.no_grad():
        exact.log_length.fill_(-0.3)
        exact.log_noise.fill_(-2.5)
    bounds = [conditioned(data, bound="vfe", inducing=m).objective().item() for m in (5, 20, 60)]
    assert bounds[0] > bounds[1] > bounds[2] > exact.objective().item()


def test_vfe_equals_gpytorch_sgpr():
    data = pairs(targets=1)
    model = conditioned(data, bound="vfe")
    value = model.objective().item()
    model.settle()
    x, y = data.inputs, data.targets[:, 0]

    class Sgpr(gpytorch.models.ExactGP):
        def __init__(self, likelihood):
            super().__init__(x, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            base = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel())
            self.covar_module = gpytorch.kernels.InducingPointKernel(
                base, inducing_points=model.inducing.clone(), likelihood=likelihood
            )

        def forward(self, inputs):
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(inputs), self.covar_module(inputs)
            )

    likelihood = gpytorch.likelihoods.GaussianLikelihood()
    peer = Sgpr(likelihood).double()
    base = peer.covar_module.base_kernel
    base.base_kernel.lengthscale = model.length.item()
    base.outputscale = model.signal.item()
    likelihood.noise = (model.noise * model.signal).item()
    peer.train()
    with gpytorch.settings.sgpr_diagonal_correction(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, peer)
        theirs = -mll(peer(x), y).item() * len(x)
        peer.eval()
        likelihood.eval()
        inputs = pairs(targets=1, seed=1).inputs
        latent = peer(inputs).mean.detach()
    assert value == pytest.approx(theirs, rel=1e-6)
    ours = model.regress(inputs, draws=0).location[0, :, 0]
    torch.testing.assert_close(ours, latent, rtol=0, atol=1e-6)


@pytest.mark.parametrize("bound", BOUNDS)
def test_the_bound_is_the_dense_one_at_every_draw(bound):
    data = pairs(missing=6)
    model = conditioned(data, bound=bound)
    expected = -dense_objective(model, data)
    model.settle()
    guide = ExactPosterior(data.layout, model, Config())
    found = [elbo.bound(model, guide, whole(data)).elbo.item() for _ in range(5)]
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    law = model.posterior_sites(whole(data)).of["v"]({})
    with pytest.raises(ValueError, match="needs all 80 items at once; got 20"):
        guide(Loader(data, batch_size=20).take(torch.arange(20)))
    model.posterior_sites = lambda batch: replace(sites, of={"v": lambda _: flipped})
    sites = Sites(plate="targets", size=2, rows=2, of={})
    flipped = MultivariateNormal(-law.loc, scale_tril=law.scale_tril)
    found = [elbo.bound(model, guide, whole(data)).elbo.item() for _ in range(5)]
    assert max(found) < expected - 10


@pytest.mark.parametrize("bound", BOUNDS)
def test_minibatches_are_the_bound_on_average(bound):
    data = pairs()
    model = conditioned(data, bound=bound)
    model.settle()
    guide = ExactPosterior(data.layout, model, Config())
    given = poutine.trace(guide).get_trace(whole(data))
    loader = Loader(data, batch_size=20)
    terms = [
        poutine.trace(poutine.replay(model, given)).get_trace(batch).log_prob_sum().item()
        for batch in loader.sweep()
    ]
    all_at_once = poutine.trace(poutine.replay(model, given)).get_trace(whole(data))
    assert np.mean(terms) == pytest.approx(all_at_once.log_prob_sum().item(), rel=1e-9)


@pytest.mark.parametrize("bound", BOUNDS)
def test_prior_draws_have_the_covariance_of_the_bound(bound):
    data = pairs(items=8, targets=1)
    model = conditioned(data, bound=bound, inducing=4)
    model.settle()
    torch.manual_seed(0)
    draw = Predictive(model, num_samples=20_000, parallel=True, return_sites=("u", "y"))
    drawn = draw(whole(data).unobserved())
    x, z = data.inputs.numpy(), model.inducing.numpy()
    length, signal = model.length.item(), model.signal.item()
    k_uu, k_fu = gram(z, z, length), gram(x, z, length)
    q = k_fu @ np.linalg.solve(k_uu, k_fu.T)
    left = np.diag(1 - np.diag(q)) * (bound == "fitc")
    c = q + left + model.noise.item() * np.eye(8)
    for name, expected in (("u", k_uu), ("y", c)):
        ours = np.cov(drawn[name].detach().squeeze().numpy().T) / signal
        variance = np.diag(expected)
        error = np.sqrt((expected**2 + np.outer(variance, variance)) / 20_000)
        assert (np.abs(ours - expected) < 6 * error).all()


def test_newton_and_l_bfgs_find_the_same_optimum():
    data = pairs(items=150)
    ends = []
    for optimizer in ("newton", "l-bfgs"):
        config = sparse_gp.Config(inducing=30, compare=False)
        model = sparse_gp.SparseGaussianProcess(data.layout, config)
        strategy = MarginalLikelihood(optimizer=optimizer, tolerance=1e-10)
        rows = fit_marginal(model, data, strategy, seed=0)
        ends.append((rows[-1]["objective"], model.log_length.item(), model.log_noise.item()))
        assert rows[-1]["gradient_norm"] < 1e-3 * rows[0]["gradient_norm"]
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


def test_learned_inducing_inputs_gain_on_fixed_ones():
    data = pairs(items=100)
    ends = []
    for learned in (False, True):
        config = sparse_gp.Config(inducing=10, learn_inducing=learned, compare=False)
        model = sparse_gp.SparseGaussianProcess(data.layout, config)
        rows = fit_marginal(model, data, MarginalLikelihood(iterations=20), seed=0)
        ends.append(rows[-1]["objective"])
    assert ends[1] < ends[0]


def test_noise_that_diverges_is_warned_of():
    data = pairs(items=200, targets=1, noise=0.02)
    few = sparse_gp.SparseGaussianProcess(data.layout, sparse_gp.Config(inducing=8))
    with pytest.warns(NoiseDivergenceWarning, match="target_0"):
        fit_marginal(few, data, MarginalLikelihood(optimizer="newton"), seed=0)
    assert few.report()["noise_std_vfe"][0] > 2 * few.report()["noise_std"][0]


def test_joint_draws_have_the_moments():
    data = pairs()
    model = conditioned(data)
    model.settle()
    torch.manual_seed(0)
    p = model.regress(pairs(seed=1).inputs[:10], draws=20_000)
    error = p.epistemic[0] / math.sqrt(20_000)
    assert ((p.draws.mean(0) - p.location[0]).abs() < 6 * error).all()
    spread = p.draws.std(0) / p.epistemic[0]
    assert ((spread - 1).abs() < 6 / math.sqrt(2 * 20_000)).all()


def test_a_fraction_of_many_items_is_capped_with_a_warning():
    rng = np.random.default_rng(0)
    data = Pairs.from_arrays(rng.normal(size=(300, 2)), rng.normal(size=(300, 1)))
    config = sparse_gp.Config(most_inducing=40)
    with pytest.warns(FewerInducingWarning, match="51 inducing inputs; 40 are taken"):
        model = sparse_gp.SparseGaussianProcess(data.layout, config)
        model.condition(data)
    assert model.report()["inducing"] == 40
    with pytest.warns(FewerInducingWarning, match="of 41000 items would be 6970"):
        assert sparse_gp.Config().count(41_000) == 1000
    assert sparse_gp.Config(inducing=2000).count(41_000) == 2000


def test_settings_and_data_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="inducing"):
        sparse_gp.Config(inducing=1.5)
    with pytest.raises(ValueError, match="81 inducing inputs cannot be drawn from 80"):
        conditioned(pairs(), inducing=81)
    data = pairs(missing=80)
    with pytest.raises(ValueError, match="target_0 has no observed item"):
        conditioned(data)
