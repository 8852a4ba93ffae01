"""DVBF by other roads: the per-step program, a Kalman filter's likelihood, and a pendulum."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyro.distributions as dist
import pyro.poutine as poutine
import pytest
import torch
from torch import Tensor

import zoo
from zoo.datasets.records import Sequences
from zoo.evaluation.questions import Setup
from zoo.guides.sequential import Config as GuideConfig
from zoo.guides.sequential import SequentialGuide
from zoo.inference.elbo import divergences, sites
from zoo.inference.loader import whole
from zoo.models.filters.dvbf import Config, Dvbf
from zoo.models.filters.locally_linear import LocallyLinear
from zoo.types import Batch

LATENT, FRAMES, CHANNELS = 2, 7, 3


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    """All of this in float64."""
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(torch.float32)


def movements(controls: bool) -> Sequences:
    """Four random walks, with an action where wanted."""
    values = torch.randn(4, FRAMES, CHANNELS).cumsum(1).numpy()
    actions = torch.randn(4, FRAMES, 1).numpy()
    named = {"controls": list(actions), "control_names": ["torque"], "control_units": "N"}
    return Sequences.from_arrays(list(values), rate=30.0, **(named if controls else {}))


def build(data: Sequences, **settings: object) -> tuple[Dvbf, SequentialGuide, Batch]:
    """Model, guide and all movements as one batch."""
    model = Dvbf(data.layout, Config(latent_dim=LATENT, hidden=6, bases=3, **settings))
    guide = SequentialGuide(data.layout, model, GuideConfig(hidden=6, memory=2))
    return model, guide, whole(data)


def by_hand(model: Dvbf, w: Tensor, actions: Tensor | None) -> Tensor:
    """(85) matrix by matrix, window by window."""
    moves, paths = model.transition, []
    for i in range(len(w)):
        z = model.begin(w[i, 0])
        states = [z]
        for t in range(1, w.shape[1]):
            known = z if actions is None else torch.cat([z, actions[i, t - 1]])
            α = torch.softmax(moves.weights(known), 0)
            A, C = (torch.einsum("i,ijk->jk", α, m) for m in (moves.A, moves.C))
            z = z @ A + w[i, t] @ C
            if actions is not None:
                z = z + actions[i, t - 1] @ torch.einsum("i,ijk->jk", α, moves.B)
            states.append(z)
        paths.append(torch.stack(states))
    return torch.stack(paths)


def _density(site: dict[str, Any]) -> Tensor:
    return site["fn"].log_prob(site["value"]).sum()


@pytest.mark.parametrize("controls", [False, True])
def test_both_programs_are_those_of_the_equations(controls: bool) -> None:
    """Log densities of every site, and gradients, against loops over windows and steps."""
    model, guide, batch = build(movements(controls))
    found = sites(model, guide, batch)
    w = found.guide["w"]["value"]
    actions = None if batch.inputs is None else batch.inputs[:, :-1]
    path = by_hand(model, w, actions)
    x = dist.Normal(model.decoder(path), model.output_std).log_prob(batch.values).sum()
    prior = dist.Normal(0.0, 1.0).log_prob(w).sum()
    known = [batch.values[:, :2]] if actions is None else [batch.values[:, :2], actions[:, :2]]
    mean, std = guide.first(guide.trunk(torch.cat(known, -1).flatten(1)))
    q = dist.Normal(mean, std).log_prob(w[:, 0]).sum()
    for t in range(FRAMES - 1):
        after = [batch.values[:, t + 1]] + ([] if actions is None else [actions[:, t]])
        moments = guide.noise(guide.noise.features(torch.cat(after, -1)), path[:, t])
        q = q + dist.Normal(*moments).log_prob(w[:, t + 1]).sum()
    parameters = [*model.parameters(), *guide.parameters()]
    traced = sum(_density(site) for site in found.model.values())
    torch.testing.assert_close(traced, x + prior)
    torch.testing.assert_close(_density(found.guide["w"]), q)
    ours = torch.autograd.grad(traced - _density(found.guide["w"]), parameters, retain_graph=True)
    for a, b in zip(ours, torch.autograd.grad(x + prior - q, parameters), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9)
    assert set(divergences(found)) == {"w"}


def test_a_value_that_was_not_drawn_has_the_same_density() -> None:
    """The kept moments and those along the states of a value agree."""
    model, guide, batch = build(movements(False))
    noise = sites(model, guide, batch).guide["w"]["fn"]
    value = noise.rsample()
    torch.testing.assert_close(noise.log_prob(value), noise.log_prob(value.clone()))


def test_recognition_sees_the_actions() -> None:
    """The same frames and states under other actions have other noise, at the steps they act on."""
    _, guide, batch = build(movements(True))
    assert batch.inputs is not None
    other = batch.inputs.clone()
    other[:, 4] += 1.0

    def moments(actions: Tensor) -> tuple[Tensor, Tensor]:
        acted = replace(batch, inputs=actions)
        noise = poutine.trace(guide).get_trace(acted).nodes["w"]["fn"]
        noise.step = lambda z, w, a: 0.9 * z + w
        return noise.moments(torch.ones(4, FRAMES, LATENT))

    for before, after in zip(moments(batch.inputs), moments(other), strict=True):
        changed = (before != after).any(-1).any(-1)
        assert changed.tolist() == [t == 5 for t in range(FRAMES)]


def test_one_basis_is_a_linear_gaussian_model() -> None:
    """Draws of the model have the moments of the linear recursion, within six standard errors."""
    moves = LocallyLinear(LATENT, bases=1, noise_scale=0.5)
    count = 20_000
    start, noise = torch.randn(count, LATENT), torch.randn(count, 4, LATENT)
    with torch.no_grad():
        z = moves.path(start, noise)[:, -1]
    A, C = moves.A[0].detach(), moves.C[0].detach()
    covariance = torch.eye(LATENT)
    for _ in range(4):
        covariance = A.T @ covariance @ A + C.T @ C
    size = covariance.diagonal()
    error = (size[:, None] * size + covariance**2).sqrt() / count**0.5
    assert bool(((torch.cov(z.T) - covariance).abs() < 6 * error).all())
    assert bool((z.mean(0).abs() < 6 * (size / count).sqrt()).all())


def test_actions_to_come_are_needed_and_named() -> None:
    """A forecast without them cannot be given."""
    data = movements(True)
    model, _, batch = build(data)
    with pytest.raises(ValueError, match=r"controls \(torque\) of the first 99"):
        model.actions(batch, 99)


@pytest.fixture(scope="module")
def pendulum() -> Sequences:
    """Swings with a known random torque."""
    torch.set_default_dtype(torch.float32)
    rng = np.random.default_rng(0)
    count, frames, dt = 60, 30, 0.1
    angle, speed = rng.normal(0, 1, count), rng.normal(0, 1, count)
    torque = rng.normal(0, 4, (count, frames))
    states = []
    for t in range(frames):
        states.append(np.stack([np.sin(angle), np.cos(angle), speed], -1))
        speed = speed + dt * (torque[:, t] - 4 * np.sin(angle) - 0.2 * speed)
        angle = angle + dt * speed
    values = np.stack(states, 1)
    return Sequences.from_arrays(
        list(values), rate=10.0, controls=list(torque[..., None]), control_names=["torque"]
    )


def test_knowing_the_torque_forecasts_better(pendulum: Sequences) -> None:
    """Half the error of the same model without controls, and less than the last value's."""
    torch.set_default_dtype(torch.float32)
    blind = Sequences.from_arrays(list(pendulum.arrays), rate=10.0)
    setup = Setup(seen=10, horizon=10, draws=50)
    errors = {}
    for name, data in (("seeing", pendulum), ("blind", blind)):
        train, test = data[:45], data[45:]
        run = zoo.fit(zoo.create("dvbf", train, seed=0, epochs=60, latent_dim=4), train)
        errors[name] = zoo.evaluate(run, test, tasks=["forecast"], setup=setup)["forecast"]["rmse"]
    assert errors["seeing"].value < 0.7 * errors["blind"].value
