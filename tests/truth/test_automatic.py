"""Guides that Pyro makes: against the closed-form q(u) of VFE, and on disk."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import Predictive, Trace_ELBO
from pyro.infer.autoguide import AutoNormal
from support import movements

import zoo
from zoo.datasets.records import Pairs
from zoo.errors import RunExistsError, UnknownNameError
from zoo.guides.exact import Config, ExactPosterior
from zoo.inference.elbo import bound, tight_bound
from zoo.inference.loader import whole
from zoo.types import Batch

SETTINGS = {"inducing": 8, "batch_size": 60, "patience": None}


def pairs() -> Pairs:
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, size=(60, 1))
    y = np.concatenate([np.sin(2 * x), np.cos(x)], 1) + 0.3 * rng.normal(size=(60, 2))
    return Pairs.from_arrays(x, y)


def test_a_full_gaussian_comes_to_the_closed_form_posterior() -> None:
    data = pairs()
    settings = {**SETTINGS, "epochs": 500, "learning_rate": 0.05}
    run = zoo.fit(zoo.create("vfe", data, guide="auto-multivariate-normal", **settings), data)
    guide, batch = run.assembly.guide, whole(run.exchange.scaled(data))
    assert guide is not None
    exact = run.model.posterior_sites(batch).of["v"]({})  # type: ignore[operator]
    mean, root = guide.moments()["v"]  # type: ignore[operator]
    deviation = exact.variance.sqrt().detach()
    assert float(((mean - exact.mean.detach()) / deviation).abs().max()) < 0.5
    ratio = root.square().sum(-1).sqrt() / deviation
    assert float(ratio.min()) > 0.6 and float(ratio.max()) < 1.4
    with torch.no_grad():
        bounds = torch.stack([bound(run.model, guide, batch).elbo for _ in range(100)])
        optimum = bound(run.model, ExactPosterior(data.layout, run.model, Config()), batch).elbo
    assert optimum - 2.0 < bounds.mean() < optimum + 6 * bounds.std() / 10
    closed = zoo.fit(zoo.create("vfe", data, inducing=8), data).regress(data)
    found = run.regress(data)
    assert float((found.mean - closed.mean).abs().max()) < 0.15


@pytest.mark.parametrize("guide", ["auto-delta", "auto-normal", "auto-multivariate-normal"])
def test_answers_are_those_of_draws_through_the_program(guide: str) -> None:
    data = pairs()
    run = zoo.fit(zoo.create("fitc", data, guide=guide, epochs=60, **SETTINGS), data)
    batch = whole(run.exchange.scaled(data)).unobserved()
    pyro.set_rng_seed(0)
    draw = Predictive(run.model, guide=run.assembly.guide, num_samples=4000, parallel=True)
    with torch.no_grad():
        y = draw(batch)["y"].reshape(4000, 2, 60)
    scale, shift = run.scaler.channel_scale, run.scaler.channel_shift
    drawn = y.movedim(1, 2) * scale + shift
    found = run.regress(data)
    error = found.std / math.sqrt(4000)
    assert float(((drawn.mean(0) - found.mean) / error).abs().max()) < 6
    assert float((drawn.std(0) / found.std - 1).abs().max()) < 6 / math.sqrt(2 * 4000)


def test_saved_loaded_and_resumed_in_the_same_bits(tmp_path: object) -> None:
    data = pairs()
    settings = {**SETTINGS, "guide": "auto-normal", "checkpoint_every": 1}
    run = zoo.fit(zoo.create("fitc", data, epochs=4, **settings), data, run_dir=f"{tmp_path}/a")
    again = zoo.load(f"{tmp_path}/a")
    assert again.assembly.settings["guide"] == "auto-normal"
    assert torch.equal(run.regress(data).mean, again.regress(data).mean)
    same = zoo.create("fitc", data, epochs=4, **settings)
    resumed = zoo.fit(same, data, run_dir=f"{tmp_path}/a", resume="must")
    assert torch.equal(run.regress(data).mean, resumed.regress(data).mean)
    other = zoo.create("fitc", data, epochs=4, **{**settings, "guide": "auto-delta"})
    with pytest.raises((RunExistsError, ValueError), match="guide"):
        zoo.fit(other, data, run_dir=f"{tmp_path}/a", resume="must")


def test_two_trainings_do_not_share_parameters() -> None:
    data, before = pairs(), set(pyro.get_param_store())
    runs = [
        zoo.fit(zoo.create("vfe", data, guide="auto-normal", epochs=n, **SETTINGS), data)
        for n in (3, 30, 3)
    ]
    first, _, third = (run.regress(data).mean for run in runs)
    assert torch.equal(first, third)
    assert set(pyro.get_param_store()) == before


def test_names_that_are_no_guide_are_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"auto-delta, auto-normal, .*; got 'auto'"):
        zoo.create("fitc", pairs(), guide="auto")
    with pytest.raises(ValueError, match="init_scale must be positive; got 0"):
        zoo.create("fitc", pairs(), guide="auto-normal", init_scale=0)


def test_constrained_sites_keep_their_jacobian_in_the_tight_bound() -> None:
    def model(batch: Batch) -> None:
        scale = pyro.sample("scale", dist.LogNormal(0.0, 1.0))
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            x = dist.Normal(torch.zeros_like(batch.values), scale).to_event(2)
            pyro.sample("x", x, obs=batch.values)

    batch = whole(movements().to(dtype=torch.float32))
    with pyro.settings.context(module_local_params=True):
        guide = AutoNormal(model)
        guide(batch)
        for estimator in (bound, tight_bound):
            pyro.set_rng_seed(1)
            ours = estimator(model, guide, batch).loss
            pyro.set_rng_seed(1)
            theirs = Trace_ELBO().differentiable_loss(model, guide, batch)
            torch.testing.assert_close(ours, theirs)
