"""Populations of few movements: on average as wide as the error of a new movement, with t tails."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

import zoo
from zoo.datasets.records import Sequences
from zoo.models.primitives.population import ParameterShrinkage, estimate
from zoo.movement.response import discrete_basis

FRAMES, CHANNELS, KERNELS, MOVEMENTS, SETS = 24, 6, 5, 4, 24


def demonstrations(seed: int) -> Sequences:
    """Movements whose weights under promp's basis are standard normal, almost without noise."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(MOVEMENTS, KERNELS, CHANNELS))
    time = torch.arange(FRAMES, dtype=torch.float64)
    basis = discrete_basis(time, kernels=KERNELS, duration=FRAMES - 1.0).numpy()
    paths = basis @ w + 1e-3 * rng.normal(size=(MOVEMENTS, FRAMES, CHANNELS))
    return Sequences.from_arrays(paths, rate=30.0, groups={"trial": range(MOVEMENTS)})


def test_weights_of_few_movements_are_as_wide_as_a_new_one_is_far() -> None:
    """E (w_new − w̄)² = (1 + 1/n) σ²: the mean of what many sets of four movements promise."""
    sizes = []
    for seed in range(SETS):
        data = demonstrations(seed)
        settings = {"kernels": KERNELS, "shrinkage": 0.01, "information": 1.0, "scaling": "none"}
        run = zoo.fit(zoo.create("promp", data, **settings), data)
        sizes.append(float(run.model.weights.covariance.diagonal().mean()))
    error = np.sqrt(2 / (MOVEMENTS - 1) / (SETS * KERNELS * CHANNELS))
    assert np.mean(sizes) == pytest.approx(1 + 1 / MOVEMENTS, abs=5 * error)


def test_the_tails_of_few_movements_are_those_of_a_t() -> None:
    """The mixture of scales against scipy's t of n − 1 degrees of freedom."""
    data = demonstrations(0)
    settings = {"kernels": KERNELS, "shrinkage": 0.5, "information": 1.0}
    scales = zoo.fit(zoo.create("promp", data, **settings), data).model.scales.numpy()
    for level in (0.9, 0.95):
        far = stats.t.ppf(level, MOVEMENTS - 1)
        assert stats.norm.cdf(far / scales).mean() == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("shares", [ParameterShrinkage(0.05, 0.1), ParameterShrinkage(0.6, 0.5)])
def test_parameters_of_few_movements_are_as_wide_as_a_new_one_is_far(
    shares: ParameterShrinkage,
) -> None:
    """The same of dmp's population: its total variance over movements, whatever is shared."""
    generator, sets = torch.Generator().manual_seed(0), 200
    flat = torch.zeros(CHANNELS, KERNELS, KERNELS, dtype=torch.float64)
    sizes = []
    for _ in range(sets):
        shape = (MOVEMENTS, CHANNELS, KERNELS)
        θ = torch.randn(shape, generator=generator, dtype=torch.float64)
        found = estimate(θ, flat, shares, torch.zeros(KERNELS, dtype=torch.float64))
        parts = (found.loadings, found.private)
        sizes.append(sum(float(part.square().sum(-1).mean()) for part in parts))
    error = np.sqrt(2 / (MOVEMENTS - 1) / (sets * KERNELS * CHANNELS))
    assert np.mean(sizes) == pytest.approx(1 + 1 / MOVEMENTS, abs=5 * error)


def test_the_tails_of_few_primitives_are_those_of_a_t() -> None:
    """dmp's mixture of scales against scipy's t of n − 1 degrees of freedom."""
    data = demonstrations(0)
    scales = zoo.fit(zoo.create("dmp", data, kernels=KERNELS), data).model.scales.numpy()
    for level in (0.9, 0.95):
        far = stats.t.ppf(level, MOVEMENTS - 1)
        assert stats.norm.cdf(far / scales).mean() == pytest.approx(level, abs=0.01)
