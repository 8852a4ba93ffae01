"""Every entry's Pyro program as a user runs it: prior draws, predictive draws, particles, SVI."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cache
from typing import Any

import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import SVI, Predictive, Trace_ELBO
from pyro.poutine.util import prune_subsample_sites
from support import data_of, run_of
from torch import Tensor

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.strategies import Svi
from zoo.errors import NotCapableError
from zoo.inference.loader import Loader
from zoo.models.baselines.ancestral import Ancestral
from zoo.types import Batch

NAMES = [e.name for e in CATALOGUE]
GUIDED = [name for name in NAMES if CATALOGUE[name].guide is not None]
VARIATIONAL = [e.name for e in CATALOGUE if isinstance(e.inference, Svi)]
every = pytest.mark.parametrize("name", NAMES)
guided = pytest.mark.parametrize("name", GUIDED)
variational = pytest.mark.parametrize("name", VARIATIONAL)


@cache
def batch_of(name: str) -> Batch:
    """A few windows of an entry's small data, in the model's scale."""
    run = run_of(name)
    data = run.exchange.scaled(data_of(run.assembly.entry))
    strategy = run.assembly.inference
    if not isinstance(strategy, Svi):
        return Loader(data, batch_size=len(data)).take(torch.arange(len(data)))
    return Loader(data, batch_size=6, window=strategy.window).take(torch.arange(6))


def drawn(run: Any, batch: Batch) -> dict[str, Tensor]:
    """Everything that a program draws, on one random stream."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        trace = poutine.trace(run.model).get_trace(batch)
    return {name: trace.nodes[name]["value"].detach() for name in trace.stochastic_nodes}


def observed_sites(run: Any, batch: Batch) -> dict[str, Tensor]:
    """Data that a program observes; factors and deterministic sites are none."""
    trace = poutine.trace(run.model).get_trace(batch)
    nodes = {name: trace.nodes[name] for name in trace.observation_nodes}
    kinds = {"Unit", "Delta"}
    return {
        name: node["value"]
        for name, node in nodes.items()
        if not kinds & {type(getattr(node["fn"], "base_dist", node["fn"])).__name__}
    }


@every
def test_programs_draw_what_they_observe_and_do_not_look_at_it(name: str) -> None:
    run, batch = run_of(name), batch_of(name)
    seen, prior = observed_sites(run, batch), drawn(run, batch.unobserved())
    assert set(seen) <= set(prior)
    for site, value in seen.items():
        assert prior[site].shape == value.shape
        assert bool(prior[site].isfinite().all()) and not torch.equal(prior[site], value)
    noise = {"values": torch.randn_like(batch.values), "movements": batch.movements.new_full((), 9)}
    noise["movements"] = noise["movements"].expand_as(batch.movements)
    other = drawn(run, replace(batch, **noise).unobserved())
    for site, value in prior.items():
        assert torch.equal(value, other[site]), site


@every
def test_predictive_draws_in_parallel_have_the_law_of_those_in_turn(name: str) -> None:
    run, batch = run_of(name), batch_of(name).unobserved()
    sites = list(observed_sites(run, batch_of(name)))
    found = []
    for count, parallel in ((20, False), (400, True)):
        pyro.set_rng_seed(count)
        draw = Predictive(run.model, num_samples=count, parallel=parallel, return_sites=sites)
        with torch.no_grad():
            found.append(draw(batch))
    for site in sites:
        one, many = (f[site].flatten(1).double() for f in found)
        assert one.shape[1] == many.shape[1]
        error = (one.var(0) / len(one) + many.var(0) / len(many)).sqrt()
        assert float(((one.mean(0) - many.mean(0)).abs() / error).max()) < 6.5
        ratio = one.var(0).mean() / many.var(0).mean()
        assert 0.4 < float(ratio) < 2.5


@every
def test_frames_drawn_in_turn_have_the_law_that_the_density_has(name: str) -> None:
    run, batch = run_of(name), batch_of(name)
    many = replace(batch.repeat(20), total=20 * batch.total, observed=False)
    trace = poutine.trace(run.model).get_trace(many)
    for site in observed_sites(run, batch_of(name)):
        law, x = trace.nodes[site]["fn"], trace.nodes[site]["value"]
        if isinstance(law, Ancestral):
            steps = law.law(x, torch.ones_like(x).bool(), range(x.shape[1]))
            z = (x - steps.mean) / steps.variance.sqrt()
            assert abs(float(z.square().mean()) - 1) < 6 * math.sqrt(2 / z.numel())
            assert torch.allclose(law.log_prob(x), steps.log_prob(x).sum(-1))


@guided
def test_posterior_predictive_draws_are_nearer_to_the_data_than_prior_ones(name: str) -> None:
    run, batch = run_of(name), batch_of(name)
    exact = name not in VARIATIONAL
    for site, value in observed_sites(run, batch).items():
        error = []
        for guide in (None, run.assembly.guide):
            pyro.set_rng_seed(0)
            draw = Predictive(
                run.model, guide=guide, num_samples=20, return_sites=(site,), parallel=True
            )
            found = draw(batch.unobserved())[site].detach().reshape(20, *value.shape)
            error.append(float((found - value).square().mean()))
        assert error[1] < (0.7 if exact else 1.5) * error[0]


@guided
def test_vectorised_particles_agree_with_those_in_turn(name: str) -> None:
    run, batch = run_of(name), batch_of(name)
    losses = []
    for vectorized in (False, True):
        pyro.set_rng_seed(int(vectorized))
        elbo = Trace_ELBO(num_particles=4, vectorize_particles=vectorized)
        with torch.no_grad():
            losses.append(
                torch.tensor([elbo.loss(run.model, run.assembly.guide, batch) for _ in range(8)])
            )
    error = torch.stack([x.var() / len(x) for x in losses]).sum().sqrt()
    rounding = 1e-6 * losses[0].abs().mean()
    assert abs(float(losses[0].mean() - losses[1].mean())) < 6 * float(error) + float(rounding)


@variational
def test_the_bound_is_a_module_for_torchs_own_optimisers(name: str) -> None:
    assembly, batch = copy.deepcopy(run_of(name).assembly), batch_of(name)
    loss = Trace_ELBO()(assembly.model, assembly.guide)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    loss(batch).backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in loss.parameters())
    optimizer.step()
    assert math.isfinite(float(loss(batch).detach()))


@variational
def test_steps_of_pyros_own_inference_move_every_parameter(name: str) -> None:
    run, batch = run_of(name), batch_of(name)
    assembly = copy.deepcopy(run.assembly)
    parts = {"model": assembly.model, "guide": assembly.guide}
    before = {f"{n}.{k}": v.clone() for n, m in parts.items() for k, v in m.named_parameters()}
    pyro.clear_param_store()
    steps = SVI(*assembly.programs(), pyro.optim.Adam({"lr": 1e-3}), Trace_ELBO())
    losses = [steps.step(batch) for _ in range(2)]
    pyro.clear_param_store()
    assert all(map(math.isfinite, losses))
    after = {f"{n}.{k}": v for n, m in parts.items() for k, v in m.named_parameters()}
    assert {k for k, v in after.items() if torch.equal(v, before[k])} == set()


def latent_shapes(run: Any, data: Any) -> dict[str, torch.Size]:
    """Shapes of an entry's latent sites on all of ``data``."""
    batch = Loader(data, batch_size=len(data)).take(torch.arange(len(data)))
    trace = prune_subsample_sites(poutine.trace(run.model).get_trace(batch))
    return {name: trace.nodes[name]["value"].shape for name in trace.stochastic_nodes}


@every
def test_automatic_guides_are_refused_where_sites_are_as_many_as_the_data(name: str) -> None:
    run = run_of(name)
    data = run.exchange.scaled(data_of(run.assembly.entry))
    few, many = latent_shapes(run, data[:3]), latent_shapes(run, data)
    names = getattr(run.model, "global_sites", ())
    assert {site for site, shape in few.items() if many[site] == shape} == set(names)
    if not names:
        with pytest.raises(NotCapableError, match="allows no automatic guide"):
            zoo.create(name, data_of(run.assembly.entry), guide="auto-normal")
