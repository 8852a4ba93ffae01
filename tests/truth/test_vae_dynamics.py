"""The autoencoder with dynamics against (71) by hand and linear-Gaussian prediction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from zoo.contract.strategies import Svi
from zoo.datasets import pendulum
from zoo.datasets.records import Sequences
from zoo.guides.amortised import Amortised
from zoo.guides.amortised import Config as GuideConfig
from zoo.inference.elbo import tight_bound
from zoo.inference.loader import Loader, whole
from zoo.inference.posterior import GuidePosterior
from zoo.inference.svi import fit_svi
from zoo.models.frames.vae_dynamics import Config, VAEDynamics
from zoo.prediction.predictive import Predictive


def movements(controls: bool = True) -> Sequences:
    """Three sequences of 12 frames of 4 channels, with one action."""
    rng = np.random.default_rng(0)
    actions = list(rng.normal(size=(3, 12, 1))) if controls else None
    return Sequences.from_arrays(rng.normal(size=(3, 12, 4)), rate=20.0, controls=actions)


def pair(data: Sequences, config: Config) -> tuple[VAEDynamics, Amortised]:
    """`vae-dynamics` and its guide with random parameters, in float64."""
    torch.manual_seed(0)
    model = VAEDynamics(data.layout, config)
    torch.nn.init.normal_(model.transition.weight, std=0.5)
    torch.nn.init.normal_(model.transition.bias)
    guide = Amortised(data.layout, model, GuideConfig(hidden=config.hidden))
    return model.double(), guide.double()


@pytest.mark.parametrize("controls", [True, False])
def test_bound_is_equation_71_by_hand(controls: bool) -> None:
    data = movements(controls)
    model, guide = pair(data, Config(latent_dim=2, hidden=(8,)))
    loader = Loader(data, batch_size=7, window=2)
    batch = loader.take(torch.arange(7))
    torch.manual_seed(3)
    ours = tight_bound(model, guide, batch)
    torch.manual_seed(3)
    q = guide.encode(batch.values[:, :1])
    z = q.rsample()
    if batch.inputs is not None:
        z = torch.cat([z, batch.inputs[:, :1]], -1)
    after = z @ model.transition.weight.T + model.transition.bias
    reconstruction = Normal(*model.decoder(after)).log_prob(batch.values[:, 1:]).sum()
    kl = kl_divergence(q, Normal(torch.zeros_like(q.mean), 1.0)).sum()
    expected = (reconstruction - kl) * loader.total / 7
    torch.testing.assert_close(ours.elbo, expected.detach(), rtol=1e-12, atol=1e-9)


def test_pairs_whose_successor_is_missing_add_nothing() -> None:
    data = movements()
    model, guide = pair(data, Config(latent_dim=2, hidden=(8,)))
    batch = whole(data)
    mask = torch.ones_like(batch.values, dtype=torch.bool)
    mask[:, -2:] = False
    blind = tight_bound(model, guide, replace(batch, mask=mask)).kl
    assert batch.inputs is not None
    short = replace(batch, values=batch.values[:, :-2], inputs=batch.inputs[:, :-2])
    torch.testing.assert_close(blind, tight_bound(model, guide, short).kl)


def linear_gaussian(data: Sequences) -> tuple[VAEDynamics, Amortised]:
    """Everything linear with constant spreads, so that every prediction is Gaussian."""
    model, guide = pair(data, Config(latent_dim=2, hidden=(), noise="constant"))
    with torch.no_grad():
        model.decoder.head.root.fill_(0.5)
        guide.encoder.head.root.weight.zero_()
        guide.encoder.head.root.bias.fill_(0.6)
    return model, guide


def exact_moments(
    model: VAEDynamics, guide: Amortised, start: Tensor, actions: Tensor
) -> list[tuple[Tensor, Tensor]]:
    """Means and covariances of x at every step by the linear-Gaussian recursion."""
    encode, decode = guide.encoder.head.mean, model.decoder.head.mean
    step = model.transition.weight
    spread = guide.encode(start).variance.diag()
    noise = model.decoder(torch.zeros(2).double())[1].square().diag()
    mean, covariance, found = start, torch.zeros(4, 4).double(), []
    for action in actions:
        z = encode(mean)
        p = encode.weight @ covariance @ encode.weight.T + spread
        mean = decode(step @ torch.cat([z, action]) + model.transition.bias)
        through = decode.weight @ step[:, :2]
        covariance = through @ p @ through.T + noise
        found.append((mean, covariance))
    return found


def assert_moments(prediction: Predictive, t: int, mean: Tensor, covariance: Tensor) -> None:
    """Marginal moments within six standard errors."""
    draws = len(prediction.location)
    variance = covariance.diagonal()
    assert prediction.noise is not None
    location = prediction.location[:, 0, t]
    assert bool(((location.mean(0) - mean).abs() < 6 * (variance / draws).sqrt()).all())
    ours = location.var(0) + prediction.noise[0, 0, t].square()
    assert bool(((ours - variance).abs() < 6 * variance * (2 / draws) ** 0.5).all())


@torch.no_grad()
def test_forecast_is_the_linear_gaussian_recursion() -> None:
    data = movements()
    model, guide = linear_gaussian(data)
    batch = whole(data)
    known = replace(batch, values=batch.values[:, :6])
    assert batch.inputs is not None
    exact = exact_moments(model, guide, batch.values[0, 5], batch.inputs[0, 5:11])
    torch.manual_seed(0)
    prediction = model.forecast(known, GuidePosterior(guide), horizon=6, draws=4000)
    assert prediction.location.shape == (4000, 3, 6, 4) and prediction.joint
    for t, (mean, covariance) in enumerate(exact):
        assert_moments(prediction, t, mean, covariance)


@torch.no_grad()
def test_reconstruction_is_the_one_step_prediction() -> None:
    data = movements()
    model, guide = linear_gaussian(data)
    batch = whole(data)
    torch.manual_seed(0)
    prediction = model.reconstruct(batch, GuidePosterior(guide), draws=4000)
    assert batch.inputs is not None
    for t in (1, 7, 11):
        start, action = batch.values[0, t - 1], batch.inputs[0, t - 1 : t]
        ((mean, covariance),) = exact_moments(model, guide, start, action)
        assert_moments(prediction, t, mean, covariance)


@torch.no_grad()
def test_controls_of_the_frames_to_come_are_asked_for_by_name() -> None:
    data = movements()
    model, guide = pair(data, Config(latent_dim=2, hidden=(8,)))
    batch = whole(data)
    posterior = GuidePosterior(guide)
    assert model.forecast(batch, posterior, horizon=1, draws=2).location.shape == (2, 3, 1, 4)
    with pytest.raises(ValueError, match=r"controls \(control_0\) of the first 14 frames; got 12"):
        model.forecast(batch, posterior, horizon=3, draws=2)
    with pytest.raises(ValueError, match="got 0"):
        model.reconstruct(replace(batch, inputs=None), posterior, draws=2)
    free, free_guide = pair(movements(False), Config(latent_dim=2, hidden=(8,)))
    free_batch = whole(movements(False))
    ahead = free.forecast(free_batch, GuidePosterior(free_guide), horizon=9, draws=2)
    assert ahead.location.shape == (2, 3, 9, 4)


def test_it_learns_the_pendulum_through_the_harness() -> None:
    data = pendulum.load(rollouts=12)
    train = data.to(dtype=torch.float32)
    model = VAEDynamics(data.layout, Config(latent_dim=2, hidden=(32,)))
    guide = Amortised(data.layout, model, GuideConfig(hidden=(32,)))
    strategy = Svi(epochs=3, window=2, batch_size=64)
    history = fit_svi(model, guide, train, strategy, seed=0)
    assert history.rows[-1]["loss"] < history.rows[0]["loss"]
    with pytest.raises(ValueError, match="at least 2 frames; got 1"):
        fit_svi(model, guide, train, Svi(epochs=1, window=1), seed=0)


def test_controls_of_the_frames_to_come_reach_the_batch() -> None:
    data = movements()
    known = replace(data.first(6), controls=data.controls)
    batch = whole(known[[2, 0]])
    assert batch.inputs is not None and data.controls is not None
    torch.testing.assert_close(batch.inputs, data.controls[[2, 0]])
    model, guide = pair(data, Config(latent_dim=2, hidden=(8,)))
    with torch.no_grad():
        ahead = model.forecast(batch, GuidePosterior(guide), horizon=6, draws=2)
    assert ahead.location.shape == (2, 2, 6, 4)
    windows = Loader(known, batch_size=3, window=2).take(torch.tensor([0, 4, 5]))
    assert windows.inputs is not None
    torch.testing.assert_close(windows.inputs[1], data.controls[0, 4:6])
    torch.testing.assert_close(windows.inputs[2], data.controls[1, 0:2])
