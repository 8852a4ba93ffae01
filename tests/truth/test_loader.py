"""Batches: every window once, with the movement it was cut from, in a repeatable order."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from zoo.datasets.records import Pairs, Sequences
from zoo.inference.loader import Loader, whole


def ragged(missing: bool = False) -> Sequences:
    """Movements whose values tell sequence and frame."""
    parts = [np.arange(n)[:, None] + 100.0 * i + np.zeros(2) for i, n in enumerate((7, 5, 9))]
    if missing:
        parts[1][2, 1] = np.nan
    return Sequences.from_arrays(parts, rate=10.0)


def test_epoch_holds_every_window_once() -> None:
    data = ragged()
    loader = Loader(data, batch_size=4, window=3, stride=2, seed=1)
    seen = []
    for batch in loader.epoch(0):
        for i in range(len(batch)):
            movement, start = batch.movements[batch.sequence[i]], int(batch.start[i])
            assert torch.equal(batch.values[i], movement[start : start + 3])
            seen.append((float(movement[0, 0]), start))
    expected = [(100.0 * i, s) for i, n in enumerate((7, 5, 9)) for s in range(0, n - 2, 2)]
    assert sorted(seen) == expected
    assert loader.total == len(expected) and len(loader) == 3


def test_order_depends_on_seed_and_epoch_alone() -> None:
    loader, again = (Loader(ragged(), batch_size=4, window=2, seed=3) for _ in range(2))
    late = list(loader.epoch(5))[2:]
    resumed = list(again.epoch(5, first=2))
    assert all(torch.equal(a.values, b.values) for a, b in zip(late, resumed, strict=True))
    orders = [loader.order(e) for e in range(3)]
    assert not any(torch.equal(a, b) for a, b in pairwise(orders))


def test_masks_only_where_something_is_missing() -> None:
    complete = next(Loader(ragged(), batch_size=20, window=3).epoch(0))
    assert complete.mask is None and complete.movement_mask is not None
    holes = next(Loader(ragged(missing=True), batch_size=20, window=3).sweep())
    assert holes.mask is not None and int((~holes.mask).sum()) == 3
    assert bool((holes.values[~holes.mask] == 0).all())


def test_whole_movements_are_padded_and_masked() -> None:
    batch = whole(ragged())
    assert batch.mask is not None and batch.mask[:, :, 0].sum(1).tolist() == [7, 5, 9]
    assert batch.values is not batch.movements and torch.equal(batch.values, batch.movements)
    assert (batch.total, batch.total_sequences, batch.start.tolist()) == (3, 3, [0, 0, 0])
    assert whole(ragged()[1]).mask is None


def test_movement_too_short_is_named() -> None:
    with pytest.raises(ValueError, match=r"movement 1 .*trial 1.* has 5 frames; windows of 6"):
        Loader(ragged(), batch_size=2, window=6)


def test_pairs() -> None:
    x = np.arange(5.0)[:, None]
    loader = Loader(Pairs.from_arrays(x, 2 * x), batch_size=2, seed=0)
    batches = list(loader.epoch(0))
    assert [len(b) for b in batches] == [2, 2, 1] and all(b.total == 5 for b in batches)
    assert all(b.inputs is not None and torch.equal(2 * b.inputs, b.values) for b in batches)
    assert torch.equal(torch.cat([b.values for b in loader.sweep()])[:, 0], 2 * torch.arange(5.0))


def test_controls_ride_along() -> None:
    data = Sequences.from_arrays(
        [np.zeros((4, 1))] * 2, rate=1.0, controls=[np.arange(4.0)[:, None]] * 2
    )
    batch = next(Loader(data, batch_size=9, window=2).epoch(0))
    assert batch.inputs is not None
    assert torch.equal(batch.inputs[:, 0, 0], batch.start.double())
