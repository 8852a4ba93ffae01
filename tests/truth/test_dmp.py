"""Dynamic movement primitives: learning, exact conditioning and generation by other roads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
from pyro import poutine

import zoo
from benchmarks.peer_primitive import design, imitated
from zoo.datasets.records import Sequences
from zoo.errors import ExtrapolationWarning, NotFittedError
from zoo.guides.exact import Config as ExactConfig
from zoo.guides.exact import ExactPosterior
from zoo.inference.loader import whole
from zoo.models.primitives.dmp import DMP, Config
from zoo.models.primitives.kalman import PathNoise
from zoo.models.primitives.population import Population
from zoo.models.primitives.rollout import roll_out
from zoo.movement.forcing import (
    locally_weighted_regression,
    stationary_variance,
    target_force,
    trajectory_matrix,
)
from zoo.movement.response import Response, Transformation, discrete_basis, phase
from zoo.movement.timing import Timing, period_of
from zoo.prediction import mixtures
from zoo.streams import seeded
from zoo.types import Wishes

SYSTEM = Transformation(dt=1 / 59)
FRAMES, CHANNELS = 30, 2


def movement(seed=0, frames=60, channels=3):
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None]
    wave = np.sin(2 * np.pi * (rng.uniform(0.5, 2, channels) * time + rng.random(channels)))
    return torch.from_numpy(wave + rng.normal(size=channels) * time)


def test_roll_out_of_the_target_force_is_the_demonstration():
    x = movement()[None]
    velocity, force = target_force(x, x[:, -1], SYSTEM)
    z, _ = Response.of(SYSTEM, 60).states(x[:, 0], velocity, x[:, -1], force)
    torch.testing.assert_close(z, x, rtol=0, atol=1e-11)


def test_locally_weighted_regression_is_weighted_least_squares():
    x, time = movement(), torch.arange(59, dtype=torch.float64)
    _, force = target_force(x, x[-1], SYSTEM)
    psi = discrete_basis(time, kernels=6, duration=59, normalised=False)
    ξ = phase(time, duration=59)
    mask = torch.rand(59, 3, generator=torch.Generator().manual_seed(0)) < 0.8
    found = locally_weighted_regression(psi, force, scale=ξ, mask=mask)
    for i in range(6):
        for c in range(3):
            root = (psi[:, i] * mask[:, c]).sqrt()
            solution = np.linalg.lstsq((root * ξ)[:, None], root * force[:, c], rcond=None)[0]
            assert float(found[i, c]) == pytest.approx(float(solution[0]), rel=1e-9)


def test_weights_and_movement_equal_those_of_movement_primitives():
    peers = pytest.importorskip("movement_primitives.dmp", reason="extra bench is not installed")
    x, frames = movement(frames=200), 200
    peer = peers.DMP(3, execution_time=1.0, dt=1 / 199, int_dt=1 / 199, n_weights_per_dim=12)
    peer.imitate(np.linspace(0, 1, frames), x.numpy())
    system = Transformation(dt=1 / 199)
    weights = imitated(x, 12, system)
    theirs = torch.from_numpy(peer.forcing_term.weights_.T)
    torch.testing.assert_close(weights, theirs, rtol=1e-8, atol=1e-8 * float(theirs.abs().max()))
    matrix = trajectory_matrix(Response.of(system, frames), design(12, frames)[1:])
    path = matrix @ torch.cat([x[:1], torch.zeros_like(x[:1]), x[-1:], theirs])
    expected = torch.from_numpy(peer.open_loop(step_function="euler")[1][:frames])
    torch.testing.assert_close(path, expected, rtol=0, atol=1e-8)


def test_long_run_variance_by_summing_the_response():
    noise = Response.of(SYSTEM, 600).product(
        torch.zeros(2, 599, dtype=torch.float64), torch.eye(599, dtype=torch.float64)
    )[0]
    assert stationary_variance(SYSTEM) == pytest.approx(float(noise[-1].square().sum()), rel=1e-9)


def random_population(channels=CHANNELS, parameters=4, factors=2):
    generator = torch.Generator().manual_seed(3)
    shapes = [(channels, parameters), (channels, parameters, factors)]
    mean, shared = (torch.randn(s, generator=generator, dtype=torch.float64) for s in shapes)
    private = torch.randn(channels, parameters, parameters, generator=generator).double() / 2
    return Population(mean, shared, private)


def dense(population):
    """Mean and covariance of the channels' parameters in one vector."""
    shared = population.loadings.flatten(0, 1)
    alone = torch.block_diag(*(v @ v.T for v in population.private))
    return population.mean.flatten(), shared @ shared.T + alone


def test_population_is_a_dense_gaussian():
    population = random_population()
    generator = torch.Generator().manual_seed(4)
    root = torch.randn(2, 4, 3, generator=generator).double()
    precision, linear = root @ root.mT, torch.randn(5, 2, 4, generator=generator).double()
    mean, covariance = dense(population)
    information = torch.linalg.inv(covariance)
    total = information + torch.block_diag(*precision)
    right = (information @ mean) + linear.flatten(1)
    found = population.condition(precision, linear)
    expected = torch.linalg.solve(total, right.T).T
    torch.testing.assert_close(found.mean.flatten(1), expected, rtol=1e-8, atol=1e-8)
    one = Population(found.mean[0], found.loadings, found.private)
    torch.testing.assert_close(dense(one)[1], torch.linalg.inv(total), rtol=1e-8, atol=1e-8)
    evidence = (
        (right * expected).sum(1) - mean @ information @ mean - torch.logdet(total @ covariance)
    ) / 2
    torch.testing.assert_close(population.log_evidence(precision, linear), evidence)


def trained(count=6, seed=0, plain=True, **settings):
    """A model, without scales and at full information where one Gaussian is to be compared."""
    arrays = [movement(seed + i, FRAMES, CHANNELS).numpy() for i in range(count)]
    data = Sequences.from_arrays(arrays, rate=30.0)
    model = DMP(data.layout, Config(kernels=5, **settings))
    model.condition(data)
    if plain:
        model.scales, model.information = torch.ones(1).double(), torch.ones(()).double()
    return model, data


def joint(model, timing=None):
    """Mean, covariance of the path and the observation noise, (channel, time) in one vector."""
    timing = Timing(FRAMES - 1.0) if timing is None else timing
    design = torch.block_diag(*[roll_out(model.primitive, FRAMES, timing)] * CHANNELS)
    forces = PathNoise(model.primitive.system(timing), FRAMES).respond(
        torch.eye(FRAMES - 1).double()
    )
    process = [v * forces @ forces.T for v in model.noise.square()]
    mean, covariance = dense(model.population)
    noise = (model.noise.square() * model.ratio).repeat_interleave(FRAMES)
    return design @ mean, design @ covariance @ design.T + torch.block_diag(*process), noise


def test_forecast_and_filled_gap_are_the_conditional_of_the_dense_gaussian():
    model, data = trained()
    mean, covariance, noise = joint(model)
    x = data.values[0].T.flatten()
    for seen in (torch.arange(FRAMES) < 10, (torch.arange(FRAMES) - 15).abs() > 4):
        s = seen.repeat(CHANNELS)
        gain = covariance[:, s] @ torch.linalg.inv(covariance[s][:, s] + torch.diag(noise[s]))
        path = (mean + gain @ (x[s] - mean[s])).view(CHANNELS, FRAMES).T
        spread = (covariance - gain @ covariance[s]).diagonal().view(CHANNELS, FRAMES).T.sqrt()
        batch = whole(data[[0]])
        hidden = seen[None, :, None].expand_as(batch.values)
        masked = type(batch)(**{**vars(batch), "values": batch.values * hidden, "mask": hidden})
        found = model.impute(masked, None, draws=2)
        torch.testing.assert_close(found.location[0, 0], path, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.epistemic[0, 0], spread, rtol=1e-5, atol=1e-5)
    whole_path = model.forecast(whole(data[[0]].first(10)), None, horizon=20, draws=2)
    hidden = (torch.arange(FRAMES) < 10)[None, :, None].expand(1, -1, CHANNELS)
    begun = type(batch)(**{**vars(batch), "values": batch.values * hidden, "mask": hidden})
    filled = model.impute(begun, None, draws=2)
    torch.testing.assert_close(whole_path.location, filled.location[:, :, 10:])
    torch.testing.assert_close(whole_path.epistemic, filled.epistemic[:, :, 10:])


@pytest.mark.parametrize("hidden", [0, 7])
def test_evidence_of_every_timing_is_the_density_of_the_dense_gaussian(hidden):
    model, data = trained()
    model.ratio[1] = 3.0
    seen = torch.rand(FRAMES, CHANNELS, generator=torch.Generator().manual_seed(hidden)) >= 0.3
    seen = seen if hidden else torch.ones_like(seen)
    x = data.values[:2] * seen
    for timing in (Timing(FRAMES - 1.0), Timing(FRAMES + 4.0)):
        mean, covariance, noise = joint(model, timing)
        s = seen.T.flatten()
        law = torch.distributions.MultivariateNormal(
            mean[s], (covariance + torch.diag(noise))[s][:, s]
        )
        given = model._given([timing])
        (group,) = given.observed_alike(x, seen.expand_as(x))
        expected = law.log_prob(x.mT.flatten(1)[:, s])
        torch.testing.assert_close(given.evidence(group)[0, 0], expected, rtol=1e-9, atol=1e-7)


def tempered(law, x, information, noise):
    """log ∫ p(θ) p(x | θ)^c dθ by the dense Gaussian whose noise given θ is divided by c."""
    mean, covariance = law
    count, c = len(x), information
    total = torch.distributions.MultivariateNormal(mean, covariance + noise / c).log_prob(x)
    volume = torch.logdet(noise) + count * math.log(2 * math.pi)
    return total + (1 - c) / 2 * volume - count / 2 * math.log(c)


def evidence(model, timings, x, seen):
    """Log evidence of one movement, summed over timings and scales by dense Gaussians."""
    s, each = seen.T.flatten(), []
    for timing in timings:
        frames = len(x)
        design = torch.block_diag(*[roll_out(model.primitive, frames, timing)] * CHANNELS)[s]
        response = PathNoise(model.primitive.system(timing), frames)
        forces = response.respond(torch.eye(frames - 1, dtype=torch.float64))
        blocks = [
            v * (forces @ forces.T + r * torch.eye(frames))
            for v, r in zip(model.noise.square(), model.ratio, strict=True)
        ]
        noise = torch.block_diag(*blocks)[s][:, s]
        mean, covariance = dense(model.population)
        for scale in model.scales:
            law = design @ mean, scale**2 * design @ covariance @ design.T
            each.append(tempered(law, x.T.flatten()[s], float(model.information), noise))
    return torch.stack(each).logsumexp(0) - math.log(len(each))


def rhythmic():
    time = np.arange(45)[:, None]
    starts = np.random.default_rng(0).uniform(0, 2 * np.pi, 4)
    turns = [2 * np.pi * time / 20 + s for s in starts]
    arrays = [np.concatenate([np.sin(a), np.cos(2 * a)], 1) for a in turns]
    noisy = [a + 0.05 * np.random.default_rng(1).normal(size=a.shape) for a in arrays]
    data = Sequences.from_arrays(noisy, rate=30.0)
    model = DMP(data.layout, Config(kind="rhythmic", kernels=5))
    model.condition(data)
    model.units, model.offsets = model.units[::9].clone(), model.offsets[::9].clone()
    return model, data


@pytest.mark.parametrize("make", [lambda: trained(plain=False), lambda: trained(1), rhythmic])
@pytest.mark.parametrize("information", [1.0, 0.3])
def test_guide_is_the_posterior_of_the_program_at_every_draw(make, information):
    model, data = make()
    model.information = torch.tensor(information).double()
    batch = whole(data[[0]] if len(data) == 1 else data[[0, 2]])
    seen = torch.rand(batch.values.shape, generator=torch.Generator().manual_seed(1)) < 0.8
    batch = replace(batch, movements=batch.movements * seen, movement_mask=seen)
    guide = ExactPosterior(data.layout, model, ExactConfig())
    timings = model.expected.whole(batch.movements.shape[1])
    pairs = zip(batch.movements, seen, strict=True)
    expected = sum(evidence(model, timings, x, s) for x, s in pairs)
    for seed in range(4):
        pyro.set_rng_seed(seed)
        drawn = poutine.trace(guide).get_trace(batch)
        joint_density = poutine.trace(poutine.replay(model, drawn)).get_trace(batch)
        bound = joint_density.log_prob_sum() - drawn.log_prob_sum()
        torch.testing.assert_close(bound, expected, rtol=1e-8, atol=1e-6)


def test_draws_are_made_when_they_are_asked_for_and_by_the_seed():
    model, data = trained()
    made = []
    with seeded(3):
        first = model.forecast(whole(data[[1]].first(8)), None, horizon=22, draws=5)
        made.append(torch.randn(1))
    with seeded(3):
        again = model.forecast(whole(data[[1]].first(8)), None, horizon=22, draws=5)
        assert torch.equal(again.draws, again.draws)
        made.append(torch.randn(1))
    assert torch.equal(*made)
    torch.testing.assert_close(
        first.affine(torch.tensor(2.0), torch.tensor(1.0)).draws, 2 * again.draws + 1
    )


def test_draws_have_the_exact_moments():
    model, data = trained()
    count = 4000
    with seeded(0):
        found = model.forecast(whole(data[[1]].first(8)), None, horizon=22, draws=count)
    error = (found.draws.mean(0) - found.location[0]).abs() / found.epistemic[0]
    assert error.max() < 6 / count**0.5
    ratio = found.draws.var(0) / found.epistemic[0].square()
    assert (ratio - 1).abs().max() < 6 * (2 / count) ** 0.5


def program_draws(model, count):
    blank = Sequences.from_arrays(np.zeros((count, FRAMES, CHANNELS)), rate=30.0)
    with seeded(1):
        return poutine.trace(model).get_trace(whole(blank).unobserved()).nodes["x"]["value"]


def test_program_draws_from_the_same_gaussian():
    model, _ = trained()
    x = program_draws(model, 4000).mT.flatten(1)
    mean, covariance, noise = joint(model)
    total = covariance + torch.diag(noise)
    white = torch.linalg.solve_triangular(torch.linalg.cholesky(total), (x - mean).T, upper=False)
    assert white.mean(1).abs().max() < 6 / len(x) ** 0.5
    second = white @ white.T / len(x) - torch.eye(len(white))
    assert second.abs().max() < 6 * (2 / len(x)) ** 0.5


def test_bands_cover_data_drawn_from_the_model():
    model, _ = trained(plain=False)
    model.information = torch.ones(()).double()
    x = program_draws(model, 1000)
    drawn = Sequences.from_arrays(x.numpy(), rate=30.0)
    found = model.forecast(whole(drawn.first(9)), None, horizon=FRAMES - 9, draws=1)
    below = mixtures.cdf(found.location, found.spread, x[:, 9:])[:, 10, 0]
    for level in (0.05, 0.25, 0.5, 0.75, 0.95):
        error = float((below < level).double().mean()) - level
        assert abs(error) < 5 * (level * (1 - level) / 1000) ** 0.5 + 0.01


def generate(model, batch, **changes):
    return model.generate(batch, None, wishes=Wishes(**changes), draws=1)


def test_twice_the_way_to_the_goal_doubles_the_movement():
    model, data = trained(least_amplitude=0.01)
    batch = whole(data[[2]])
    plain = generate(model, batch).location[0, 0]
    posterior = model._demonstrated(batch, 1)[0].population.mean[0]
    first, velocity, fitted = posterior[:, :3].T
    size = plain.amax(0) - plain.amin(0)
    assert ((fitted - first).abs() > model.config.least_amplitude * size).all()
    goal = first + 2 * (fitted - first)
    found = generate(model, batch, goal=goal[None]).location[0, 0]
    free = roll_out(model.primitive, FRAMES, Timing(FRAMES - 1.0))[:, 1:2] * velocity
    torch.testing.assert_close(found - first - free, 2 * (plain - first - free))


def there_and_back(count=4):
    """Movements that end near where they began, a tenth of their range away."""
    time = np.linspace(0, 1, 60)[:, None]
    loops = [np.sin(np.pi * time) * (1 + 0.05 * i) + 0.1 * time for i in range(count)]
    return Sequences.from_arrays([np.concatenate([x, x[::-1]], 1) for x in loops], rate=30.0)


def test_a_far_goal_is_told_of_and_neither_path_nor_bands_are_those_of_a_near_one():
    data = there_and_back()
    run = zoo.fit(zoo.create("dmp", data, scaling="none"), data)
    end = data.values[0, -1].numpy()
    near = run.generate(data[[0]], goal=end + 0.05)
    with pytest.warns(ExtrapolationWarning, match=r"channel_1 to 1.5 .demonstrated 0 to 1.2"):
        far = run.generate(data[[0]], goal=end + 1.5)
    bend = [p.mean.diff(n=2, dim=1).abs().amax().item() for p in (near, far)]
    assert bend[1] < 3 * bend[0]
    assert (far.mean[0, -1] - torch.from_numpy(end + 1.5)).abs().max() < 0.1
    widths = [p.std[0, 20:40].mean().item() for p in (near, far)]
    assert widths[1] > 5 * widths[0]


def test_longer_duration_is_the_same_path_more_slowly():
    model, data = trained()
    fine = generate(model, whole(data[[0]]), duration=20.0).location[0, 0]
    finer = generate(model, whole(data[[0]]), duration=40.0).location[0, 0]
    assert fine.shape == (581, CHANNELS)
    assert (finer[::2] - fine).abs().max() < 0.05 * fine.std()


def test_switching_begins_with_one_movement_and_ends_with_the_other():
    model, data = trained()
    one, other = whole(data[[0]]), whole(data[[3]])
    found = generate(model, one, onto=other, start=8, steps=4, duration=4.0).location[0, 0]
    first = generate(model, one, duration=4.0).location[0, 0]
    last = generate(model, other, duration=4.0).location[0, 0]
    torch.testing.assert_close(found[:9], first[:9])
    torch.testing.assert_close(found[-1], last[-1], rtol=0, atol=1e-3)
    with pytest.raises(ValueError, match="switching from frame 28 over 5 frames does not fit"):
        generate(model, one, onto=other, start=28, steps=5)


def test_ragged_movements_with_missing_frames():
    arrays = [movement(i, 26 + 2 * i, CHANNELS).numpy().copy() for i in range(5)]
    for array in arrays:
        array[5:9, 0] = np.nan
    arrays[2][:, 1] = np.nan
    data = Sequences.from_arrays(arrays, rate=30.0)
    model = DMP(data.layout, Config(kernels=5))
    model.condition(data)
    found = model.forecast(whole(data[[0, 1, 3]].first(12)), None, horizon=10, draws=3)
    assert found.location.shape == (16, 3, 10, CHANNELS)
    assert found.draws.shape == (3, 3, 10, CHANNELS)
    assert all(bool(torch.isfinite(t).all()) for t in (found.location, found.epistemic))


@pytest.mark.parametrize("learning", ["path", "force", "lwr"])
def test_every_way_of_learning_reconstructs(learning):
    model, data = trained(learning=learning, gated=True)
    found = model.reconstruct(whole(data), None, draws=1)
    error = (found.location[0] - data.values).square().mean()
    assert error < 0.2 * data.values.var()


def test_rhythmic_movement_is_continued_from_any_phase():
    time = np.arange(60)[:, None]
    starts = np.random.default_rng(0).uniform(0, 2 * np.pi, 8)
    arrays = [
        np.concatenate(
            [np.sin(2 * np.pi * time / 20 + s), np.cos(4 * np.pi * time / 20 + 2 * s)], 1
        )
        for s in starts
    ]
    data = Sequences.from_arrays(arrays, rate=30.0)
    model = DMP(data.layout, Config(kind="rhythmic", kernels=8))
    model.condition(data[slice(0, 7)])
    assert period_of([(data.values[0], data.mask[0])]) == 20.0
    found = model.forecast(whole(data[[7]].first(25)), None, horizon=35, draws=2)
    error = (found.location.mean(0)[0] - data.values[7, 25:]).square().mean()
    assert error < 0.05 * data.values.var()


def test_errors_say_what_is_missing():
    _, data = trained(count=1)
    model = DMP(data.layout, Config(kernels=5))
    with pytest.raises(NotFittedError, match="dmp has not been trained"):
        model.forecast(whole(data.first(5)), None, horizon=3, draws=1)
    with pytest.raises(ValueError, match="9 frames in a movement are too few for stable steps"):
        model.condition(data.first(10))
    with pytest.raises(ValueError, match="kernels must be at least 2; got 1"):
        Config(kernels=1)
