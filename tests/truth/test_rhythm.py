"""Rhythmic VAE-DMP by other roads: known timings, dense Gaussians, the per-step program."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import zoo
from zoo.datasets.records import Sequences
from zoo.guides.filtering import Config as GuideConfig
from zoo.guides.rhythmic import RhythmicGuide
from zoo.guides.template import fourier, learn_template, match
from zoo.inference.loader import Loader, whole
from zoo.inference.posterior import GuidePosterior
from zoo.models.filters.cycles import CyclePrior
from zoo.models.filters.vae_dmp_rhythmic import Config, RhythmicVaeDmp
from zoo.movement.gaussian_paths import stationary, stationary_draws
from zoo.movement.paths import Readout
from zoo.movement.plan import Plan

PERIOD, FRAMES, CHANNELS = 40.0, 90, 6


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def swings(phase: Tensor, tempo: Tensor, frames: int = FRAMES, noise: float = 0.0) -> Tensor:
    """Movements of one template at their own phases and tempos."""
    generator = torch.Generator().manual_seed(3)
    template = torch.randn(7, CHANNELS, generator=generator) / torch.tensor(
        [1, 1, 2, 3, 1, 2, 3]
    ).unsqueeze(1)
    s = phase[:, None] + 2 * math.pi / PERIOD * tempo.exp()[:, None] * torch.arange(frames)
    x = fourier(s, 3) @ template
    return x + noise * torch.randn(x.shape, generator=generator)


def timings(count: int = 7) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    phase = (2 * torch.rand(count, generator=generator) - 1) * math.pi
    return phase, 0.05 * torch.randn(count, generator=generator)


def circular(difference: Tensor) -> Tensor:
    return torch.remainder(difference + math.pi, 2 * math.pi) - math.pi


@pytest.mark.parametrize("missing", [False, True])
def test_timings_are_found_up_to_a_common_origin(missing: bool) -> None:
    phase, tempo = timings()
    x = swings(phase, tempo)
    mask = torch.ones_like(x, dtype=torch.bool)
    if missing:
        mask[0, 20:35] = mask[2, :, 1] = False
    template = learn_template(x * mask, mask, PERIOD)
    found = match(x * mask, mask, template, PERIOD)
    apart = circular(found[:, 0] - phase)
    assert circular(apart - apart[0]).abs().max() < 1e-3
    assert ((found[:, 1] - tempo) - (found[0, 1] - tempo[0])).abs().max() < 1e-3


def test_a_movement_that_begins_later_has_a_later_phase_and_the_same_tempo() -> None:
    x = swings(*timings(), frames=FRAMES + 11)
    every = torch.ones_like(x[:, :FRAMES], dtype=torch.bool)
    template = learn_template(x[:, :FRAMES], every, PERIOD)
    now, later = (match(x[:, k : k + FRAMES], None, template, PERIOD) for k in (0, 11))
    turned = 2 * math.pi / PERIOD * now[:, 1].exp() * 11
    assert circular(later[:, 0] - now[:, 0] - turned).abs().max() < 1e-3
    assert (later[:, 1] - now[:, 1]).abs().max() < 1e-3


def test_draws_of_a_stationary_process_have_its_covariance() -> None:
    torch.manual_seed(0)
    residuals, time, count = torch.randn(3, 6, 2).cumsum(1), 9, 40_000
    drawn = stationary_draws(residuals, time, (count,)).flatten(1)
    expected = stationary(residuals, time).flatten(2).flatten(0, 1)
    size = expected.diagonal().sqrt()
    error = (drawn.mT @ drawn / count - expected) / (size[:, None] * size)
    assert error.abs().max() < 6 * math.sqrt(2 / count)


def some_prior() -> CyclePrior:
    torch.manual_seed(1)
    return CyclePrior(
        torch.randn(4, 7, 3),
        torch.randn(5, 3, 2),
        0.3 * torch.randn(5, 7, 2),
        torch.tensor([[0.05, 0.01], [0.01, 0.04]]),
        bandwidth=0.6,
        shrinkage=0.2,
        process=0.5,
    )


def dense(prior: CyclePrior, j: int) -> tuple[Tensor, Tensor]:
    """Means of all components of a timing and their covariance, (time latent)."""
    design = torch.kron(prior.designs[j].contiguous(), torch.eye(2))
    N = prior.process * stationary(prior.residuals).flatten(2).flatten(0, 1)
    return prior.means @ design.mT, design @ prior.root @ prior.root.mT @ design.mT + N


@pytest.mark.parametrize("own_noise", [False, True])
def test_conditioned_cycles_are_those_of_the_dense_gaussians(own_noise: bool) -> None:
    """Weights exactly; moments of draws within six standard errors."""
    prior, seen, draws = some_prior(), torch.randn(2, 7, 2), 20_000
    where = torch.tensor([1, 1, 0, 1, 0, 0, 0]).bool()
    extra = 0.1 * torch.eye(2).expand(2, 7, 2, 2) if own_noise else None
    rows = where.repeat_interleave(2).nonzero()[:, 0]
    E = torch.block_diag(*[prior.observation + (0.1 * torch.eye(2) if own_noise else 0)] * 3)
    found = prior.condition(seen, where, extra)
    sampled = found.sample(draws).flatten(2)
    for k in range(2):
        y, log_weights, means, covariances = seen[k].flatten()[rows], [], [], []
        for j in range(4):
            mean, full = dense(prior, j)
            C = full[rows][:, rows] + E
            gain = torch.linalg.solve(C, full[rows]).mT
            normal = torch.distributions.MultivariateNormal(mean[:, rows], C)
            log_weights.append(normal.log_prob(y))
            means.append(mean + (y - mean[:, rows]) @ gain.mT)
            covariances.append((full - gain @ full[rows]).expand(5, -1, -1))
        weights = torch.stack(log_weights).flatten().softmax(0)
        part = found.parts[k if own_noise else 0]
        mine = part.log_weights[0 if own_noise else k].flatten().softmax(0)
        torch.testing.assert_close(mine, weights)
        mean = weights @ torch.cat(means)
        apart = torch.cat(means) - mean
        covariance = torch.einsum("c,cij->ij", weights, torch.cat(covariances))
        covariance = covariance + torch.einsum("c,ci,cj->ij", weights, apart, apart)
        size = covariance.diagonal().sqrt()
        assert ((sampled[:, k].mean(0) - mean) / size).abs().max() < 6 / math.sqrt(draws)
        error = sampled[:, k].mT.cov() - covariance
        assert (error / (size[:, None] * size)).abs().max() < 6 * math.sqrt(3 / draws)


def shaped(u: Tensor) -> CyclePrior:
    """The prior with the shape that was found for movements of parameters ``u``."""
    torch.manual_seed(2)
    designs, r = torch.randn(1, 12, 3), 0.02 * torch.randn(len(u), 12, 1)
    prior = CyclePrior(designs, u, r, 1e-4 * torch.eye(1))
    readout = Readout(torch.ones(len(u), 12, 1, 1), torch.tensor([0.01]))

    def without(i: int) -> CyclePrior:
        kept = torch.arange(len(u)) != i
        return replace(prior, parameters=u[kept], residuals=r[kept])

    return prior.tuned(designs[0] @ u + r, (1, 2), readout, without)


def test_shape_of_the_mixture_is_that_of_its_movements() -> None:
    """Movements of three sorts get a narrow kernel each, those of one sort the Gaussian of all."""
    torch.manual_seed(2)
    sorts = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]).repeat(4, 1)[..., None]
    assert shaped(sorts + 0.02 * torch.randn(12, 3, 1)).bandwidth <= 0.3
    assert shaped(1 + 0.5 * torch.randn(12, 3, 1)).bandwidth >= 0.6


def data_of(frames: int = FRAMES) -> Sequences:
    x = swings(*timings(), frames=frames, noise=0.02)
    return Sequences.from_arrays(x.numpy(), rate=30.0)


def build(data: Sequences, **settings: float) -> tuple[RhythmicVaeDmp, RhythmicGuide]:
    torch.manual_seed(0)
    model = RhythmicVaeDmp(data.layout, Config(latent_dim=2, hidden=7, kernels=5, **settings))
    guide = RhythmicGuide(data.layout, model, GuideConfig(hidden=7, features=3))
    torch.nn.init.normal_(model.g[-1].weight, std=0.3)
    model.prepare(data)
    guide.prepare(data)
    return model, guide


def test_paths_are_those_of_the_step_by_step_program() -> None:
    """(74) with the forcing term (57), (58) at the phase of every step."""
    data = data_of()
    model, guide = build(data)
    assert float(model.period) == pytest.approx(PERIOD, abs=2)
    batch = Loader(data, batch_size=5, window=9, seed=0).take(torch.tensor([0, 3, 80, 100, 401]))
    with torch.no_grad():
        one = {name: v[0] for name, v in GuidePosterior(guide).draw(batch, 1).items()}
        plan, system = Plan.of(one), model.system
        path = model.path(one["z"][:, 0], one["velocity"], plan, one["epsilon"], batch)
        z = model.embed(one["z"][:, 0])
        ż = model.config.velocity_scale * one["velocity"]
        w, goal = plan.w[batch.sequence], model.embed(plan.goal)[batch.sequence]
        assert plan.phase is not None and plan.tempo is not None
        ω = 2 * math.pi / model.period * plan.tempo.exp()
        centre = 2 * math.pi / 5 * torch.arange(5)
        for t in range(9):
            torch.testing.assert_close(path[:, t], z)
            s = plan.phase[batch.sequence] + ω[batch.sequence] * (batch.start + t)
            ψ = ((torch.cos(s[:, None] - centre) - 1) / (0.55 * 2 * math.pi / 5) ** 2).exp()
            f = model.config.w_scale * torch.einsum("bk,bkl->bl", ψ / ψ.sum(1, keepdim=True), w)
            if t < 8:
                force = f + one["epsilon"][:, t] @ model.w_noise
                z̈ = system.alpha * (system.beta * (goal - z) - ż) + system.stiffness * force
                ż = ż + z̈ * system.dt
                z = z + ż * system.dt


def test_weights_do_not_depend_on_where_a_movement_begins() -> None:
    """Frames are folded onto the circle: whole turns later the same weights are recognised."""
    x = swings(torch.zeros(3), torch.zeros(3), frames=4 * int(PERIOD) + 7)
    whole_turns = 3 * int(PERIOD)
    data = Sequences.from_arrays(x[:, :whole_turns].numpy(), rate=30.0)
    later = Sequences.from_arrays(x[:, 7 : 7 + whole_turns].numpy(), rate=30.0)
    _, guide = build(data, period=PERIOD / 30.0)
    with torch.no_grad():
        now, then = (GuidePosterior(guide).draw(whole(d), 1) for d in (data, later))
    apart = (then["w"] - now["w"]).abs().max()
    assert apart < 0.01 * now["w"].std()
    assert circular(then["phase"] - now["phase"] - 7 * 2 * math.pi / PERIOD).abs().max() < 0.02


def test_cycles_repeat_after_a_period_and_centres_move() -> None:
    data = data_of()
    model, guide = build(data)
    with torch.no_grad():
        model.learn_prior(whole(data), GuidePosterior(guide))
        timing = torch.tensor([[0.3, 0.0]])
        cycles = model._cycles(timing, 100) @ model.prior_movements.double()
        period = round(float(model.period))
        torch.testing.assert_close(cycles[:, period:], cycles[:, :-period], atol=1e-5, rtol=0)
        centre = model._cycles(timing, 100)[..., -1]
        torch.testing.assert_close(centre, torch.ones_like(centre), atol=1e-5, rtol=0)


def test_forecasts_of_a_new_phase_and_tempo_go_on_where_it_stands() -> None:
    """Trained briefly on nine swings, a tenth is forecast for a period and more."""
    generator = np.random.default_rng(0)
    phase = torch.from_numpy(generator.uniform(-3, 3, 12))
    tempo = torch.from_numpy(generator.normal(0, 0.04, 12))
    x = swings(phase, tempo, noise=0.01)
    data = Sequences.from_arrays(x.numpy(), rate=30.0, groups={"trial": range(12)})
    torch.set_default_dtype(torch.float32)
    settings = {"latent_dim": 4, "hidden": 60, "epochs": 150, "period": PERIOD / 30.0}
    run = zoo.fit(zoo.create("vae-dmp-rhythmic", data[:9], seed=0, **settings), data[:9])
    pred = run.forecast(data[9:].frames(0, 30), horizon=60, draws=100)
    truth = x[9:, 30:]
    error = (pred.mean - truth).square().mean()
    assert error < 0.05 * truth.var()


def test_settings_of_discrete_movements_are_refused() -> None:
    with pytest.raises(ValueError, match="goal_scaling is for movements with an end"):
        Config(goal_scaling=True)
    with pytest.raises(ValueError, match="period must be positive; got 0"):
        Config(period=0.0)


def test_a_movement_left_out_says_nothing_in_its_own_left_out_prior() -> None:
    """Replaced by noise, it changes the prior of all, but no number of the prior of the others."""
    data = data_of()
    model, guide = build(data)
    priors = []
    shape = {"bandwidth": 0.6, "shrinkage": 0.3, "process": 1.0}
    for values in (data.values, noise_for(data.values, row=2)):
        torch.manual_seed(4)
        with torch.no_grad():
            model.learn_prior(whole(replace(data, values=values)), GuidePosterior(guide))
        both = model.prior_without(2), model._prior(FRAMES, (16, 5))
        priors.append([replace(prior, **shape) for prior in both])
    (without, every), (other, noisy) = priors
    for name in ("designs", "means", "root", "residuals", "observation"):
        torch.testing.assert_close(getattr(without, name), getattr(other, name), msg=name)
        if name != "designs":
            assert not torch.allclose(getattr(every, name).mean(0), getattr(noisy, name).mean(0))


def noise_for(values: Tensor, row: int) -> Tensor:
    """The movements, one of them replaced by noise."""
    changed = values.clone()
    changed[row] = torch.randn(changed[row].shape, generator=torch.Generator().manual_seed(0))
    return changed
