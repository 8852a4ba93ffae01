"""VAE-DMP by other roads: the per-step program, finite differences, the dense Gaussian formula."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.guides.filtering import Config as GuideConfig
from zoo.guides.filtering import FilteringGuide
from zoo.guides.recurrence import FilteringNoise, _Filter
from zoo.inference.elbo import bound, check, divergences, sites, tight_bound
from zoo.inference.loader import Loader, whole
from zoo.inference.posterior import GuidePosterior
from zoo.models.filters.vae_dmp import Config, VaeDmp
from zoo.movement.gaussian_paths import stationary
from zoo.movement.paths import PathPrior, Readout
from zoo.movement.plan import Plan
from zoo.movement.response import Response
from zoo.types import Batch

LATENT, HIDDEN, FRAMES, CHANNELS = 2, 7, 12, 4
Pair = tuple[VaeDmp, FilteringGuide, Batch]


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def movements(count: int = 3) -> Sequences:
    values = torch.randn(count, FRAMES, CHANNELS).cumsum(1)
    return Sequences.from_arrays(values.numpy(), rate=30.0)


def unlike_movements() -> Sequences:
    """One of 12 frames, one of 8 and one of 10."""
    whole = movements().arrays
    return Sequences.from_arrays(
        [x[:n] for x, n in zip(whole, (12, 8, 10), strict=True)], rate=30.0
    )


SCALED = {"goal_scaling": True, "common_forcing": 0.1, "activation": "softplus"}


def build(
    data: Sequences, settings: dict[str, Any] | None = None, **guide: str
) -> tuple[VaeDmp, FilteringGuide]:
    settings = Config(latent_dim=LATENT, hidden=HIDDEN, kernels=5, **(settings or {}))
    model = VaeDmp(data.layout, settings)
    own = GuideConfig(hidden=HIDDEN, features=3, **guide)
    torch.nn.init.normal_(model.g[-1].weight, std=0.3)
    return model, FilteringGuide(data.layout, model, own)


KINDS = {"plain": {}, "goal-scaling": SCALED, "unlike-lengths": SCALED}


@pytest.fixture(params=KINDS)
def pair(request: pytest.FixtureRequest) -> Pair:
    torch.manual_seed(0)
    unlike = request.param == "unlike-lengths"
    data = unlike_movements() if unlike else movements()
    model, guide = build(data, KINDS[request.param])
    if model.goal_scaling:
        torch.nn.init.normal_(model.w_common)
    rows = torch.tensor([0, 3, 6, 8, 9, 14] if unlike else [0, 3, 4, 8, 9, 20])
    return model, guide, Loader(data, batch_size=6, window=6, seed=0).take(rows)


class PerStep:
    """The same program with a site a time step, states by the step (74), after given draws."""

    def __init__(self, model: VaeDmp, guide: FilteringGuide, drawn: dict[str, Tensor]) -> None:
        self.model, self.guide, self.drawn = model, guide, drawn

    def states(self, batch, w, goal, start, z_1, v, recognise):
        """Roll (74) and call ``recognise(t, z_t)`` for the noise of every step."""
        model, system = self.model, self.model.system
        lengths = batch.frames[batch.sequence, None]
        τ = (lengths - 1) / (FRAMES - 1)
        bases = {n: model.kernels_at(FRAMES, (n - 1) / (FRAMES - 1)) for n in range(8, 13)}
        if start is not None:
            w = w * (model.embed(goal) - model.embed(start))[:, None, :]
        z, ż = model.embed(z_1), model.config.velocity_scale * v / τ
        path = [z]
        for t in range(batch.values.shape[1] - 1):
            ε = recognise(t, z) @ model.w_noise
            Ψ = torch.stack(
                [bases[int(n)][s + t] for n, s in zip(lengths, batch.start, strict=True)]
            )
            f = model.config.w_scale * torch.einsum("bk,bkl->bl", Ψ, w[batch.sequence])
            force = system.stiffness * (f + ε)
            pull = system.beta * (model.embed(goal)[batch.sequence] - z)
            z̈ = (system.alpha * (pull - τ * ż) + force) / τ**2
            ż = ż + z̈ * system.dt
            z = z + ż * system.dt
            path.append(z)
        return torch.stack(path, 1)

    def posterior(self, batch: Batch) -> None:
        guide = self.guide
        h = guide.trunk(batch.values)
        with poutine.scale(scale=batch.total_sequences / len(batch.movements)):
            w = pyro.sample("w", guide.weights(batch.movements, batch.lengths))
            last = torch.stack(
                [x[n - 1] for x, n in zip(batch.movements, batch.frames, strict=True)]
            )
            goal = pyro.sample("goal", dist.Normal(*guide.encoder(guide.trunk(last))))
            start = None
            if self.model.goal_scaling:
                moments = guide.encoder(guide.trunk(batch.movements[:, 0]))
                start = pyro.sample("start", dist.Normal(*moments))
        with poutine.scale(scale=batch.total / len(batch)):
            z = pyro.sample("z", dist.Normal(*guide.encoder(h)))
            v = pyro.sample("velocity", dist.Normal(*guide.velocity(h[:, :2].flatten(1))))

            def recognise(t: int, state: Tensor) -> Tensor:
                moments = guide.noise(guide.noise.features(batch.values[:, t + 1]), state)
                return pyro.sample(f"epsilon_{t}", dist.Normal(*moments))

            self.states(batch, w, goal, start, z[:, 0], v, recognise)

    def generative(self, batch: Batch) -> None:
        model, latent = self.model, self.model.latent_dim
        rows, windows, time = len(batch.movements), *batch.values.shape[:2]

        def unit(*shape: int) -> dist.Distribution:
            return dist.Normal(torch.zeros(shape), 1.0)

        with poutine.scale(scale=batch.total_sequences / rows):
            start, w_prior = None, unit(rows, model.kernels, latent)
            if model.goal_scaling:
                w_prior = dist.Normal(model.w_common.expand(w_prior.batch_shape), 0.1)
                start = pyro.sample("start", unit(rows, latent))
            w = pyro.sample("w", w_prior)
            goal = pyro.sample("goal", unit(rows, latent))
        with poutine.scale(scale=batch.total / windows):
            z = pyro.sample("z", unit(windows, time, latent))
            v = pyro.sample("velocity", unit(windows, latent))

            def draw(t: int, state: Tensor) -> Tensor:
                return pyro.sample(f"epsilon_{t}", unit(windows, latent))

            path = self.states(batch, w, goal, start, z[:, 0], v, draw)
            for name, states in (("x", path), ("x_single", model.embed(z))):
                x = dist.Normal(model.decoder(states), model.output_std)
                pyro.sample(name, x, obs=batch.values)


def test_adjoint_against_finite_differences():
    def some(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, requires_grad=True)

    torch.manual_seed(1)
    steps, windows, hidden, state = 4, 3, 5, 2 * LATENT
    η = torch.randn(steps, windows, LATENT)
    networks = some(hidden, LATENT), some(2 * LATENT, hidden), some(2 * LATENT)
    system = some(state, state), some(LATENT, state)
    given = some(steps, windows, hidden), η, some(windows, state), some(steps, windows, state)
    assert torch.autograd.gradcheck(_Filter.apply, (*given, *system, *networks, 1e-3))


@pytest.fixture
def both(pair: Pair) -> tuple[dict[str, Tensor], dict[str, Tensor], list[Tensor], list[Tensor]]:
    """Log densities and gradients of both programs for the same standard normal numbers."""
    model, guide, batch = pair
    parameters = [*model.parameters(), *guide.parameters()]
    drawn = sites(model, guide, batch)
    values = {n: s["value"] for n, s in drawn.guide.items()}
    fast = {f"p({n})": _sum(s) for n, s in drawn.model.items()}
    fast |= {f"q({n})": _sum(s) for n, s in drawn.guide.items()}
    noise = drawn.guide["epsilon"]["fn"]
    mean, σ = noise.kept_moments()
    η = ((values["epsilon"].transpose(0, 1) - mean) / σ).detach()
    steps = PerStep(model, guide, values)
    slow = _per_step(steps, batch, values, η)

    def total(terms: dict[str, Tensor]) -> Tensor:
        return sum(v for n, v in terms.items() if n[0] == "q") - sum(
            v for n, v in terms.items() if n[0] == "p"
        )

    gradients = [
        torch.autograd.grad(total(terms), parameters, retain_graph=True, allow_unused=True)
        for terms in (fast, slow)
    ]
    return fast, slow, *gradients


def _per_step(
    program: PerStep, batch: Batch, values: dict[str, Tensor], η: Tensor
) -> dict[str, Tensor]:
    class Replay(poutine.messenger.Messenger):
        """Give the per-step guide the numbers that the vectorised one drew."""

        def _pyro_sample(self, message):
            name = message["name"]
            if name.startswith("epsilon_"):
                fn = message["fn"]
                message["value"] = fn.mean + fn.stddev * η[int(name.split("_")[1])]
            elif not message["is_observed"]:
                message["value"] = values[name]
            message["done"] = True

    with Replay():
        guide = poutine.trace(program.posterior).get_trace(batch)
    model = poutine.trace(poutine.replay(program.generative, guide)).get_trace(batch)
    found: dict[str, Tensor] = {}
    for letter, trace in (("q", guide), ("p", model)):
        trace.compute_log_prob()
        for name in (*trace.stochastic_nodes, *trace.observation_nodes):
            whole_name = f"{letter}({'epsilon' if name.startswith('epsilon_') else name})"
            found[whole_name] = found.get(whole_name, 0.0) + trace.nodes[name]["log_prob_sum"]
    return found


def _sum(site) -> Tensor:
    return site["fn"].log_prob(site["value"]).sum() * site["scale"]


def test_densities_equal_those_of_the_per_step_program(both):
    fast, slow, _, _ = both
    assert fast.keys() == slow.keys()
    for name in fast:
        torch.testing.assert_close(fast[name], slow[name], rtol=1e-10, atol=1e-10, msg=name)


def test_gradients_equal_those_of_the_per_step_program(both):
    *_, fast, slow = both
    for one, other in zip(fast, slow, strict=True):
        assert one is not None
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_density_of_another_value_and_of_the_draw_agree(pair: Pair):
    model, guide, batch = pair
    noise = sites(model, guide, batch).guide["epsilon"]["fn"]
    value = noise._kept[0]
    torch.testing.assert_close(noise.log_prob(value), noise.log_prob(value.clone()))


def test_closed_form_divergence_is_the_mean_of_sampled_ones(pair: Pair):
    """KL(q‖p) of the noise: per step exact, so both estimators have one expectation."""
    model, guide, batch = pair
    found = sites(model, guide, batch)
    q = found.guide["epsilon"]["fn"]
    p = found.model["epsilon"]["fn"]
    assert isinstance(q, FilteringNoise)
    gaps = []
    with torch.no_grad():
        for _ in range(400):
            value = q.rsample()
            kl = torch.distributions.kl_divergence(q, p)
            gaps.append((kl - (q.log_prob(value) - p.log_prob(value))).sum())
    gap = torch.stack(gaps)
    assert gap.mean().abs() < 4 * gap.std() / len(gaps) ** 0.5


def test_programs_pass_every_check_and_bounds_are_finite(pair: Pair):
    model, guide, batch = pair
    check(model, guide, batch)
    assert torch.isfinite(bound(model, guide, batch, c=0.3).loss)
    assert torch.isfinite(tight_bound(model, guide, batch).loss)
    assert set(divergences(sites(model, guide, batch))) == set(sites(model, guide, batch).guide)


def test_gaussian_weights_train_too():
    torch.manual_seed(0)
    data = movements()
    model, guide = build(data, weights="gaussian")
    tight_bound(model, guide, whole(data)).loss.backward()
    assert all(p.grad is not None for p in (*model.parameters(), *guide.parameters()))


def test_entries_that_are_missing_carry_no_gradient(pair: Pair):
    model, guide, batch = pair
    mask = torch.rand(batch.values.shape) > 0.3
    holed = replace(batch, mask=mask, values=batch.values.masked_fill(~mask, 0.0))
    torch.manual_seed(3)
    one = bound(model, guide, holed)
    densities = {n: v for n, v in one.terms.items() if n.startswith("p(x")}
    for site in sites(model, guide, holed).model.values():
        if site["is_observed"]:
            full = site["fn"].log_prob(site["value"])
            moved = site["value"].masked_fill(~mask, 7.0)
            torch.testing.assert_close(full, site["fn"].log_prob(moved))
    assert len(densities) == 2


def test_movements_too_short_are_refused_with_advice():
    data = Sequences.from_arrays([np.zeros((9, 2)), np.ones((2, 2))], rate=30.0)
    with pytest.raises(ValueError, match="at least 3 frames; got one of 2: leave it out"):
        VaeDmp(data.layout, Config())


def test_windows_are_padded_by_nothing():
    data = unlike_movements()
    model, guide = build(data)
    with pytest.raises(ValueError, match="set window=8 or less"):
        bound(model, guide, whole(data))


def prior(movements: int = 3, time: int = 6) -> PathPrior:
    def covariance(size: int) -> Tensor:
        root = torch.randn(size, size)
        return root @ root.T / size

    independent = torch.stack([covariance(time) for _ in range(LATENT)])
    return PathPrior(
        paths=torch.randn(movements, time, LATENT),
        independent=independent,
        residuals=0.3 * torch.randn(movements, time, LATENT),
        observation=0.2 * covariance(LATENT) + 0.05 * torch.eye(LATENT),
        bandwidth=0.6,
        shrinkage=0.3,
    )


def test_stationary_covariance_equals_the_mean_over_lags():
    torch.manual_seed(8)
    r = torch.randn(3, 5, LATENT)
    found = stationary(r)
    for t in range(5):
        for s in range(5):
            lag = s - t
            pairs = [(a, a + lag) for a in range(5) if 0 <= a + lag < 5]
            expected = sum(torch.einsum("mi,mj->ij", r[:, a], r[:, b]) for a, b in pairs) / 15
            torch.testing.assert_close(found[t, :, s], expected)
    flat = found.flatten(2).flatten(0, 1)
    assert torch.linalg.eigvalsh(flat).min() > -1e-12


def test_read_out_density_is_that_of_the_linear_map():
    torch.manual_seed(9)
    given = prior().condition(torch.zeros(6, LATENT), torch.arange(6) < 2)
    path, J, std = torch.randn(6, LATENT), torch.randn(6, 3, LATENT), torch.rand(3) + 0.1
    found = given.log_density(path, Readout(J, std))
    t, c = 4, 1
    rows = slice(t * LATENT, (t + 1) * LATENT)
    variance = J[t, c] @ given.covariance[rows, rows] @ J[t, c] + std[c] ** 2
    apart = (given.means[:, t] - path[t]) @ J[t, c]
    each = torch.distributions.Normal(0.0, variance.sqrt()).log_prob(apart)
    torch.testing.assert_close(found[t, c], torch.logsumexp(each + given.log_weights, 0))


@pytest.mark.parametrize("extra", [False, True])
def test_conditioning_equals_the_density_of_the_joint_gaussian(extra: bool):
    """log p(future | seen) = log p(future, seen) − log p(seen), each from the dense mixture."""
    torch.manual_seed(2)
    mixture, time, k = prior(), 6, 4
    y = torch.randn(5, time, LATENT)
    noise = None
    each = mixture.observation.expand(5, time, LATENT, LATENT)
    if extra:
        noise = torch.diag_embed(torch.rand(5, time, LATENT))
        each = each + noise
    given = mixture.condition(y, torch.arange(time) < k, noise)
    full = mixture.covariance.flatten(2).flatten(0, 1)
    future = y.flatten(1)[:, k * LATENT :]
    blocks = torch.stack([torch.block_diag(*e[:k]) for e in each])
    seen = y.flatten(1)[:, : k * LATENT]
    means, cut = mixture.means.flatten(1), k * LATENT

    def log_mixture(x: Tensor, mean: Tensor, covariance: Tensor, log_w: Tensor) -> Tensor:
        normal = torch.distributions.MultivariateNormal(mean, covariance)
        return torch.logsumexp(normal.log_prob(x[..., None, :]) + log_w, -1)

    log_w = torch.full((5, 3), -np.log(3))
    noisy = full.expand(5, -1, -1).clone()
    noisy[:, :cut, :cut] += blocks
    joint = log_mixture(y.flatten(1), means, noisy[:, None], log_w)
    marginal = log_mixture(seen, means[:, :cut], noisy[:, None, :cut, :cut], log_w)
    after = given.covariance[..., cut:, cut:]
    after = after.expand(5, -1, -1)[:, None]
    conditional = log_mixture(future, given.means.flatten(2)[..., cut:], after, given.log_weights)
    torch.testing.assert_close(conditional, joint - marginal, rtol=1e-5, atol=1e-5)


def test_draws_have_the_moments_of_the_mixture():
    torch.manual_seed(4)
    given = prior().condition(torch.zeros(2, 6, LATENT), torch.arange(6) < 2)
    draws = given.sample(20_000).flatten(2)
    weights = given.log_weights.exp()[..., None]
    mean = (weights * given.means.flatten(2)).sum(1)
    error = (draws.mean(0) - mean).abs() / draws.std(0) * len(draws) ** 0.5
    assert error.max() < 5
    between = (weights * (given.means.flatten(2) - mean[:, None]).square()).sum(1)
    variance = given.covariance.diagonal() + between
    torch.testing.assert_close(draws.var(0), variance, rtol=0.1, atol=1e-3)


def test_prior_of_movements_holds_the_paths_of_the_response():
    """Φ u of the stored latents is the roll-out without noise."""
    torch.manual_seed(5)
    data = movements()
    model, guide = build(data)
    batch, posterior = whole(data), GuidePosterior(guide)
    with torch.no_grad():
        model.learn_prior(batch, posterior)
        drawn = posterior.draw(batch, 1)
        one = {n: v[0] for n, v in drawn.items()}
        found = model._latents(drawn)
        u = torch.cat([found.w[0], *(v.transpose(0, 1) for v in (found.goal, found.position))], 1)
        model.prior_movements = torch.cat([u, found.velocity.transpose(0, 1)], 1)
        model.prior_residuals.zero_()
        plan, still = Plan(w=one["w"], goal=one["goal"]), 0 * one["epsilon"]
        path = model.path(one["z"][:, 0], one["velocity"], plan, still, batch)
        torch.testing.assert_close(model._prior(FRAMES).paths, path)


def test_a_section_is_imputed_alike_by_one_factorisation_and_by_one_for_each_movement():
    torch.manual_seed(7)
    data = movements()
    model, guide = build(data)
    batch, posterior = whole(data), GuidePosterior(guide)
    with torch.no_grad():
        model.learn_prior(batch, posterior)
        mask = torch.ones(batch.values.shape, dtype=torch.bool)
        mask[:, 4:7] = False
        shared = model._conditioned(replace(batch, mask=mask), posterior, FRAMES)
        other = torch.cat([mask, torch.ones_like(mask[:1])])
        names = ("values", "start", "sequence")
        four = {n: torch.cat([getattr(batch, n), getattr(batch, n)[:1]]) for n in names}
        each = model._conditioned(replace(batch, mask=other, **four), posterior, FRAMES)
        torch.testing.assert_close(shared.means, each.means[:3], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(shared.covariance, each.covariance[0], rtol=1e-3, atol=1e-4)


def test_goal_change_ends_at_the_goal_and_none_is_the_demonstration():
    torch.manual_seed(6)
    data = movements(2)
    model, guide = build(data)
    with torch.no_grad():
        model.w_noise.zero_()
        batch, posterior = whole(data), GuidePosterior(guide)
        found = model._latents(posterior.draw(batch, 1))
        same = model._aimed(found, found.goal)
        torch.testing.assert_close(same.w, found.w)
        moved = model._aimed(replace(found, w=0 * found.w), found.goal + 1.0)
        torch.testing.assert_close(model._pull(moved, 2 * (FRAMES - 1), 2.0)[:, :, -1], moved.goal)
        assert model._pull(moved, 2 * (FRAMES - 1), 2.0).shape[2] == 2 * (FRAMES - 1)


def test_goal_scaling_keeps_the_shape_of_the_path():
    """Without velocity and noise, (z* − z_0)/(z^goal − z_0) is the same for every goal."""
    torch.manual_seed(7)
    model, guide = build(movements(2), SCALED)
    torch.nn.init.normal_(model.w_common)
    with torch.no_grad():
        drawn = GuidePosterior(guide).draw(whole(movements(2)), 1)
        found = replace(model._latents(drawn), velocity=torch.zeros(1, 2, LATENT))
        shapes = []
        for goal in (found.goal, found.goal + 1.5, 3 - found.goal):
            aimed = model._aimed(found, goal)
            force = model.system.stiffness * model._pull(aimed, FRAMES - 1, 1.0)
            response = Response.of(model.system, FRAMES, force.dtype, force.device)
            args = aimed.position, aimed.velocity, torch.zeros_like(aimed.position), force
            path = response.states(*args)[0]
            span = (goal - aimed.position).unsqueeze(2)
            shapes.append((path - aimed.position.unsqueeze(2)) / span)
    for other in shapes[1:]:
        torch.testing.assert_close(other, shapes[0])


def test_a_movement_left_out_says_nothing_in_its_own_left_out_prior():
    """Replaced by noise, it changes the prior of all, but no number of the prior of the others."""
    torch.manual_seed(8)
    data = movements(5)
    model, guide = build(data)
    noisy = data.values.clone()
    noisy[1] = torch.randn(FRAMES, CHANNELS)
    priors = []
    for values in (data.values, noisy):
        torch.manual_seed(9)
        with torch.no_grad():
            model.learn_prior(whole(replace(data, values=values)), GuidePosterior(guide))
        shape = {"bandwidth": 0.6, "shrinkage": 0.3, "process": 1.0}
        priors.append([replace(p, **shape) for p in (model.prior_without(1), model._prior(FRAMES))])
    (without, every), (other, changed) = priors
    for name in ("means", "covariance", "observation"):
        torch.testing.assert_close(getattr(without, name), getattr(other, name), msg=name)
        assert not torch.allclose(getattr(every, name)[:1], getattr(changed, name)[:1])


def test_noise_of_movements_kept_out_is_the_bound_s_best():
    """No other σ gives the frames of (80) a higher expected density; training's is the least."""
    torch.manual_seed(10)
    data = movements(6)
    model, guide = build(data)
    batch, posterior = whole(data), GuidePosterior(guide)
    with torch.no_grad():
        before = model.output_std.clone()
        model.learn_noise(batch, posterior)
        z = posterior.encode(batch.values).sample((4000,))
        x = model.decoder(model.embed(z))

        def density(std: Tensor) -> Tensor:
            return dist.Normal(x, std).log_prob(batch.values).mean((0, 1, 2))

        best = density(model.output_std)
        raised = model.output_std > before
        assert bool(raised.any())
        for factor in (0.8, 1.25):
            other = density(factor * model.output_std)
            assert bool((other < best)[raised].all())
        quiet = replace(batch, values=x.mean(0))
        after = model.output_std.clone()
        model.learn_noise(quiet, posterior)
        assert bool((model.output_std >= after).all())


@pytest.mark.parametrize("duration", [1.0, 1.7])
def test_the_path_to_another_goal_ends_there(duration: float):
    """With forces and velocities of any size, rolled out step by step."""
    torch.manual_seed(11)
    data = movements(2)
    model, guide = build(data)
    with torch.no_grad():
        found = model._latents(GuidePosterior(guide).draw(whole(data), 3))
        aimed = model._aimed(found, found.goal + torch.randn_like(found.goal))
        steps = round((FRAMES - 1) * duration)
        pull = model._ended(aimed, model._pull(aimed, steps, duration), duration)
        system = replace(model.system, tau=duration)
        z, ż = aimed.position, aimed.velocity / duration
        for t in range(pull.shape[2]):
            z̈ = system.alpha * (system.beta * (pull[:, :, t] - z) - duration * ż) / duration**2
            ż = ż + z̈ * system.dt
            z = z + ż * system.dt
        torch.testing.assert_close(z, aimed.goal)
