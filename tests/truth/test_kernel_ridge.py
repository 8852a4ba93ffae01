"""Kernel ridge regression: the same numbers by refitting, and patterns by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyro.poutine as poutine
import pytest
import torch

import zoo
from zoo.datasets.records import Sequences
from zoo.errors import NotFittedError
from zoo.inference.loader import whole
from zoo.models.baselines.kernel_ridge import Config, KernelRidge, Pattern
from zoo.models.baselines.ridge_regression import Kernel, Problem, held_out_squares, predicted

KERNEL = Kernel(1.5, 0.05)


def problem(places=24, features=3, targets=2):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(places, features, generator=generator, dtype=torch.float64)
    y = torch.stack([x.sin().sum(1), x[:, 0] * x[:, 1]], 1)[:, :targets]
    return Problem(x, y, torch.ones_like(y, dtype=torch.bool), torch.arange(places) % 5)


def by_hand(some, kernel, unit, x, y):
    """k(x)ᵀ(K + λI)⁻¹ y with a loop over pairs."""
    rows = [[float((a - b).square().sum()) for b in some] for a in some]
    near = [[float((a - b).square().sum()) for b in some] for a in x]
    gram = np.exp(-np.array(rows) / (2 * kernel.width**2 * unit))
    α = np.linalg.solve(gram + kernel.ridge * np.eye(len(some)), y.numpy())
    return np.exp(-np.array(near) / (2 * kernel.width**2 * unit)) @ α


def test_prediction_is_the_textbook_formula():
    p, queries = problem(), torch.randn(4, 3, dtype=torch.float64)
    unit = float(torch.cdist(p.inputs, p.inputs).square().mean())
    mean = p.outputs.mean(0)
    expected = mean.numpy() + by_hand(p.inputs, KERNEL, unit, queries, p.outputs - mean)
    np.testing.assert_allclose(predicted(KERNEL, p, queries)[0], expected, atol=1e-9)


def test_errors_of_groups_left_out_are_those_of_refitting():
    p = problem()
    unit = float(torch.cdist(p.inputs, p.inputs).square().mean())
    centred, square = p.outputs - p.outputs.mean(0), torch.zeros(2, dtype=torch.float64)
    for g in range(5):
        out = p.group == g
        found = by_hand(p.inputs[~out], KERNEL, unit, p.inputs[out], centred[~out])
        square += (centred[out] - torch.from_numpy(found)).square().sum(0)
    spread = predicted(KERNEL, p, p.inputs[:1])[1]
    torch.testing.assert_close(spread, (square / 24).sqrt(), rtol=1e-9, atol=0)
    torch.testing.assert_close(held_out_squares(p, [KERNEL])[0], square, rtol=1e-8, atol=0)


def test_agrees_with_scikit_learn():
    ridge = pytest.importorskip("sklearn.kernel_ridge")
    p, queries = problem(), torch.randn(4, 3, dtype=torch.float64)
    unit = float(torch.cdist(p.inputs, p.inputs).square().mean())
    gamma = 1 / (2 * KERNEL.width**2 * unit)
    peer = ridge.KernelRidge(alpha=KERNEL.ridge, kernel="rbf", gamma=gamma)
    mean = p.outputs.mean(0)
    expected = peer.fit(p.inputs, p.outputs - mean).predict(queries) + mean.numpy()
    np.testing.assert_allclose(predicted(KERNEL, p, queries)[0], expected, atol=1e-9)


def test_a_pattern_looks_to_both_sides_of_a_gap():
    mask = torch.ones(12, 2, dtype=torch.bool)
    mask[4:8], mask[9, 1] = False, False
    pattern = Pattern.at(5, mask, 2)
    assert pattern.offsets == (-3, -2, 3, 4)
    assert pattern.seen == ((True, True), (True, True), (True, True), (True, False))
    assert pattern.asked == (True, True) and pattern.reach == (3, 4)
    line = torch.zeros(7, 2, dtype=torch.float64)
    line[2, 0] = line[3, 1] = 1 - 2 / 5
    line[4, 0] = line[5, 1] = 1 - 3 / 5
    torch.testing.assert_close(pattern.line(), line)


def test_the_line_of_a_forecast_is_level():
    mask = torch.zeros(9, 1, dtype=torch.bool)
    mask[:3] = True
    assert Pattern.at(7, mask, 2).line().flatten().tolist() == [0.0, 1.0]


def sines(count=12, frames=30, seed=0):
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None] / 10
    phase = rng.uniform(0, 2 * np.pi, count)
    waves = [np.sin(time + p + [0.0, 1.0, 2.0]) for p in phase]
    noisy = [w + 0.02 * rng.normal(size=w.shape) for w in waves]
    return Sequences.from_arrays(noisy, rate=10.0)


def test_a_missing_channel_is_found_from_the_others_within_its_band():
    data = sines(30)
    model = KernelRidge(data.layout, Config())
    model.condition(data[:15])
    keep = torch.tensor([True, True, False])
    mask = data.mask[15:] & keep
    answer = model.impute(whole(replace(data[15:], mask=mask)), None, draws=1)
    error = data.values[15:, :, 2] - answer.location[0, :, :, 2]
    assert float(error.square().mean().sqrt()) < 0.03
    inside = (error.abs() < 1.6449 * answer.noise[0, :, :, 2]).double().mean(1)
    assert abs(float(inside.mean()) - 0.9) < 4 * float(inside.std()) / 15**0.5 + 0.03
    seen = data.values[15:, :, :2]
    torch.testing.assert_close(answer.location[0, :, :, :2], seen, rtol=0, atol=0)


def test_nothing_seen_is_the_mean_and_its_spread():
    data = sines(40)
    model = KernelRidge(data.layout, Config())
    model.condition(data)
    blank = replace(data[:1], mask=torch.zeros_like(data.mask[:1]))
    answer = model.impute(whole(blank), None, draws=1)
    mean, spread = data.values.mean((0, 1)), data.values.std((0, 1))
    torch.testing.assert_close(answer.location[0, 0, 4], mean, rtol=0, atol=0.05)
    torch.testing.assert_close(answer.noise[0, 0, 4], spread, rtol=0.1, atol=0)


def test_windows_of_one_movement_are_left_out_together():
    data = sines(6)
    data = Sequences.from_arrays(data.arrays, rate=10.0, groups={"trial": list("aabbcc")})
    windows = data.windows(20, stride=5)
    model = KernelRidge(windows.layout, Config())
    model.condition(windows)
    assert len(model.group.unique()) == 3


def test_too_short_a_memory_and_too_few_movements_are_named():
    data = sines()
    model = KernelRidge(data.layout, Config())
    with pytest.raises(NotFittedError, match="kernel-ridge"):
        model.impute(whole(data), None, draws=1)
    with pytest.raises(ValueError, match="at least 2 movements"):
        model.condition(data[:1])
    model.condition(data)
    with pytest.raises(ValueError, match="the longest has 30"):
        model.forecast(whole(data.first(10)), None, horizon=40, draws=1)


@pytest.mark.parametrize("settings", [{"context": 0}, {"places": 5}, {"noise_floor": 0.0}])
def test_settings_without_a_meaning_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Config(**settings)


def test_the_program_scores_a_movement_like_the_training_ones_higher_than_noise():
    data = sines()
    run = zoo.fit(zoo.create("kernel-ridge", data), data)
    scaled = run.scaler.apply(data)
    model = run.model
    scores = []
    for values in (scaled.values, scaled.values.flip(1)[:, torch.randperm(30)]):
        trace = poutine.trace(model).get_trace(whole(replace(scaled, values=values)))
        scores.append(float(trace.log_prob_sum()))
    assert scores[0] > scores[1]
