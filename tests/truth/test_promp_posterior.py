"""ProMP's exact guide, its answers and its small samples: dense mixtures and simulation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.special import logsumexp

from zoo.datasets.records import Sequences
from zoo.guides.exact import Config as GuideConfig
from zoo.guides.exact import ExactPosterior
from zoo.inference.elbo import bound
from zoo.inference.loader import whole
from zoo.models.primitives import cross_fitting, promp
from zoo.models.primitives.cross_fitting import choose
from zoo.models.primitives.preparation import Preparation
from zoo.models.primitives.promp import Config, ProMP
from zoo.models.primitives.scales import student_scales
from zoo.movement.timing import Timing
from zoo.prediction.mixtures import cdf
from zoo.streams import seeded
from zoo.types import Wishes

FRAMES, CHANNELS, KERNELS = 14, 2, 4
SIZE = KERNELS * CHANNELS
SEEN = 6


def known(information: float = 1.0) -> ProMP:
    """A rhythmic primitive with five timings and three scales."""
    like = Sequences.from_arrays([np.zeros((FRAMES, CHANNELS))], rate=30.0)
    model = ProMP(like.layout, Config(kind="rhythmic", kernels=KERNELS))
    draw = torch.randn(SIZE, SIZE + 1, generator=torch.Generator().manual_seed(0)).double()
    model.mean, spread = draw[:, 0], draw[:, 1:] / 3
    model.root = torch.linalg.cholesky(spread @ spread.T + 0.05 * torch.eye(SIZE))
    model.noise = torch.tensor([0.2, 0.4], dtype=torch.float64)
    model.synergies = torch.tensor([[1.0, 0.3], [0.0, 1.0]], dtype=torch.float64)
    model.offset = torch.tensor([0.5, -1.0], dtype=torch.float64)
    model.units = torch.tensor([9.0, 9.0, 9.0, 12.0, 12.0], dtype=torch.float64)
    model.offsets = torch.tensor([0.0, 2.0, 4.0, 1.0, 3.0], dtype=torch.float64)
    model.scales = student_scales(3, 3)
    model.information = torch.tensor(information, dtype=torch.float64)
    return model


def simulated(model: ProMP, count: int, seed: int = 0) -> Sequences:
    """Movements drawn from the model's own program."""
    blank = whole(Sequences.from_arrays(np.zeros((count, FRAMES, CHANNELS)), rate=30.0))
    sampled = []
    with seeded(seed, "cpu"):
        trace = promp.poutine.trace(model).get_trace(blank.unobserved())
        sampled.append(trace.nodes["x"]["value"])
    return Sequences.from_arrays(sampled[0].numpy(), rate=30.0)


def dense(model: ProMP) -> list[tuple[np.ndarray, np.ndarray]]:
    """Mean and covariance of all entries under every timing and scale."""
    found = []
    noise = np.diag(np.tile(model.noise.numpy() ** 2, FRAMES))
    for unit, offset in zip(model.units.tolist(), model.offsets.tolist(), strict=True):
        basis = model.basis(FRAMES, Timing(unit, offset))
        design = torch.einsum("tk,cj->tcjk", basis.phases, basis.synergies).reshape(-1, SIZE)
        mean = (design @ model.mean + model.offset.repeat(FRAMES)).numpy()
        path = (design @ model.root @ model.root.T @ design.T).numpy()
        found += [(mean, s**2 * path + noise) for s in model.scales.tolist()]
    return found


def log_densities(model: ProMP, x: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Log density of some entries of one movement under every hypothesis."""
    return np.array(
        [
            stats.multivariate_normal.logpdf(x[some], m[some], v[np.ix_(some, some)])
            for m, v in dense(model)
        ]
    )


def test_the_bound_is_the_dense_log_evidence_at_every_draw():
    model = known()
    data = simulated(model, 5)
    mask = torch.rand(5, FRAMES, CHANNELS, generator=torch.Generator().manual_seed(1)) < 0.7
    holed = replace(data, mask=mask, values=data.values * mask)
    guide = ExactPosterior(data.layout, model, GuideConfig())
    pairs = zip(holed.values.flatten(1).numpy(), mask.flatten(1).numpy(), strict=True)
    each = [logsumexp(log_densities(model, x, some)) - math.log(15) for x, some in pairs]
    batch = whole(holed)
    found = [float(bound(model, guide, batch).elbo) for _ in range(25)]
    np.testing.assert_allclose(found, sum(each), rtol=1e-9)
    half = replace(batch, total_sequences=10)
    np.testing.assert_allclose(float(bound(model, guide, half).elbo), 2 * sum(each), rtol=1e-9)


def test_information_counts_every_entry_a_part_in_program_and_guide():
    part, model = 0.2, known(0.2)
    data = simulated(model, 3)
    wide = known()
    wide.noise = model.noise / math.sqrt(part)
    each = [
        logsumexp(log_densities(wide, x, np.arange(FRAMES * CHANNELS))) - math.log(15)
        for x in data.values.flatten(1).numpy()
    ]
    square = 2 * math.pi * model.noise.square()
    shift = FRAMES * float(((square / part).log() - part * square.log()).sum()) / 2
    guide = ExactPosterior(data.layout, model, GuideConfig())
    found = [float(bound(model, guide, whole(data)).elbo) for _ in range(10)]
    np.testing.assert_allclose(found, sum(each) + 3 * shift, rtol=1e-9)


def test_the_guide_draws_the_posterior_of_timing_and_scale():
    model = known()
    data = simulated(model, 1)
    logs = log_densities(model, data.values[0].flatten().numpy(), np.arange(FRAMES * CHANNELS))
    weight = np.exp(logs - logsumexp(logs))
    guide = ExactPosterior(data.layout, model, GuideConfig())
    with seeded(0, "cpu"):
        drawn = guide(whole(data).repeat(1000))
    share = torch.bincount(3 * drawn["timing"] + drawn["scale"], minlength=15).numpy() / 1000
    assert np.abs(share - weight).max() < 5 * np.sqrt(0.25 / 1000)


def test_forecasts_are_the_dense_mixture(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(promp, "COMPONENTS", 4000)
    model = known()
    data = simulated(model, 3)
    answer = model.forecast(whole(data.first(SEEN)), None, horizon=FRAMES - SEEN, draws=2)
    mean = answer.location.mean(0)
    second = answer.location.square() + answer.epistemic.square() + answer.noise.square()
    variance = second.mean(0) - mean.square()
    past, future = np.arange(SEEN * CHANNELS), np.arange(SEEN * CHANNELS, FRAMES * CHANNELS)
    for i, x in enumerate(data.values.flatten(1).numpy()):
        logs = log_densities(model, x, past)
        weight = np.exp(logs - logsumexp(logs))
        centres, spreads = [], []
        for m, v in dense(model):
            gain = np.linalg.solve(v[np.ix_(past, past)], v[np.ix_(past, future)]).T
            centres.append(m[future] + gain @ (x[past] - m[past]))
            spreads.append(np.diag(v[np.ix_(future, future)] - gain @ v[np.ix_(past, future)]))
        centre = weight @ centres
        total = weight @ (np.array(spreads) + np.square(centres)) - centre**2
        np.testing.assert_allclose(mean[i].flatten(), centre, atol=2e-3)
        np.testing.assert_allclose(variance[i].flatten(), total, rtol=2e-2)


def levels(model: ProMP, data: Sequences, sign: float) -> np.ndarray:
    """Predictive distribution function at one future entry of every movement."""
    answer = model.forecast(whole(data.first(SEEN)), None, horizon=FRAMES - SEEN, draws=2)
    middle = sum(torch.tensor(m) for m, _ in dense(model)).view(FRAMES, CHANNELS)[SEEN:] / 15
    location = middle + sign * (answer.location - middle)
    spread = (answer.noise.square() + answer.epistemic.square()).sqrt()
    level = cdf(location, spread, data.values[:, SEEN:])
    rows = torch.arange(len(data))
    return level[rows, rows % (FRAMES - SEEN), rows % CHANNELS].numpy()


def test_forecasts_of_its_own_movements_have_uniform_levels(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(promp, "COMPONENTS", 64)
    model = known()
    data = simulated(model, 600, seed=3)
    assert stats.kstest(levels(model, data, 1.0), "uniform").pvalue > 1e-3
    assert stats.kstest(levels(model, data, -1.0), "uniform").pvalue < 1e-6


def test_scales_are_those_of_a_t():
    for degrees in (3, 8):
        scales = student_scales(degrees, 2000).numpy()
        for level in (0.75, 0.95, 0.99):
            exact = stats.t.ppf(level, degrees)
            assert abs(stats.norm.cdf(exact / scales).mean() - level) < 1e-3


def curves(count: int, rng: np.random.Generator) -> Sequences:
    """Movements of which no two weights go together for ever: a smooth random walk each."""
    time = np.linspace(0, 1, 40)
    cover = np.exp(-np.abs(time[:, None] - time) / 0.4)
    draws = rng.multivariate_normal(np.sin(5 * time), 0.2 * cover, size=(count, 2))
    smooth = np.exp(-(((time[:, None] - time) / 0.08) ** 2))
    smooth /= smooth.sum(1, keepdims=True)
    values = np.einsum("st,nct->nsc", smooth, draws)
    return Sequences.from_arrays(values + 0.01 * rng.normal(size=values.shape), rate=30.0)


def test_bands_of_four_demonstrations_hold_what_they_promise():
    rng, inside = np.random.default_rng(0), []
    for _ in range(25):
        train, test = curves(4, rng), curves(12, rng)
        model = ProMP(train.layout, Config(kernels=10))
        model.condition(train)
        answer = model.forecast(whole(test.first(8)), None, horizon=32, draws=2)
        spread = (answer.noise.square() + answer.epistemic.square()).sqrt()
        level = cdf(answer.location, spread, test.values[:, 8:])
        inside.append(float(((level - 0.5).abs() < 0.45).double().mean()))
    assert abs(np.mean(inside) - 0.9) < 0.05


def test_nothing_of_a_movement_left_out_is_used_before_it_is_judged(
    monkeypatch: pytest.MonkeyPatch,
):
    rng = np.random.default_rng(1)
    data = curves(6, rng)
    preparation = Preparation("discrete", 5, 1, None)
    movements = [(x, seen) for x, seen in zip(data.values, data.mask, strict=True)]
    asked, left = [], []

    def prepare(rows):
        asked.append(tuple(rows))
        return preparation.of(movements, 30.0, rows)

    def judged(prepared, values, seen):
        left.append(next(i for i, (x, _) in enumerate(movements) if x is values))
        return find(prepared, values, seen)

    find = cross_fitting._held_out
    monkeypatch.setattr(cross_fitting, "_held_out", judged)
    group = torch.tensor([0, 0, 1, 1, 2, 2])
    choose(prepare, movements, group, None, None)
    assert sorted(asked) == [(0, 1, 2, 3), (0, 1, 4, 5), (2, 3, 4, 5)]
    assert left == [0, 1, 2, 3, 4, 5]
    first = preparation.of(movements, 30.0, [0, 1, 2])
    movements[3:] = [(0 * x, seen) for x, seen in movements[3:]]
    again = preparation.of(movements, 30.0, [0, 1, 2])
    assert torch.equal(first.single.target, again.single.target)
    assert torch.equal(first.single.variance, again.single.variance)
    assert torch.equal(first.synergies, again.synergies)


def reaches(count: int, seed: int, goals: int = 0) -> Sequences:
    """Smooth reaches from one place to several, with a bend of their own."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 1, 40)[:, None]
    way = time**3 * (10 - 15 * time + 6 * time**2)
    bend = rng.normal(size=(count, 1, 2)) * np.sin(np.pi * time) ** 2
    ends = np.random.default_rng((seed, goals)).normal([2, -3], 0.5, size=(count, 1, 2))
    values = ends * way + 0.3 * bend
    return Sequences.from_arrays(values + 1e-3 * rng.normal(size=values.shape), rate=30.0)


def generated(model: ProMP, like: Sequences, goal: torch.Tensor):
    """Path and standard deviation of demonstrations that are to end elsewhere."""
    answer = model.generate(whole(like), None, wishes=Wishes(goal=goal), draws=2)
    return answer.location[0], (answer.epistemic.square() + answer.noise.square()).sqrt()[0]


def test_far_goals_neither_throw_the_path_nor_stay_sure_of_it():
    train = reaches(10, 0)
    model = ProMP(train.layout, Config(kernels=12))
    model.condition(train)
    like, ends = train[:5], train.values[:5, -1]
    width = train.values.amax((0, 1)) - train.values.amin((0, 1))

    def size(path):
        return (path.amax(1) - path.amin(1)).mean()

    def acceleration(path):
        return path.diff(n=2, dim=1).square().mean().sqrt()

    same, first = generated(model, like, ends)
    widths = [first.mean()]
    for beyond, most in ((0.1, 1.2), (0.3, 1.6)):
        path, spread = generated(model, like, ends + beyond * width * ends.sign())
        torch.testing.assert_close(path[:, -1], ends + beyond * width * ends.sign())
        torch.testing.assert_close(path[:, 0], same[:, 0])
        assert size(path) < most * size(like.values)
        assert acceleration(path) < most * acceleration(same)
        widths.append(spread.mean())
    assert widths[1] > 2 * widths[0] and widths[2] > 2 * widths[1]


def test_bands_of_another_goal_hold_the_same_movement_to_there():
    train, others = reaches(12, 1), reaches(12, 1, goals=1)
    model = ProMP(train.layout, Config(kernels=12))
    model.condition(train)
    path, spread = generated(model, train, others.values[:, -1])
    inside = ((others.values - path).abs() < 1.645 * spread).double()[:, 5:-3]
    assert float(inside.mean()) > 0.85
    assert float(spread[:, 5:-3].mean()) < float(train.values[:, 5:-3].std(0).mean())
