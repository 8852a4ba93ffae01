"""What channels of few movements have in common, and what each has alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import zoo
from zoo.datasets.records import Sequences
from zoo.models.primitives.communality import blocks, unshared

FRAMES, TOGETHER, ALONE, TRAINED, ASKED = 40, 10, 20, 10, 20


def movements(seed: int, count: int) -> Sequences:
    """The first ten channels are mixtures of three courses, nearly; the others are on their own."""
    mix = np.random.default_rng(0).normal(size=(3, TOGETHER))
    rng, time = np.random.default_rng(seed), np.linspace(0, 1, FRAMES)
    waves = np.cos(np.pi * np.outer(time, [1, 2, 3]))
    bumps = np.exp(-((time[:, None] - np.linspace(0, 1, 8)) ** 2) / 2 / 0.1**2)
    x = rng.normal(size=(count, TOGETHER + ALONE, 8)) @ bumps.T
    courses = rng.normal(size=(count, 3))
    x[:, :TOGETHER] *= 0.2
    x[:, :TOGETHER] += np.einsum("sk,tk,kc->sct", courses, waves, mix)
    values = x.transpose(0, 2, 1) + 0.01 * rng.normal(size=(count, FRAMES, TOGETHER + ALONE))
    return Sequences.from_arrays(values, rate=30.0, groups={"trial": range(count)})


def test_hidden_channels_follow_those_that_they_go_together_with() -> None:
    """Half of the mean's square error at most, although twice as many channels tell nothing."""
    train, test = movements(1, TRAINED), movements(2, ASKED)
    run = zoo.fit(zoo.create("dmp", train, kernels=10), train)
    hidden = torch.zeros_like(test.mask)
    hidden[..., :2] = True
    known = replace(test, mask=test.mask & ~hidden, values=torch.where(hidden, 0.0, test.values))
    error = (run.impute(known, draws=1, seed=0).mean - test.values)[hidden]
    usual = (train.values.mean(0) - test.values)[hidden]
    assert error.square().mean() < 0.5 * usual.square().mean()


def test_the_error_of_movements_left_out_is_that_of_ridges_without_them() -> None:
    """The closed form against ridges that are fitted again without each movement."""
    generator = torch.Generator().manual_seed(0)
    θ = torch.randn(6, 2, 3, generator=generator, dtype=torch.float64)
    θ[:, 1] = θ[:, 0] + 0.3 * θ[:, 1]
    deviation = θ - θ.mean(0)
    scaled = deviation / deviation.square().sum((0, 2)).sqrt()[:, None]
    assert blocks(2).tolist() == [0, 1]
    rows = [[_refitted(scaled, c, r) for c in (0, 1)] for r in (0.01, 0.1, 1.0, 10.0)]
    each = torch.tensor(rows, dtype=torch.float64)
    best = each[each.sum(1).argmin()]
    assert unshared(θ).tolist() == pytest.approx(best.clamp(0.02, 0.98).tolist(), rel=1e-9)


def _refitted(scaled: torch.Tensor, channel: int, ridge: float) -> float:
    """Square error of ``channel`` from the other one, over that of the mean of the rest."""
    count, error, usual = len(scaled), 0.0, 0.0
    x, y = scaled[:, 1 - channel] * count**0.5, scaled[:, channel]
    for i in range(count):
        rest = torch.arange(count) != i
        middle, mean = x[rest].mean(0), y[rest].mean(0)
        centred = x[rest] - middle
        gram = centred.mT @ centred + ridge * torch.eye(x.shape[1], dtype=x.dtype)
        weights = torch.linalg.solve(gram, centred.mT @ (y[rest] - mean))
        error += float((y[i] - mean - (x[i] - middle) @ weights).square().sum())
        usual += float((y[i] - mean).square().sum())
    return error / usual
