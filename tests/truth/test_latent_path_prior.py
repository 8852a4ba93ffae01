"""The arms of the ablation and the report on ε, by simulation of the program."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import torch
from support import movements, run_of

from benchmarks.latent_path_prior import PRIOR_DRAWS, AggregatedPrior, OwnPrior
from zoo.inference.loader import whole
from zoo.models.filters.vae_dmp import Config
from zoo.movement.plan import Plan
from zoo.runs.run import Run
from zoo.studies.chapter6.process_noise import noise_share

DRAWS = 20_000


def simulated(model: OwnPrior, mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
    """Paths of the program, one movement a draw, with w, goal and first state of these moments."""
    data = movements()[:1].to(dtype=torch.float32)
    batch = whole(data).repeat(DRAWS)
    u = mean + std * torch.randn(DRAWS, *mean.shape)
    ε = torch.randn(DRAWS, model.frames - 1, model.latent_dim)
    plan = Plan(w=u[:, :-3], goal=u[:, -3])
    return model.path(u[:, -2], u[:, -1] / model.config.velocity_scale, plan, ε, batch)


def test_the_program_s_own_prior_has_the_moments_of_its_paths() -> None:
    """Six standard errors; g is the identity, so that p(z^goal) is N(0, I) in the space of z*."""
    for kind in (OwnPrior, AggregatedPrior):
        torch.manual_seed(0)
        model = kind(movements().layout, Config(latent_dim=2, hidden=5, kernels=6))
        model.prior_movements = torch.randn(7, 9, 2) + 1
        model.prior_residuals = torch.zeros(7, model.frames, 2)
        model.prior_observation = 1e-4 * torch.eye(2).expand(7, 2, 2)
        with torch.no_grad():
            model.g[-1].bias.zero_()
            mean, variance = model._moments()
            prior = model._prior(model.frames)
            paths = simulated(model, mean.float(), variance.sqrt().float()).double().flatten(1)
        covariance = prior.covariance.flatten(2).flatten(0, 1)
        size = covariance.diagonal().sqrt()
        bar = 6 * math.sqrt(1 / DRAWS + 1 / PRIOR_DRAWS)
        apart = paths.mean(0) - prior.means.flatten()
        assert float((apart / size).abs().max()) < bar
        error = (paths.mT.cov() - covariance) / (size[:, None] * size)
        assert float(error.abs().max()) < math.sqrt(2) * bar


def cloned(run: Run) -> Run:
    """The run with networks of its own."""
    model, guide = copy.deepcopy((run.model, run.assembly.guide))
    return replace(run, assembly=replace(run.assembly, model=model, guide=guide))


def test_noise_that_is_its_prior_carries_nothing() -> None:
    run, data = cloned(run_of("vae-dmp")), movements()[:2]
    before = noise_share(run, data)
    assert all(s.active == 5 and s.nats > 0 and s.of_variance > 0 for s in before)
    noise = run.assembly.guide.noise  # type: ignore[union-attr]
    with torch.no_grad():
        noise.moments.weight.zero_()  # type: ignore[union-attr, operator]
        noise.moments.bias[:5] = 0.0  # type: ignore[union-attr, index]
        noise.moments.bias[5:] = math.sqrt(1 - noise.floor)  # type: ignore[union-attr, index, operator]
    for share in noise_share(run, data):
        assert share.active == 0
        assert abs(share.nats) < 1e-3 and abs(share.of_divergence) < 1e-3


def test_noise_without_a_gain_moves_no_path() -> None:
    run = cloned(run_of("vae-dmp"))
    with torch.no_grad():
        run.model.w_noise.zero_()  # type: ignore[operator, union-attr]
    assert all(share.of_variance == 0 for share in noise_share(run, movements()[:2]))
