"""`nearest-neighbour` against loops over places, and a plain re-entry on real walks."""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import zoo
from zoo.datasets.records import Sequences
from zoo.inference.loader import whole
from zoo.models.baselines.analogue_selection import HeldOutAnalogues, Options
from zoo.models.baselines.gaps import Gaps
from zoo.models.baselines.nearest_neighbour import Config, NearestNeighbour
from zoo.models.baselines.re_entry import Library

DATA = os.environ.get("MOVEZOO_DATA", "")
real = pytest.mark.skipif(
    not Path(DATA, "cmu-mocap/35/35.asf").is_file(),
    reason="MOVEZOO_DATA names no folder with cmu-mocap/35",
)
Array = NDArray[np.float64]


def swings(count: int = 8, noise: float = 0.05) -> Sequences:
    """Noisy circles of random phase and tempo, of unequal length."""
    rng = np.random.default_rng(0)
    arrays = []
    for i in range(count):
        angle = rng.uniform(0, 6) + rng.uniform(0.25, 0.35) * np.arange(40 - i % 5)
        circle = np.stack([np.sin(angle), np.cos(angle)], 1)
        arrays.append(circle + noise * rng.normal(size=circle.shape))
    return Sequences.from_arrays(
        arrays, rate=30.0, channels=["hip", "knee"], groups={"trial": range(count)}
    )


def fitted(data: Sequences, **settings: object) -> NearestNeighbour:
    """A model of the data."""
    model = NearestNeighbour(data.layout, Config(**settings))  # type: ignore[arg-type]
    model.condition(data)
    return model


def local_minima(costs: list[Array], count: int) -> list[tuple[int, int]]:
    """(movement, place) of the cheapest that no neighbour undercuts; in turn if there are few."""
    found = []
    for i, cost in enumerate(costs):
        edged = np.concatenate([[np.inf], cost, [np.inf]])
        low = (cost <= edged[:-2]) & (cost <= edged[2:]) & np.isfinite(cost)
        found += [(cost[t], i, t) for t in np.flatnonzero(low)]
    best = sorted(found)[:count]
    return [best[n % len(best)][1:] for n in range(count)]


def run_costs(train: list[Array], query: Array) -> list[Array]:
    """Mean squared difference of the query to the run that ends at each frame."""
    c = len(query)
    return [
        np.array(
            [
                np.inf if t < c - 1 else ((a[t + 1 - c : t + 1] - query) ** 2).mean()
                for t in range(len(a))
            ]
        )
        for a in train
    ]


def by_loops(
    train: list[Array], query: Array, horizon: int, count: int, align: str, again: bool
) -> Array:
    """Continuations of the best places, step by step."""
    context = max(1, min(10, min(map(len, train)) // 2))
    jumps = []
    for a in train:
        costs = run_costs(train, a[-context:])
        for cost, b in zip(costs, train, strict=True):
            cost[len(b) - max(len(b) // 4, 1) :] = np.inf
        jumps.append(local_minima(costs, 1)[0])
    paths = []
    for i, t in local_minima(run_costs(train, query), count):
        offset = query[-1] - train[i][t]
        if align == "mean":
            offset = (query - train[i][t + 1 - len(query) : t + 1]).mean(0)
        path = []
        for h in range(1, horizon + 1):
            if t + 1 < len(train[i]):
                t += 1
            elif again:
                i, t = jumps[i][0], jumps[i][1] + 1
            fade = {"none": 0.0, "fading": np.exp(-h / len(query))}.get(align, 1.0)
            path.append(train[i][t] + fade * offset)
        paths.append(path)
    return np.array(paths)


@pytest.mark.parametrize("align", ["none", "last", "mean", "fading"])
@pytest.mark.parametrize("again", [True, False])
def test_forecasts_equal_loops(align: str, again: bool) -> None:
    """From every training frame on, over ends of movements."""
    data = swings()
    model = fitted(data[:6], neighbours=4, context=4, align=align, re_enter=again)
    answer = model.forecast(whole(data[6:].first(12)), None, horizon=50, draws=1)
    for i, query in enumerate(data[6:].first(12).arrays):
        expected = by_loops(data[:6].arrays, query[-4:], 50, 4, align, again)
        np.testing.assert_allclose(answer.location[:, i].numpy(), expected, atol=1e-10)


def test_the_choice_has_the_least_held_out_error() -> None:
    """Against loops over folds, starts and all combinations."""
    data = swings(6).first(34)
    frames, score = 34, {}
    options = Options([1, 3], [1, 4], ["none", "fading"], [True, False])
    for context, n, align, again in product(*vars(options).values()):
        total = 0.0
        for f in range(4):
            train = [a for i, a in enumerate(data.arrays) if i % 4 != f]
            for a in data.arrays[f::4]:
                for k in (3, frames // 4, frames // 2, 3 * frames // 4):
                    near = by_loops(train, a[k - context : k], frames - k, n, align, again)
                    total += float(((near.mean(0) - a[k:]) ** 2).sum())
        score[context, n, align, again] = total
    model = fitted(data)
    chosen = HeldOutAnalogues(model.library, torch.arange(6) % 4).chosen(options)
    assert tuple(vars(chosen).values()) == min(score, key=lambda one: score[one])
    assert chosen.re_enter


def test_bands_have_the_variance_of_held_out_errors() -> None:
    """s of a lead by loops, after the whole context and after one frame."""
    data = swings()
    settings = {"neighbours": 2, "context": 3, "align": "none", "re_enter": True}
    model = fitted(data, positions=5, **settings)
    frames = data.values.shape[1]
    for level, known in enumerate((1, 3)):
        error, spread = [], []
        for k in {round(known + i * (frames - 1 - known) / 4) for i in range(5)}:
            for i, a in enumerate(data.arrays):
                if len(a) <= k + 2:
                    continue
                train = [b for j, b in enumerate(data.arrays) if j % 4 != i % 4]
                near = by_loops(train, a[k - known : k], 3, 2, "none", True)[:, 2]
                error.append((a[k + 2] - near.mean(0)) ** 2)
                spread.append(near.var(0))
        error, spread = np.mean(error, 0), np.mean(spread, 0)
        expected = np.maximum(error - spread, error / 4)
        np.testing.assert_allclose(model.noise[level, 2].square().numpy(), expected, rtol=1e-9)


def test_gaps_equal_loops() -> None:
    """Every frame from the best places of the movement around it, as they are and moved."""
    data = swings(4).first(12)
    x, decay = data.values[3], 2.0
    mask = torch.rand(12, 2, generator=torch.Generator().manual_seed(0)) > 0.4
    train, m = data[:3].arrays, mask.numpy()
    everybody = torch.ones(3, dtype=torch.bool)
    library = Library(data.values[:3], data.mask[:3], data.lengths[:3], everybody)
    found = Gaps(library, decay).filled(x, mask, everybody, 2)
    variance = float(np.mean(np.concatenate(train).var(0)))
    for t in range(12):
        weight = np.exp(-np.abs(np.arange(12) - t) / decay)
        costs: list[Array] = []
        for a in train:
            row = []
            for lag in range(-11, 12):
                if not 0 <= t + lag < 12:
                    row.append(np.inf)
                    continue
                square = both = 0.0
                for u in (u for u in range(12) if 0 <= u + lag < 12):
                    square += weight[u] * (m[u] * (x[u].numpy() - a[u + lag]) ** 2).sum()
                    both += weight[u] * m[u].sum()
                full = (weight * m.sum(1)).sum()
                row.append((square + 2 * variance * (full - both)) / full)
            costs.append(np.array(row))
        for n, (i, shift) in enumerate(local_minima(costs, 2)):
            lag = shift - 11
            np.testing.assert_allclose(found[0, n, t].numpy(), train[i][t + lag], atol=1e-12)
            pairs = [u for u in range(12) if 0 <= u + lag < 12]
            w = weight[pairs, None] * m[pairs]
            below = (w * (x.numpy()[pairs] - train[i][[u + lag for u in pairs]])).sum(0) / w.sum(0)
            np.testing.assert_allclose(found[1, n, t].numpy(), train[i][t + lag] + below, atol=1e-9)


def test_imputation_shifts_only_where_that_helps() -> None:
    """Circles of an own height are shifted, those whose height is their phase's are not."""
    data = swings(12, noise=0.01)
    mask = data.mask.clone()
    mask[:, 15:30, 0] = False
    plain = fitted(data[:10])
    rng = np.random.default_rng(1)
    arrays = [a + rng.normal(0, 5, size=(1, 2)) for a in data.arrays]
    raised = Sequences.from_arrays(arrays, rate=30.0)
    for model, record, shifted in ((plain, data, False), (fitted(raised[:10]), raised, True)):
        _, _, align, s = model._tuned(mask[0], 20)
        assert align == shifted or not shifted
        holed = replace(record[10:], mask=mask[10:])
        answer = model.impute(whole(holed), None, draws=1)
        hidden = data.mask[10:] & ~mask[10:]
        error = (answer.location.mean(0) - record.values[10:])[hidden]
        assert float(error.square().mean().sqrt()) < 0.5
        assert float(error.square().mean().sqrt()) < 4 * float(s[0] + answer.location.std(0).mean())


def test_it_finds_a_movement_that_it_knows() -> None:
    """The past of a training movement is continued by its future."""
    data = swings()
    model = fitted(data, neighbours=1, context=6)
    future = model.forecast(whole(data[:1].first(12)), None, horizon=10, draws=1)
    torch.testing.assert_close(future.location[0], data.values[:1, 12:22])
    keep = torch.rand(3, 20, 2, generator=torch.Generator().manual_seed(1)) > 0.4
    start = data[:3].first(20)
    holed = replace(start, mask=keep, values=torch.where(keep, start.values, 0.0))
    filled = model.impute(whole(holed), None, draws=1)
    torch.testing.assert_close(filled.location[0], start.values)


def test_leaving_out_groups_widens_the_bands_of_a_group_that_repeats_itself() -> None:
    """Twins may not forecast each other where their group is left out."""
    rng = np.random.default_rng(0)
    own = rng.normal(size=(4, 30, 2)).cumsum(1)
    arrays = [own[i // 2] + 0.01 * rng.normal(size=(30, 2)) for i in range(8)]
    groups = {"trial": range(8), "subject": [i // 2 for i in range(8)]}
    data = Sequences.from_arrays(arrays, rate=30.0, groups=groups)
    settings = {"neighbours": 1, "context": 5, "align": "last", "re_enter": False}
    asked_of = fitted(data, **settings)
    subject = fitted(data, leave_out="subject", **settings)
    assert bool((subject.noise[-1, :10] > 5 * asked_of.noise[-1, :10]).all())


@real
def test_on_real_walks_it_is_no_worse_than_a_plain_re_entry_at_any_frame() -> None:
    """Five places by their last ten frames, continued and entered again; Setup 2's question."""
    walks = zoo.load_data("cmu-mocap/35-walk", frames=None).frames(0, 300)
    train, test = walks.values[4:].numpy(), walks.values[:4].numpy()
    scale = train.std((0, 1))

    def place(query: Array, pool: Array) -> list[tuple[int, int]]:
        runs = np.lib.stride_tricks.sliding_window_view(pool, 10, axis=1)
        cost = (((runs - query.T) / scale[:, None]) ** 2).mean((2, 3))
        best = cost.argmin(1)
        order = cost.min(1).argsort()[:5]
        return [(int(i), int(best[i]) + 9) for i in order]

    jumps = [place(a[-10:], train[:, :225])[0] for a in train]
    missed = []
    for movement in test:
        paths = []
        for i, t in place(movement[90:100], train):
            path = []
            for _ in range(200):
                i, t = (i, t + 1) if t + 1 < 300 else (jumps[i][0], jumps[i][1] + 1)
                path.append(train[i, t])
            paths.append(path)
        missed.append(((np.mean(paths, 0) - movement[100:]) ** 2).mean())
    run = zoo.fit(zoo.create("nearest-neighbour", walks[4:], seed=0), walks[4:])
    ahead = run.forecast(walks[:4].first(100), horizon=200, draws=2)
    truth = walks.values[:4, 100:]
    assert float((ahead.mean - truth).square().mean()) < np.mean(missed)
    low, high = ahead.interval(0.9)
    assert 0.85 < float(((truth > low) & (truth < high)).double().mean()) < 0.95
