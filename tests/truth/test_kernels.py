"""Covariances by name: against scikit-learn, dense formulas, differences and their own draws."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from laws import check_exact, check_uniform, judged
from scipy.stats import multivariate_normal
from sklearn.gaussian_process.kernels import Matern, RationalQuadratic
from support import pairs

import zoo
from zoo.inference.marginal import evaluator
from zoo.models.processes import gp, sparse_gp
from zoo.models.processes.covariances import KERNELS, Name, stationary
from zoo.models.processes.kernels import squared_distances, squared_exponential

NAMED: tuple[Name, ...] = ("matern12", "matern32", "matern52", "rational-quadratic")
named = pytest.mark.parametrize("kernel", NAMED)
MODELS = ("gp", "fitc", "vfe")


def gram(kernel: str, a: Any, b: Any, length: Any, shape: float = 1.0) -> Any:
    """The covariance of scikit-learn."""
    if kernel == "rational-quadratic":
        return RationalQuadratic(length_scale=1.0, alpha=shape)(a / length, b / length)
    return Matern(length_scale=length, nu=KERNELS[kernel])(a, b)


def conditioned(name: str, kernel: str, missing: bool = False, **settings: Any) -> Any:
    """A model under hyperparameters away from its starting values."""
    data = pairs(missing)
    inducing = {} if name == "gp" else {"inducing": 15, "compare": False, "jitter": 1e-4}
    model = zoo.create(name, data, kernel=kernel, **inducing, **settings).model
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model.condition(data)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        model.log_length.fill_(0.3)
        model.log_noise.fill_(-2.5)
        for parameter in filter(lambda p: p.requires_grad, model.parameters()):
            step = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.add_(0.3 * step)
    return model


@named
@pytest.mark.parametrize("length", [[0.7], [0.4, 1.0, 30.0]], ids=["one", "ard"])
def test_covariances_are_those_of_scikit_learn(kernel: Name, length: list[float]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(9, 3)), rng.normal(size=(5, 3))
    shape = torch.tensor(2.5, dtype=torch.float64) if kernel == "rational-quadratic" else None
    lengths = torch.tensor(length, dtype=torch.float64)
    for x, y in ((a, b), (a, a)):
        first = torch.from_numpy(x)
        second = first if y is x else torch.from_numpy(y)
        found = stationary(kernel, first, second, lengths, shape)
        assert found.numpy() == pytest.approx(gram(kernel, x, y, np.array(length), 2.5), abs=1e-12)
    assert bool((stationary(kernel, first, first, lengths, shape).diagonal() == 1).all())


def test_the_squared_exponential_keeps_its_bits() -> None:
    x = torch.from_numpy(np.random.default_rng(0).normal(size=(9, 3)))
    length = torch.tensor([0.7], dtype=torch.float64)
    before = squared_exponential(squared_distances(x / length, x / length), x.new_zeros(()))
    assert torch.equal(stationary("squared-exponential", x, x, length), before)
    for name in MODELS:
        assert "log_shape" not in zoo.create(name, pairs()).model.state_dict()


@named
@pytest.mark.parametrize("missing", [False, True])
@torch.no_grad()
def test_the_evidence_of_gp_is_the_dense_formula(kernel: str, missing: bool) -> None:
    model, data, total = conditioned("gp", kernel, missing), pairs(missing), 0.0
    for p in range(2):
        rows = data.mask[:, p].numpy()
        x, y = data.inputs.numpy()[rows], data.targets.numpy()[rows, p]
        shape = 1.0 if model.log_shape is None else math.exp(model.log_shape[p])
        noise = model.noise[p].item() * np.eye(len(y))
        c = gram(kernel, x, x, model.length[p].detach().numpy(), shape) + noise
        signal = y @ np.linalg.solve(c, y) / len(y)
        total -= multivariate_normal(cov=signal * c).logpdf(y)
    assert model.objective().item() == pytest.approx(total, rel=1e-9)


@named
@pytest.mark.parametrize("bound", ["fitc", "vfe"])
@torch.no_grad()
def test_the_bounds_are_the_dense_formula(kernel: str, bound: str) -> None:
    model, data, total = conditioned(bound, kernel, True), pairs(True), 0.0
    z, length = model.inducing.numpy(), model.length.detach().numpy()
    shape = 1.0 if model.log_shape is None else math.exp(model.log_shape)
    noise = model.noise.item()
    k_uu = gram(kernel, z, z, length, shape) + model.config.jitter * np.eye(len(z))
    for p in range(2):
        rows = data.mask[:, p].numpy()
        y = data.targets.numpy()[rows, p]
        k_fu = gram(kernel, data.inputs.numpy()[rows], z, length, shape)
        q = k_fu @ np.linalg.solve(k_uu, k_fu.T)
        left = np.diag(1 - np.diag(q))
        c = q + left * (bound == "fitc") + noise * np.eye(len(y))
        signal = y @ np.linalg.solve(c, y) / len(y)
        total -= multivariate_normal(cov=signal * c).logpdf(y)
        total += 0 if bound == "fitc" else np.trace(left) / (2 * noise)
    assert model.objective().item() == pytest.approx(total, rel=1e-9)


@named
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("gp", {}),
        ("gp", {"ard": True, "shared": True}),
        ("fitc", {}),
        ("vfe", {"ard": True}),
        ("fitc", {"learn_inducing": True}),
    ],
    ids=["gp", "gp-ard", "fitc", "vfe-ard", "fitc-learned"],
)
def test_gradients_are_the_differences(kernel: str, name: str, settings: dict[str, Any]) -> None:
    model = conditioned(name, kernel, True, **settings)
    evaluate = evaluator(model)
    trained = [p for p in model.parameters() if p.requires_grad]
    x = torch.nn.utils.parameters_to_vector(trained).detach().numpy().copy()
    _, gradient = evaluate(x)
    rng = np.random.default_rng(0)
    for _ in range(2):
        d = rng.normal(size=x.shape) / math.sqrt(x.size)
        # a distance of 0 that is computed as √eps moves a kernel with a kink: the steps are large
        steps = [evaluate(x + h * d)[0] for h in (-4e-3, -2e-3, 2e-3, 4e-3)]
        slope = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / 24e-3
        assert gradient @ d == pytest.approx(slope, rel=1e-5)


@named
@torch.no_grad()
def test_the_posterior_of_gp_is_the_dense_formula(kernel: str) -> None:
    model, data = conditioned("gp", kernel, shared=True), pairs()
    model.settle()
    x, new = data.inputs.numpy(), np.random.default_rng(2).normal(size=(6, 3))
    length = model.length[0].detach().numpy()
    shape = 1.0 if model.log_shape is None else math.exp(model.log_shape[0])
    c = gram(kernel, x, x, length, shape) + model.noise[0].item() * np.eye(len(x))
    cross = gram(kernel, x, new, length, shape)
    answer = model.regress(torch.from_numpy(new), draws=0)
    mean = cross.T @ np.linalg.solve(c, data.targets.numpy())
    left = 1 - np.einsum("nm,nm->m", cross, np.linalg.solve(c, cross))
    assert answer.location[0].numpy() == pytest.approx(mean, rel=1e-8)
    variance = left[:, None] * model.signal.numpy()
    assert answer.epistemic[0].square().numpy() == pytest.approx(variance, rel=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_trainings_keep_the_laws_and_survive_the_disk(name: str, tmp_path: Any) -> None:
    """Bound and answers under a Matérn kernel; a rational quadratic comes back with its α."""
    quick = {"iterations": 5} | ({} if name == "gp" else {"inducing": 0.8, "compare": False})
    run = zoo.fit(zoo.create(name, pairs(), kernel="matern32", **quick), pairs())
    check_exact(run)
    check_uniform(judged(run, "regress"))
    made = zoo.create(name, pairs(), kernel="rational-quadratic", **quick)
    run = zoo.fit(made, pairs())
    assert bool(run.model.log_shape.detach().any())
    again = zoo.load(run.save(tmp_path / "run"))
    asked = pairs().inputs[:5].numpy() + 0.1
    assert torch.equal(again.regress(asked).mean, run.regress(asked).mean)


def test_kernels_are_refused_and_told_by_name() -> None:
    for config in (gp.Config, sparse_gp.Config):
        with pytest.raises(ValueError, match="kernel must be 'squared-exponential', 'matern12'"):
            config(kernel="rbf")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="gp: kernel must be"):
        zoo.create("gp", pairs(), kernel="rbf")
    values = zoo.card("fitc").to_json()["settings"]["kernel"]
    assert values["default"] == "squared-exponential" and "matern52" in values["type"]
    assert "gpytorch" in zoo.card("gp").text and "gpytorch" in zoo.card("vfe").text
