"""AE-DMP against the same numbers by other roads."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from pyro import poutine
from support import movements

from zoo.contract.strategies import Svi
from zoo.datasets.records import Sequences
from zoo.guides import point
from zoo.inference.loader import whole
from zoo.inference.posterior import GuidePosterior
from zoo.inference.svi import fit_svi
from zoo.models.primitives import ae_dmp
from zoo.models.primitives.imitator import Imitator
from zoo.models.primitives.population import Population

IMITATOR = Imitator(frames=40, kernels=8)
SOFT = torch.finfo(torch.float32).eps ** 0.5


def stepped(θ: torch.Tensor, imitator: Imitator, force: torch.Tensor) -> torch.Tensor:
    """The roll-out of θ frame by frame: ÿ = α(β(g − y) − ẏ) + f, semi-implicit Euler."""
    system = imitator.system
    y, velocity, goal = θ[0], 10 * θ[1], θ[2]
    path = [y]
    for f in force:
        velocity = velocity + system.dt * (
            system.alpha * (system.beta * (goal - y) - velocity) + system.stiffness * f
        )
        y = y + system.dt * velocity
        path.append(y)
    return torch.stack(path)


def theta(seed: int = 0) -> torch.Tensor:
    return torch.randn(11, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_roll_out_is_that_of_single_steps() -> None:
    θ = theta()
    force = 3 * IMITATOR.kernels_at(39) @ θ[3:]
    torch.testing.assert_close(IMITATOR.roll_out(θ), stepped(θ, IMITATOR, force))


def test_the_target_force_steps_through_any_path() -> None:
    path = torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    θ = IMITATOR.fit(path)
    _, target = IMITATOR.forces(path, θ)
    start = torch.cat([path[:1], path[1:2].sub(path[:1]) / IMITATOR.system.dt / 10, θ[2:]])
    rest = stepped(start, IMITATOR, target)
    torch.testing.assert_close(rest[1:], path[1:], rtol=0, atol=1e-9)


def test_force_and_target_agree_on_a_roll_out_after_its_first_step() -> None:
    θ = theta(2)
    force, target = IMITATOR.forces(IMITATOR.roll_out(θ), θ)
    torch.testing.assert_close(force[1:], target[1:], rtol=0, atol=1e-9)


def test_the_regression_finds_a_roll_out_again_also_where_a_section_is_missing() -> None:
    path = IMITATOR.roll_out(theta(3))
    seen = torch.ones(40, dtype=torch.bool)
    torch.testing.assert_close(IMITATOR.fit(path, seen), IMITATOR.fit(path))
    seen[12:18] = False
    holed = torch.where(seen[:, None], path, 99.0 * ~seen[:, None])
    error = (IMITATOR.roll_out(IMITATOR.fit(holed * seen[:, None], seen)) - path)[seen]
    assert float(error.abs().max()) < 1e-2


def test_unstable_constants_are_refused_with_a_safe_one() -> None:
    with pytest.raises(ValueError, match=r"4\.4 is safe"):
        Imitator(frames=12, alpha=60.0)


def joint(
    config: ae_dmp.Config, data: Sequences
) -> tuple[ae_dmp.AeDmp, poutine.Trace, poutine.Trace]:
    """Model with the traces of its guide and of the program given it."""
    torch.manual_seed(0)
    model = ae_dmp.AeDmp(data.layout, config)
    guide = point.PointGuide(data.layout, model, point.Config(corruption=0.0))
    batch = whole(data.to(dtype=torch.float32))
    drawn = poutine.trace(guide).get_trace(batch)
    trace = poutine.trace(poutine.replay(model, drawn)).get_trace(batch)
    trace.compute_log_prob()
    return model, drawn, trace


def by_hand(model: ae_dmp.AeDmp, y: torch.Tensor, θ: torch.Tensor, x: torch.Tensor) -> float:
    """The sum in (72) over 2σ², with the normalisers of its two Gaussians."""
    λ, σ, total = model.config.penalty, float(model.σ.detach()), 0.0
    for path, parameters, truth in zip(y.double(), θ.double(), x.double(), strict=True):
        force = 3 * model.imitator.kernels_at(len(path) - 1) @ parameters[3:]
        rolled = stepped(parameters, model.imitator, force).float()
        reconstruction = (truth - model.decoder(rolled).double()).square().sum()
        system = model.imitator.system
        velocity = torch.cat([path[1:2] - path[:1], path.diff(dim=0)]) / system.dt
        spring = system.stiffness * (parameters[2] - path[:-1])
        target = velocity.diff(dim=0) / system.dt - spring + system.alpha * velocity[:-1]
        penalty = (force - target / system.stiffness).square().sum()
        total += float((reconstruction + λ * penalty).detach()) / (2 * σ**2)
        total += truth.numel() * math.log(σ * math.sqrt(2 * math.pi))
        total += force.numel() * math.log(σ / math.sqrt(λ) * math.sqrt(2 * math.pi))
    return total


def test_minus_the_log_joint_is_the_objective_of_the_thesis() -> None:
    data = movements()
    model, drawn, trace = joint(ae_dmp.Config(latent_dim=3, penalty=0.02), data)
    y, θ = (drawn.nodes[n]["value"].detach() for n in ("y", "theta"))
    expected = by_hand(model, y, θ, data.values)
    found = -sum(float(trace.nodes[n]["log_prob_sum"].detach()) for n in ("x", "f"))
    assert found == pytest.approx(expected, rel=SOFT)


def test_the_sparse_prior_is_the_l1_norm() -> None:
    η = 5.0
    config = ae_dmp.Config(latent_dim=3, prior="laplace", prior_scale=1 / η)
    _, drawn, trace = joint(config, movements())
    y = drawn.nodes["y"]["value"].detach()
    expected = η * float(y.abs().sum()) - y.numel() * math.log(η / 2)
    assert -float(trace.nodes["y"]["log_prob_sum"].detach()) == pytest.approx(expected, rel=SOFT)


def test_pretraining_is_the_autoencoder_alone_and_then_both_are_joined() -> None:
    data = movements().to(dtype=torch.float32)
    model = ae_dmp.AeDmp(data.layout, ae_dmp.Config(latent_dim=3, pretraining=0.5))
    guide = point.PointGuide(data.layout, model, point.Config(corrupted=0.25, corruption=0.2))
    stages = []

    def note(row: object) -> None:
        stages.append((model.integrated, guide.corrupt.p))

    fit_svi(model, guide, data, Svi(window=None, epochs=8, batch_size=8), on_epoch=note)
    assert [joined for joined, _ in stages] == [False] * 4 + [True] * 4
    assert [p for _, p in stages] == [0.2] * 2 + [0.0] * 6


def test_dropped_runs_have_their_length_and_every_entry_its_probability() -> None:
    torch.manual_seed(0)
    n, p, together = 20_000, 0.2, 4
    kept = point.RunDropout(p, together)(torch.ones(n, 10)) * (1 - p)
    assert set(kept.unique().tolist()) == {0.0, 1.0}
    share = (kept == 0).double().mean(0)
    assert bool(((share - p).abs() < 6 * math.sqrt(p * (1 - p) / n)).all())
    inner = kept[:, 3:7]
    alone = (inner[:, 1:-1] == 0) & (inner[:, :-2] > 0) & (inner[:, 2:] > 0)
    assert not bool(alone.any())
    whole_run = float((inner == 0).all(1).double().mean())
    assert whole_run > 1 - (1 - p) ** (1 / together) > p**together


def test_runs_of_one_are_the_usual_dropout_and_rest_after_the_training() -> None:
    x, runs = torch.randn(50, 10), point.RunDropout(0.3, 3)
    torch.manual_seed(1)
    ours = point.RunDropout(0.3)(x)
    torch.manual_seed(1)
    torch.testing.assert_close(ours, torch.nn.functional.dropout(x, 0.3), rtol=0, atol=0)
    torch.testing.assert_close(runs.eval()(x), x, rtol=0, atol=0)


def test_missing_joints_are_the_chain_by_hand_and_the_roll_out_nearest_to_it() -> None:
    """A movement of which all was seen beside it is encoded and decoded alone."""
    data, chain = movements().to(dtype=torch.float32), 3
    torch.manual_seed(0)
    model = ae_dmp.AeDmp(data.layout, ae_dmp.Config(latent_dim=3, chain=chain))
    guide = point.PointGuide(data.layout, model, point.Config()).eval()
    mask = torch.ones_like(data.values, dtype=torch.bool)
    mask[:-1, :, 1] = False
    holed = replace(whole(data), values=data.values * mask, mask=mask)
    with torch.no_grad():
        x = holed.values
        for _ in range(chain):
            x = torch.where(mask, x, model.decoder(guide.encoder(x)))
        path = guide.encoder(x)
        expected = model.decoder(model.imitator.roll_out(model.imitator.fit(path)))
        found = model.impute(holed, GuidePosterior(guide), draws=1).location[0]
        alone = model.decoder(guide.encoder(data.values[-1]))
    torch.testing.assert_close(found[:-1], expected[:-1])
    torch.testing.assert_close(found[-1], alone)


def test_the_parts_that_stay_apart_are_never_joined() -> None:
    model, _, trace = joint(ae_dmp.Config(latent_dim=3, pretraining=1.0), movements())
    assert "f" not in trace.nodes
    for done in (0.0, 0.5, 1.0):
        model.advance(done)
        assert model.settled and not model.integrated


def test_a_population_is_conditioned_on_each_movement_by_itself() -> None:
    torch.manual_seed(0)
    prior = Population(
        torch.randn(2, 4, dtype=torch.float64),
        torch.randn(2, 4, 3, dtype=torch.float64),
        torch.randn(2, 4, 4, dtype=torch.float64),
    )
    root = torch.randn(5, 1, 4, 4, dtype=torch.float64)
    precision, linear = root @ root.mT, torch.randn(5, 2, 4, dtype=torch.float64)
    together = prior.condition(precision, linear)
    for i in range(5):
        alone = prior.condition(precision[i], linear[i : i + 1])
        torch.testing.assert_close(together.mean[i : i + 1], alone.mean)
        torch.testing.assert_close(together.loadings[i], alone.loadings)
