"""PCA-DMP against one dense Gaussian of all channels and frames of a movement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from pyro import poutine
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from zoo.datasets.records import Sequences
from zoo.guides.exact import Config as ExactConfig
from zoo.guides.exact import ExactPosterior
from zoo.inference.elbo import bound
from zoo.inference.loader import whole
from zoo.models.primitives import dmp
from zoo.models.primitives.pca_dmp import Config, PcaDmp
from zoo.streams import seeded
from zoo.types import Batch

FRAMES, CHANNELS, LATENT, KERNELS = 20, 5, 2, 4
JOINTS, SECTION, BOTH = "joints", "section", "both"


def data(count: int = 6) -> Sequences:
    """Two smooth sources, mixed, with noise."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, FRAMES)[:, None]
    mixing = rng.normal(size=(LATENT, CHANNELS))
    arrays = []
    for _ in range(count):
        first = np.sin(2 * np.pi * time + rng.normal(scale=0.3))
        sources = np.concatenate([first, time * rng.normal(1, 0.3)], 1)
        arrays.append(sources @ mixing + 0.05 * rng.normal(size=(FRAMES, CHANNELS)))
    return Sequences.from_arrays(arrays, rate=30.0)


def trained(count: int = 6, *, plain: bool) -> tuple[PcaDmp, Sequences]:
    """A model, without scales and at full information where one Gaussian is to be compared."""
    movements = data(count)
    model = PcaDmp(movements.layout, Config(latent_dim=LATENT, kernels=KERNELS))
    model.condition(movements)
    model.dmp.ratio = model.dmp.ratio + torch.tensor([0.5, 0.0])
    if plain:
        model.dmp.scales, model.dmp.information = torch.ones(1).double(), torch.ones(()).double()
    return model, movements


def hidden(kind: str | None) -> torch.Tensor:
    """Entries observed, one movement's."""
    seen = torch.ones(FRAMES, CHANNELS, dtype=torch.bool)
    if kind in (JOINTS, BOTH):
        seen &= torch.rand(seen.shape, generator=torch.Generator().manual_seed(1)) < 0.6
        seen[3] = torch.tensor([False, True, False, False, False])
    if kind in (SECTION, BOTH):
        seen[8:13] = False
    return seen


def steps(model: PcaDmp) -> tuple[np.ndarray, np.ndarray]:
    """Paths of unit parameters and of unit forces of a component, frame by frame."""
    α, β, dt = 25.0, 25.0 / 4, 1 / (FRAMES - 1)
    kernels = model.dmp.primitive.basis(FRAMES, model.dmp.expected.whole(FRAMES)[0])[:-1].numpy()
    size = 3 + KERNELS

    def roll(y: float, velocity: float, goal: float, force: np.ndarray) -> list[float]:
        path = [y]
        for f in force:
            velocity += dt * (α * (β * (goal - y) - velocity) + f)
            y += dt * velocity
            path.append(y)
        return path

    unit, still = np.eye(size), np.zeros(FRAMES - 1)
    design = [roll(*θ[:3], kernels @ θ[3:]) for θ in unit]
    forces = np.array([roll(0, 0, 0, f) for f in np.eye(FRAMES - 1)]).T
    long = np.array(roll(0, 0, 0, np.r_[1.0, np.tile(still, 40)])[1:])
    return np.array(design).T, forces / np.sqrt((long**2).sum())


def dense(model: PcaDmp, information: float = 1.0) -> tuple[np.ndarray, ...]:
    """Mean, covariance by θ and covariance by noise of (frame, channel) in one vector."""
    design, forces = steps(model)
    d, f = model.dmp, model.pca.factors()
    w = np.kron(np.eye(FRAMES), f.loading.numpy())
    order = np.arange(LATENT * FRAMES).reshape(LATENT, FRAMES).T.ravel()
    θ = np.kron(np.eye(LATENT), design)[order]
    shared = d.factors.flatten(0, 1).numpy()
    alone = torch.block_diag(*(v @ v.T for v in d.private)).numpy()
    least = (f.noise.square() / f.loading.square().sum(0)).numpy()
    force = d.noise.square().numpy()
    white = np.maximum(force * d.ratio.numpy() - least, 0)
    process = np.kron(np.diag(force), forces @ forces.T) + np.kron(np.diag(white), np.eye(FRAMES))
    mean = w @ θ @ d.mean.flatten().numpy() + np.tile(f.mean.numpy(), FRAMES)
    root = w @ θ
    noise = w @ process[np.ix_(order, order)] @ w.T + float(f.noise) ** 2 * np.eye(len(w))
    return mean, root @ (shared @ shared.T + alone) @ root.T, noise


def log_evidence(model: PcaDmp, x: np.ndarray, seen: np.ndarray) -> float:
    """log ∫ p(θ) p(x | θ)^c dθ: c divides the noise, but not its normalising constant."""
    c, each = float(model.dmp.information), []
    mean, prior, noise = (m[seen] if m.ndim == 1 else m[np.ix_(seen, seen)] for m in dense(model))
    _, volume = np.linalg.slogdet(2 * np.pi * noise)
    rest = (1 - c) / 2 * volume - len(mean) / 2 * np.log(c)
    for s in model.dmp.scales.tolist():
        law = multivariate_normal(mean, s**2 * prior + noise / c)
        each.append(law.logpdf(x[seen]) + rest)
    return float(logsumexp(each)) - np.log(len(each))


def masked(batch: Batch, seen: torch.Tensor) -> Batch:
    """The same movements with the entries ``seen``, whatever stands for the others."""
    mask = seen.expand_as(batch.values)
    values = torch.where(mask, batch.values, 7.0)
    return replace(batch, values=values, mask=mask, movements=values, movement_mask=mask)


@pytest.mark.parametrize("kind", [None, JOINTS, SECTION, BOTH])
@pytest.mark.parametrize(("count", "information"), [(6, 1.0), (6, 0.3), (1, 1.0)])
def test_the_bound_is_the_density_of_the_dense_gaussian_at_every_draw(
    kind: str | None, count: int, information: float
) -> None:
    model, movements = trained(count, plain=False)
    model.dmp.information = torch.tensor(information).double()
    seen = hidden(kind)
    batch = masked(whole(movements[[0, min(2, count - 1)]]), seen)
    guide = ExactPosterior(movements.layout, model, ExactConfig())
    found = []
    for seed in range(4):
        with seeded(seed), torch.no_grad():
            found.append(float(bound(model, guide, batch).elbo))
    rows = batch.values.flatten(1).numpy()
    expected = sum(log_evidence(model, x, seen.flatten().numpy()) for x in rows)
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_movements_with_other_entries_missing_go_by_themselves() -> None:
    model, movements = trained(plain=False)
    batch = whole(movements[[0, 1, 2]])
    seen = torch.stack([hidden(k) for k in (None, JOINTS, SECTION)])
    batch = replace(batch, movement_mask=seen)
    guide = ExactPosterior(movements.layout, model, ExactConfig())
    with seeded(0), torch.no_grad():
        found = float(bound(model, guide, batch).elbo)
    pairs = zip(batch.movements.flatten(1).numpy(), seen.flatten(1).numpy(), strict=True)
    np.testing.assert_allclose(found, sum(log_evidence(model, *p) for p in pairs), rtol=1e-7)


@pytest.mark.parametrize("kind", [None, JOINTS, SECTION, BOTH])
def test_what_is_filled_in_is_the_conditional_of_the_dense_gaussian(kind: str | None) -> None:
    model, movements = trained(plain=True)
    seen = hidden(kind)
    s, x = seen.flatten().numpy(), movements.values[0].flatten().numpy()
    mean, prior, noise = dense(model)
    total, white = prior + noise, float(model.pca.noise) ** 2
    shown = total - white * np.eye(len(total))
    gain = np.linalg.solve(total[np.ix_(s, s)], shown[s]).T
    batch = masked(whole(movements[[0]]), seen)
    found = model.impute(batch, None, draws=2)
    path = mean + gain @ (x[s] - mean[s])
    variance = np.diag(shown) - np.einsum("ij,ji->i", gain, shown[s])
    assert found.epistemic is not None and found.noise is not None
    np.testing.assert_allclose(found.location.flatten(), path, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.epistemic.flatten(), variance**0.5, rtol=1e-4, atol=1e-6)
    assert float(found.noise) ** 2 == pytest.approx(white)


def test_a_forecast_is_the_gap_at_the_end() -> None:
    model, movements = trained(plain=True)
    seen = (torch.arange(FRAMES) < 8)[:, None].expand(-1, CHANNELS)
    gap = model.impute(masked(whole(movements[[0]]), seen), None, draws=1)
    found = model.forecast(whole(movements[[0]].first(8)), None, horizon=12, draws=1)
    torch.testing.assert_close(found.location, gap.location[:, :, 8:])
    torch.testing.assert_close(found.epistemic, gap.epistemic[:, :, 8:])


@pytest.mark.parametrize("kind", [None, JOINTS, SECTION])
def test_draws_have_the_moments_of_the_closed_form(kind: str | None) -> None:
    model, movements = trained(plain=True)
    batch, count = masked(whole(movements[[0, 1]]), hidden(kind)), 4000
    for answer in (model.impute, model.reconstruct, model.represent):
        with seeded(0):
            found = answer(batch, None, draws=count)
        assert found.draws is not None and found.epistemic is not None
        error = (found.draws.mean(0) - found.location[0]).abs() / found.epistemic[0]
        assert float(error.max()) < 6 / count**0.5
        ratio = found.draws.var(0) / found.epistemic[0].square()
        assert float((ratio - 1).abs().max()) < 6 * (2 / count) ** 0.5


def test_the_program_draws_from_the_dense_gaussian() -> None:
    model, _ = trained(plain=True)
    blank = Sequences.from_arrays(np.zeros((4000, FRAMES, CHANNELS)), rate=30.0)
    with seeded(1), torch.no_grad():
        trace = poutine.trace(model).get_trace(whole(blank).unobserved())
    x = trace.nodes["x"]["value"].flatten(1).numpy()
    mean, prior, noise = dense(model)
    white = np.linalg.solve(np.linalg.cholesky(prior + noise), (x - mean).T)
    assert np.abs(white.mean(1)).max() < 6 / len(x) ** 0.5
    second = white @ white.T / len(x) - np.eye(len(white))
    assert np.abs(second).max() < 6 * (2 / len(x)) ** 0.5


def test_whole_frames_are_those_of_dmp_in_the_components() -> None:
    model, movements = trained(plain=False)
    f = model.pca.factors()
    z = (movements.values - f.mean) @ torch.linalg.pinv(f.loading).T
    z = replace(
        movements,
        values=z,
        mask=torch.ones_like(z, dtype=torch.bool),
        channels=("z_1", "z_2"),
        units=("", ""),
    )
    alone = dmp.DMP(z.layout, dmp.Config(kernels=KERNELS))
    alone.condition(z)
    alone.ratio = model.dmp.ratio
    path = alone.reconstruct(whole(z), None, draws=1).location
    found = model.reconstruct(whole(movements), None, draws=1).location
    torch.testing.assert_close(found, path @ f.loading.T + f.mean, rtol=1e-6, atol=1e-6)


def test_draws_and_closed_form_agree_over_scales() -> None:
    model, movements = trained(plain=False)
    count = 4000
    with seeded(0):
        found = model.forecast(whole(movements.first(8)), None, horizon=6, draws=count)
    assert found.draws is not None and found.epistemic is not None
    variance = found.epistemic.square().mean(0) + found.location.var(0, correction=0)
    ratio = found.draws.var(0) / variance
    kurtosis = found.epistemic.pow(4).mean(0) / found.epistemic.square().mean(0).square()
    assert float((ratio - 1).abs().max()) < 6 * (2 * float(kurtosis.max()) / count) ** 0.5


def test_a_component_that_no_channel_shows_says_nothing() -> None:
    movements = data()
    flat = replace(movements, values=movements.values * torch.tensor([1.0, 0, 0, 0, 0]))
    model = PcaDmp(flat.layout, Config(latent_dim=3, kernels=KERNELS))
    model.condition(flat)
    for kind in (None, JOINTS):
        found = model.impute(masked(whole(flat[[0]]), hidden(kind)), None, draws=2)
        assert found.epistemic is not None
        assert bool(found.location.isfinite().all() and found.epistemic.isfinite().all())
        assert float(found.location[..., 1:].abs().max()) < 1e-2
