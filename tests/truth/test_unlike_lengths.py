"""Movements of unlike length: each its own duration τ, learned as well as movements of one."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyro
import pytest
import torch
from pyro import poutine

import zoo
from zoo.datasets.records import Sequences
from zoo.inference.elbo import bound, sites
from zoo.inference.loader import Loader, whole
from zoo.models.primitives.imitator import Imitator
from zoo.movement.durations import stretched
from zoo.movement.paces import Paces
from zoo.movement.paths import PathPrior
from zoo.runs.run import Run
from zoo.types import Batch

CHANNELS, LATENT = 6, 3
UNLIKE = tuple(np.random.default_rng(2).integers(40, 71, 16).tolist())
ENCODED = ("ae-dmp", "sparse-ae-dmp", "ae-then-dmp")


def paths(lengths: tuple[int, ...]) -> Sequences:
    """The same movements whatever their lengths: functions of the phase alone."""
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(LATENT, CHANNELS))
    arrays = []
    for n in lengths:
        s = np.linspace(0, 1, n)[:, None]
        a, b = rng.normal(1, 0.2, 2)
        z = np.sin(1.5 * np.pi * s), b * s**2, a * b * np.cos(2 * np.pi * s)
        arrays.append(np.concatenate([a * z[0], *z[1:]], 1) @ mixing)
    return Sequences.from_arrays(arrays, rate=30.0)


@cache
def trained(name: str, unlike: bool, epochs: int) -> tuple[Run, Sequences]:
    data = paths(UNLIKE if unlike else (55,) * len(UNLIKE))
    known, new = data[:12], data[12:]
    return zoo.fit(zoo.create(name, known, epochs=epochs, latent_dim=LATENT), known), new


def inside(data: Sequences, values: torch.Tensor) -> torch.Tensor:
    """Root mean square error within the movements."""
    return (values - data.values)[data.mask].square().mean().sqrt()


SETTINGS = [("ae-dmp", 300), ("vae-dmp", 20)]


@pytest.mark.parametrize(("name", "epochs"), SETTINGS)
def test_the_same_paths_are_reconstructed_as_well_at_any_duration(name: str, epochs: int) -> None:
    errors = []
    for unlike in (False, True):
        run, new = trained(name, unlike, epochs)
        errors.append(inside(new, run.reconstruct(new, draws=8).mean))
    assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize(("name", "epochs"), SETTINGS)
def test_forecasts_know_no_duration_and_find_it(name: str, epochs: int) -> None:
    run, new = trained(name, True, epochs)
    seen, horizon = 25, 10
    true = new.values[:, seen : seen + horizon]
    answer = run.forecast(new.first(seen), horizon=horizon, draws=100)
    still = (true - new.values[:, seen - 1 : seen]).square().mean().sqrt()
    assert (answer.mean - true).square().mean().sqrt() < 0.5 * still


@pytest.mark.parametrize("name", ENCODED)
def test_the_bound_of_a_padded_batch_is_the_sum_of_its_movements(name: str) -> None:
    data = paths((30, 22, 41)).to(dtype=torch.float32)
    assembly = zoo.create(name, data, latent_dim=LATENT)
    model, guide = assembly.model.eval(), assembly.guide.eval()
    together = bound(model, guide, whole(data))
    alone = [bound(model, guide, whole(data[i])) for i in range(len(data))]
    constant = bound_of_weights(model)
    torch.testing.assert_close(
        together.elbo - constant, sum(b.elbo - constant for b in alone), rtol=1e-4, atol=1e-2
    )


def bound_of_weights(model: torch.nn.Module) -> torch.Tensor:
    """The prior of the decoder's weights counts once in every bound."""
    scale = model.config.weight_scale
    return torch.zeros(()) if scale is None else model._weight_prior(scale).detach()


def test_the_bound_of_windows_is_the_sum_over_movements() -> None:
    """Of the same draws: those of the padded batch, movement by movement."""
    data = paths((30, 22, 41)).to(dtype=torch.float32)
    assembly = zoo.create("vae-dmp", data, latent_dim=LATENT)
    model, guide = assembly.model.eval(), assembly.guide.eval()
    loader = Loader(data, batch_size=200, window=10)
    batch = loader.take(torch.arange(loader.total))
    torch.manual_seed(0)
    drawn = {n: s["value"].detach() for n, s in sites(model, guide, batch).guide.items()}
    together, alone = densities(model, guide, batch, drawn), torch.zeros(())
    for i in range(len(data)):
        mine = batch.sequence == i
        one = Loader(data[i], batch_size=200, window=10).take(torch.arange(int(mine.sum())))
        rows = {n: v[i : i + 1] if n in ("w", "goal") else v[mine] for n, v in drawn.items()}
        alone = alone + densities(model, guide, one, rows)
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=0)


def densities(
    model: torch.nn.Module, guide: torch.nn.Module, batch: Batch, given: dict[str, torch.Tensor]
) -> torch.Tensor:
    """log p(x, z) − log q(z) at given values of all latent sites; w is a point."""
    with pyro.validation_enabled(False), torch.no_grad():
        q = poutine.trace(poutine.condition(guide, given)).get_trace(batch)
        p = poutine.trace(poutine.condition(model, given)).get_trace(batch)
        torch.testing.assert_close(q.nodes["w"]["fn"].base_dist.v, given["w"])
        total: torch.Tensor = p.log_prob_sum() - q.log_prob_sum(lambda name, _: name != "w")
    return total


def test_a_primitive_of_another_length_is_the_design_of_another_duration() -> None:
    longest = Imitator(frames=70, kernels=9, alpha=15.0)
    own = longest.lasting(43)
    torch.testing.assert_close(own.design(), longest.design(43, duration=own.share(70)))


def test_frames_weigh_durations_by_bayes_rule() -> None:
    """Against the dense Gaussians of every duration."""
    torch.manual_seed(3)
    time, known = 9, torch.arange(9) < 4
    priors = [still_prior(time, at) for at in (0.0, 0.3, 1.0)]
    log_prior = torch.tensor([0.5, 0.2, 0.3], dtype=torch.float64).log()
    y = 0.3 + 0.1 * torch.randn(time, 1, dtype=torch.float64)
    weights = Paces(priors, log_prior).condition(y, known).log_weights
    dense = [
        torch.distributions.MultivariateNormal(
            prior.means[0, known, 0],
            prior.covariance[known][..., 0, :, :][..., known, 0] + prior.observation * torch.eye(4),
        ).log_prob(y[known, 0])
        for prior in priors
    ]
    expected = (log_prior + torch.stack(dense)).log_softmax(-1)
    torch.testing.assert_close(weights, expected, rtol=1e-4, atol=1e-4)


def still_prior(time: int, at: float) -> PathPrior:
    root = torch.randn(time, time, dtype=torch.float64)
    return PathPrior(
        torch.full((1, time, 1), at, dtype=torch.float64),
        (root @ root.mT / time)[None],
        torch.zeros(1, time, 1, dtype=torch.float64),
        0.04 * torch.eye(1, dtype=torch.float64),
    )


def test_a_stretched_movement_keeps_its_ends_and_lines() -> None:
    values = torch.arange(12.0).view(2, 6, 1)
    found = stretched(values, torch.tensor([6, 4]), 11)
    torch.testing.assert_close(found[0, :, 0], torch.linspace(0, 5, 11))
    torch.testing.assert_close(found[1, :, 0], torch.linspace(6, 9, 11))


@pytest.mark.parametrize("name", ["vae-dmp", "vae-dmp-rhythmic", "ae-dmp"])
def test_a_new_movement_is_stretched_from_its_own_length(name: str) -> None:
    data = paths((24, 30, 20, 27))
    run = zoo.fit(zoo.create(name, data, epochs=1), data)
    assert run.generate(data[:1], duration=1.5, draws=2).shape[1] == round(23 * 1.5) + 1
    assert run.generate(data[2], draws=2).shape[1] == 20
