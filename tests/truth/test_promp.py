"""Probabilistic movement primitives: learning, exact conditioning and generation by other roads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro.poutine as poutine
import pytest
import torch

from zoo.datasets.records import Sequences
from zoo.errors import NotFittedError
from zoo.inference.loader import whole
from zoo.models.primitives.promp import Config, ProMP
from zoo.models.primitives.weight_learning import (
    EntryNoise,
    Single,
    learn_weights,
    similarity,
    views_of,
)
from zoo.models.primitives.weights import Basis, Weights
from zoo.movement.timing import Timing
from zoo.streams import seeded
from zoo.types import Wishes

FRAMES, CHANNELS, KERNELS = 30, 3, 5


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def drawn(count, *, seed=0, lengths=(FRAMES,), noise=0.05, missing=0.0):
    """Movements drawn from a primitive, with the model that drew them."""
    size = KERNELS * CHANNELS
    truth = ProMP(layout(), Config(kernels=KERNELS))
    truth.mean = normal(size, seed=1)
    truth.root = torch.linalg.cholesky(0.1 * torch.eye(size) + rank_two(size))
    truth.noise = torch.full((CHANNELS,), noise, dtype=torch.float64)
    truth.synergies, truth.offset = torch.eye(CHANNELS).double(), torch.zeros(CHANNELS).double()
    truth.units = torch.tensor([n - 1.0 for n in lengths], dtype=torch.float64)
    truth.offsets = torch.zeros_like(truth.units)
    truth.scales = truth.information = torch.ones(1, dtype=torch.float64)
    with seeded(seed, "cpu"):
        w = truth.weights.sample(count)
        arrays = []
        for i in range(count):
            frames = lengths[i % len(lengths)]
            y = truth.basis(frames, Timing(frames - 1.0)).path(w[i])
            x = y + noise * torch.randn_like(y)
            x[torch.rand_like(y) < missing] = torch.nan
            arrays.append(x.numpy())
    return truth, Sequences.from_arrays(arrays, rate=30.0), w


def rank_two(size):
    loading = normal(size, 2, seed=2)
    return loading @ loading.T


def gaussian(model):
    """The model with one scale, every entry counted whole: a Gaussian for every timing."""
    model.scales = model.information = torch.ones(1, dtype=torch.float64)
    return model


def layout():
    return Sequences.from_arrays([np.zeros((FRAMES, CHANNELS))], rate=30.0).layout


def dense(model, timing=None):
    """Mean and covariance of x as one vector over (time, channel)."""
    basis = model.basis(FRAMES, Timing(FRAMES - 1.0) if timing is None else timing)
    phases, synergies = basis.phases, basis.synergies
    design = torch.einsum("tk,cj->tcjk", phases, synergies).reshape(FRAMES * CHANNELS, -1)
    mean = design @ model.mean + model.offset.repeat(FRAMES)
    path = design @ model.weights.covariance @ design.T
    return mean, path, model.noise.square().repeat(FRAMES).diag()


def check_conditional(model, data, prediction, seen, part):
    """Mean, spread and draws against the dense Gaussian conditional."""
    mean, path, noise = dense(model)
    known = seen.flatten()
    gain = torch.linalg.solve((path + noise)[known][:, known], path[known]).T
    for i, x in enumerate(data):
        expected = mean + gain @ (x.flatten()[known] - mean[known])
        spread = (path - gain @ path[known]).diagonal().clamp_min(0).sqrt()
        found = prediction.location[0, i], prediction.epistemic[0, i]
        like = (expected.view(FRAMES, CHANNELS)[part], spread.view(FRAMES, CHANNELS)[part])
        torch.testing.assert_close(found[0], like[0], rtol=0, atol=1e-8)
        torch.testing.assert_close(found[1], like[1], rtol=0, atol=1e-6)


def test_path_and_its_adjoint_are_the_dense_design():
    basis = Basis(normal(6, 4), normal(3, 2, seed=1))
    design = torch.einsum("tk,cj->tcjk", basis.phases, basis.synergies).reshape(18, 8)
    w, x, weight = normal(5, 8, seed=2), normal(5, 6, 3, seed=3), normal(6, 3, seed=4).square()
    torch.testing.assert_close(basis.path(w).flatten(1), w @ design.T)
    torch.testing.assert_close(basis.linear(x), x.flatten(1) @ design)
    torch.testing.assert_close(basis.precision(weight), design.T @ weight.flatten().diag() @ design)


def test_log_density_is_that_of_the_dense_gaussian():
    model, data, _ = drawn(4, missing=0.2)
    mean, path, noise = dense(model)
    for i in range(4):
        view = views_of(model.basis, [(data.values[i], data.mask[i])], [Timing(FRAMES - 1.0)])[0]
        known = data.mask[i].flatten()
        expected = torch.distributions.MultivariateNormal(
            mean[known], (path + noise)[known][:, known]
        ).log_prob(data.values[i].flatten()[known])
        found = view.log_density(model.weights, EntryNoise(model.noise.square()))
        torch.testing.assert_close(found[0, 0], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("synergies", [None, 2])
def test_forecast_and_filled_gaps_are_the_conditional_of_the_dense_gaussian(synergies):
    _, data, _ = drawn(12)
    model = ProMP(data.layout, Config(kernels=KERNELS, synergies=synergies))
    model.condition(data)
    gaussian(model)
    seen = torch.zeros(FRAMES, CHANNELS, dtype=torch.bool)
    seen[:8] = True
    future = model.forecast(whole(data.first(8)), None, horizon=FRAMES - 8, draws=3)
    check_conditional(model, data.values, future, seen, slice(8, None))
    holes = torch.rand(FRAMES, CHANNELS, generator=generator(5)) < 0.6
    holes[12:20], holes[:, 1] = False, False
    holed = replace(data, mask=holes.expand_as(data.mask), values=data.values * holes)
    check_conditional(model, data.values, model.impute(whole(holed), None, draws=3), holes, ...)


def test_draws_have_the_moments_of_the_answer():
    model, data, _ = drawn(2)
    with seeded(0, "cpu"):
        answer = model.forecast(whole(data.first(6)), None, horizon=20, draws=4000)
    spread = answer.epistemic[0]
    error = (answer.draws.mean(0) - answer.location[0]) / spread * math.sqrt(4000)
    assert float(error.abs().max()) < 6
    ratio = answer.draws.std(0) / spread - 1
    assert float(ratio.abs().max()) < 6 / math.sqrt(2 * 4000)


def test_expectation_maximisation_never_loses():
    _, data, _ = drawn(15, missing=0.2, lengths=(FRAMES, 24))
    model = ProMP(data.layout, Config(kernels=KERNELS))
    model.synergies = torch.eye(CHANNELS, dtype=torch.float64)
    rows = zip(data.values, data.mask, data.lengths.tolist(), strict=True)
    inside = [(x[:n], seen[:n]) for x, seen, n in rows]
    views = views_of(model.basis, inside, [Timing(len(x) - 1.0) for x, _ in inside])
    single = Single.of(views, similarity(KERNELS, circular=False))
    found = learn_weights(single, views, 0.2, iterations=15, tolerance=0.0)
    gains = np.diff(found.objective)
    assert len(gains) >= 5 and gains.min() > -1e-7 * abs(found.objective[-1])


def test_parameters_are_recovered():
    truth, data, w = drawn(400)
    model = ProMP(data.layout, Config(kernels=KERNELS, shrinkage=0.02, em_iterations=10))
    model.condition(data)
    error = (model.mean - truth.mean) / (w.var(0) / 400).sqrt()
    assert float(error.abs().max()) < 6
    torch.testing.assert_close(model.noise, truth.noise, rtol=0.05, atol=0)
    sample = torch.cov(w.T)
    found = model.weights.covariance
    assert float((found - sample).norm() / sample.norm()) < 0.1


def test_bands_cover_what_they_promise():
    _, data, _ = drawn(240, seed=3)
    model = ProMP(data.layout, Config(kernels=KERNELS, em_iterations=10))
    model.condition(data[:120])
    answer = model.forecast(whole(data[120:].first(8)), None, horizon=FRAMES - 8, draws=2)
    scale = (answer.noise.square() + answer.epistemic.square()).sqrt()[0]
    inside = (data.values[120:, 8:] - answer.location[0]).abs() < 1.6449 * scale
    each = inside.double().mean((1, 2))
    assert abs(float(each.mean()) - 0.9) < 4 * float(each.std()) / math.sqrt(120) + 0.01


def test_generative_program_is_the_model():
    model, data, w = drawn(3)
    first = torch.zeros(3, dtype=torch.long)
    given = poutine.condition(model, data={"timing": first, "scale": first, "w": w})
    trace = poutine.trace(given).get_trace(whole(data))
    trace.compute_log_prob()
    expected = model.weights.root
    prior = torch.distributions.MultivariateNormal(model.mean, scale_tril=expected)
    torch.testing.assert_close(trace.nodes["w"]["log_prob"], prior.log_prob(w))
    path = model.basis(FRAMES, Timing(FRAMES - 1.0)).path(w)
    noise = torch.distributions.Normal(path, model.noise).log_prob(data.values).sum((1, 2))
    torch.testing.assert_close(trace.nodes["x"]["log_prob"], noise)


def test_a_goal_is_the_conditional_of_the_population_moved_onto_the_demonstration():
    metric = Weights(normal(10), normal(10, 10, seed=1) / 3)
    basis = Basis(normal(7, 5, seed=2), torch.eye(2, dtype=torch.float64))
    demonstration, goal = Weights(normal(1, 10, seed=3), 0 * metric.root), normal(2, seed=4)
    moved = demonstration.moved(basis, goal, metric, 0.0)
    ends = basis.path(torch.eye(10, dtype=torch.float64))[:, [0, -1]].flatten(1)
    wanted = torch.cat([demonstration.mean[0] @ ends[:, :2], goal])
    exact = Weights(demonstration.mean, metric.root).condition(
        1e8 * ends @ ends.T, (1e8 * ends @ wanted)[None]
    )
    torch.testing.assert_close(moved.mean, exact.mean, rtol=1e-4, atol=1e-4)
    path = basis.path(moved.mean)[0]
    torch.testing.assert_close(path[-1], goal)
    torch.testing.assert_close(path[0], basis.path(demonstration.mean)[0, 0])


def test_rhythmic_movements_swing_about_their_goal_and_keep_their_phase():
    time = np.arange(60)[:, None] / 20
    waves = [
        np.sin(2 * np.pi * (time + shift) + [0.0, 1.0]) + 0.01 * normal(60, 2, seed=i).numpy()
        for i, shift in enumerate(np.linspace(0, 0.9, 8))
    ]
    data = Sequences.from_arrays(waves, rate=30.0)
    model = ProMP(data.layout, Config(kind="rhythmic", kernels=9))
    model.condition(data)
    answer = model.forecast(whole(data.first(25)), None, horizon=35, draws=16)
    error = (answer.location.mean(0) - data.values[:, 25:]).square().mean().sqrt()
    assert float(error) < 0.2
    goal = torch.tensor([[2.0, -1.0]], dtype=torch.float64)
    new = model.generate(whole(data[:1]), None, wishes=Wishes(goal=goal), draws=2)
    torch.testing.assert_close(new.location[0, 0].mean(0), goal[0], rtol=0, atol=0.05)


def test_durations_of_training_movements_are_the_timings_of_a_forecast():
    _, data, _ = drawn(20, lengths=(24, FRAMES))
    model = ProMP(data.layout, Config(kernels=KERNELS))
    model.condition(data)
    gaussian(model)
    assert model.units.tolist() == [23.0, 29.0]
    assert model.forecast(whole(data.first(6)), None, horizon=5, draws=16).location.shape[0] == 16
    assert model.forecast(whole(data.first(24)), None, horizon=5, draws=16).location.shape[0] == 1


def test_a_single_movement_and_an_untrained_model_are_refused():
    _, data, _ = drawn(2)
    model = ProMP(data.layout, Config())
    with pytest.raises(ValueError, match="at least 2 movements"):
        model.condition(data[:1])
    with pytest.raises(NotFittedError, match="promp"):
        model.impute(whole(data), None, draws=2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "square"}, "kind"),
        ({"kernels": 1}, "kernels"),
        ({"synergies": 0}, "synergies"),
        ({"period": -1.0}, "period"),
        ({"shrinkage": 1.0}, "shrinkage"),
        ({"information": 0.0}, "information"),
    ],
)
def test_settings_without_a_meaning_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Config(**settings)


def test_as_many_synergies_as_channels_are_the_channels():
    _, data, _ = drawn(6)
    models = [ProMP(data.layout, Config(kernels=KERNELS, synergies=n)) for n in (None, 3)]
    for model in models:
        model.condition(data)
    assert torch.equal(models[0].mean, models[1].mean)
    assert torch.equal(models[1].synergies, torch.eye(3, dtype=torch.float64))
