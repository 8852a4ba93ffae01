"""Records: splits by group, windows, resampling, selection, and what they refuse."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from zoo.datasets.records import Pairs, Sequences
from zoo.errors import UnknownNameError

quick = settings(max_examples=40, deadline=None)


@st.composite
def records(draw: st.DrawFn, shortest: int = 2) -> Sequences:
    """Ragged movements of two channels with holes; the first entry of each is there."""
    lengths = draw(st.lists(st.integers(shortest, 14), min_size=1, max_size=6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    arrays = [rng.normal(size=(n, 2)) for n in lengths]
    for array in arrays:
        array[rng.random(array.shape) < draw(st.sampled_from([0.0, 0.3]))] = np.nan
        array[0] = 1.0
    groups = {"trial": range(len(lengths)), "subject": [i // 2 for i in range(len(lengths))]}
    return Sequences.from_arrays(arrays, rate=30.0, groups=groups)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=True)


@quick
@given(records())
def test_arrays_come_back_as_they_went_in(data: Sequences) -> None:
    again = Sequences.from_arrays(data.arrays, rate=data.rate, groups=data.groups)
    assert torch.equal(again.values, data.values) and torch.equal(again.mask, data.mask)
    assert again.lengths.tolist() == data.lengths.tolist()


@quick
@given(
    st.lists(st.integers(0, 9), min_size=1, max_size=60),
    st.lists(st.floats(0.05, 1), min_size=1, max_size=4),
    st.integers(0, 99),
)
def test_split_is_a_partition_that_no_group_straddles(
    members: list[int], parts: list[float], seed: int
) -> None:
    data = Pairs.from_arrays(
        np.arange(len(members))[:, None], np.zeros(len(members)), groups={"g": members}
    )
    if len(set(members)) < len(parts):
        with pytest.raises(ValueError, match=r"distinct values of 'g'"):
            data.split(by="g", parts=parts, seed=seed)
        return
    found = data.split(by="g", parts=parts, seed=seed)
    assert len(found) == len(parts) and all(len(part) for part in found)
    rows = [int(x) for part in found for x in part.inputs[:, 0]]
    assert sorted(rows) == list(range(len(members)))
    owners = [set(part.groups["g"]) for part in found]
    assert sum(map(len, owners)) == len(set().union(*owners))
    again = data.split(by="g", parts=parts, seed=seed)
    assert all(torch.equal(a.inputs, b.inputs) for a, b in zip(found, again, strict=True))


@quick
@given(st.integers(8, 200), st.integers(0, 99))
def test_shares_of_single_rows_are_met_to_one(count: int, seed: int) -> None:
    data = Pairs.from_arrays(np.zeros((count, 1)), np.zeros(count))
    parts = data.split(by="frame", parts=(0.6, 0.1, 0.1, 0.2), seed=seed)
    for part, share in zip(parts, (0.6, 0.1, 0.1, 0.2), strict=True):
        assert abs(len(part) - share * count) <= 1


def test_other_seeds_give_other_splits() -> None:
    data = Pairs.from_arrays(np.arange(50.0)[:, None], np.zeros(50))
    one, other = (data.split(by="item", parts=(1, 1), seed=s)[0].inputs for s in (0, 1))
    assert not torch.equal(one, other)


def test_split_refuses_what_it_cannot_do() -> None:
    data = Sequences.from_arrays(np.zeros((3, 4, 1)), rate=1.0, groups={"subject": "abc"})
    with pytest.raises(UnknownNameError, match="no group column 'subjects'; did you mean subject"):
        data.split(by="subjects", parts=(1, 1))
    with pytest.raises(ValueError, match="4 parts need at least 4 distinct values of 'subject'"):
        data.split(by="subject", parts=(0.6, 0.1, 0.1, 0.2))
    for parts in ((), (1, 0), (1, -1), (1, math.nan)):
        with pytest.raises(ValueError, match="parts must be positive shares"):
            data.split(by="subject", parts=parts)


def test_shares_of_a_split_are_of_the_rows() -> None:
    """One group of twelve rows and many of one: both halves have the rows, not the groups."""
    members = [*["large"] * 12, *map(str, range(48))]
    data = Pairs.from_arrays(np.zeros((60, 1)), np.zeros(60), groups={"g": members})
    sizes = [len(data.split(by="g", parts=(1, 1), seed=seed)[0]) for seed in range(20)]
    assert all(abs(size - 30) <= 6 for size in sizes)
    assert np.median(sizes) == 30


def test_split_by_frame_takes_movements_apart() -> None:
    data = Sequences.from_arrays([np.ones((6, 1)), np.ones((4, 1))], rate=1.0)
    train, test = data.split(by="frame", parts=(0.5, 0.5))
    assert train.lengths.tolist() == [1] * 5
    rows = [*zip(train.groups["trial"], train.groups["start"], strict=True)]
    rows += zip(test.groups["trial"], test.groups["start"], strict=True)
    assert sorted(rows) == sorted(
        [("0", str(i)) for i in range(6)] + [("1", str(i)) for i in range(4)]
    )


@quick
@given(records(shortest=4), st.integers(1, 4), st.integers(1, 5))
def test_windows_are_the_frames_they_say(data: Sequences, length: int, stride: int) -> None:
    cut = data.windows(length, stride)
    assert len(cut) == sum((n - length) // stride + 1 for n in data.lengths.tolist())
    whole = dict(zip(data.groups["trial"], data.arrays, strict=True))
    for array, trial, start in zip(
        cut.arrays, cut.groups["trial"], cut.groups["start"], strict=True
    ):
        assert same(array, whole[trial][int(start) : int(start) + length])


def test_windows_of_windows_count_from_the_movement() -> None:
    data = Sequences.from_arrays([np.arange(10.0)[:, None]], rate=1.0)
    twice = data.windows(6, 2).windows(2, 4)
    assert twice.values[:, 0, 0].tolist() == [float(s) for s in twice.groups["start"]]


def test_windows_longer_than_a_movement_are_refused() -> None:
    data = Sequences.from_arrays([np.zeros((9, 1)), np.zeros((5, 1))], rate=1.0)
    with pytest.raises(ValueError, match="windows of 7 frames were asked for; sequence 1 has 5"):
        data.windows(7)
    with pytest.raises(ValueError, match="at least 1"):
        data.windows(3, stride=0)


@quick
@given(records())
def test_resampling_to_the_own_rate_is_the_identity(data: Sequences) -> None:
    again = data.resampled(rate=30.0)
    assert torch.equal(again.mask, data.mask)
    torch.testing.assert_close(again.values, data.values, rtol=0, atol=1e-12)


@quick
@given(records(shortest=3), st.integers(2, 30))
def test_what_is_linear_in_time_stays_linear_beside_holes_too(data: Sequences, frames: int) -> None:
    arrays = [
        np.where(np.isnan(a), np.nan, 2.0 - 0.5 * np.linspace(0, 1, len(a))[:, None])
        for a in data.arrays
    ]
    line = Sequences.from_arrays(arrays, rate=30.0).resampled(frames)
    expected = (2.0 - 0.5 * torch.linspace(0, 1, frames, dtype=torch.float64))[None, :, None]
    error = torch.where(line.mask, line.values - expected, 0.0).abs()
    complete = torch.tensor([not np.isnan(a).any() for a in data.arrays])
    assert float(error[complete].max() if complete.any() else 0) < 1e-9
    # Beside a hole a single frame may be all there is: then it is off by its distance in time.
    assert float(error.max()) <= 0.5 / (int(data.lengths.min()) - 1) + 0.5 / (frames - 1)


def test_finer_grids_interpolate_linearly() -> None:
    rng = np.random.default_rng(0)
    array = rng.normal(size=(8, 3))
    fine = Sequences.from_arrays([array], rate=10.0).resampled(rate=35.0)
    time, new = np.arange(8) / 10, np.arange(fine.values.shape[1]) / 35
    expected = np.stack([np.interp(new, time, column) for column in array.T], 1)
    np.testing.assert_allclose(fine.values[0], expected, atol=1e-12)


def test_coarser_grids_keep_slow_waves_and_damp_what_would_alias() -> None:
    time = np.arange(600) / 120
    slow, fast = np.sin(2 * np.pi * time), np.sin(2 * np.pi * 29 * time)
    coarse = Sequences.from_arrays([np.stack([slow, fast], 1)], rate=120.0).resampled(rate=30.0)
    new = np.arange(coarse.values.shape[1]) / 30
    inside = slice(2, -2)
    found = coarse.values[0].numpy()[inside]
    assert np.abs(found[:, 0] - np.sin(2 * np.pi * new)[inside]).max() < 0.01
    assert np.abs(found[:, 1]).max() < 0.05


def test_missing_entries_stay_missing() -> None:
    array = np.ones((40, 1))
    array[12:28] = np.nan
    data = Sequences.from_arrays([array], rate=40.0)
    for new in (data.resampled(rate=10.0), data.resampled(rate=100.0), data.resampled(20)):
        seconds = np.linspace(0, 39 / 40, new.values.shape[1])
        hole = (seconds > 13 / 40) & (seconds < 26 / 40)
        assert not new.mask[0, hole].any() and not new.values[0, hole].any()
        assert new.mask[0, seconds < 11 / 40].all() and (new.values[new.mask] == 1).all()


def test_normalised_time_has_a_mean_rate_and_no_rate_in_its_layout() -> None:
    data = Sequences.from_arrays([np.zeros((11, 1)), np.zeros((31, 1))], rate=10.0)
    equal = data.resampled(21)
    assert equal.lengths.tolist() == [21, 21]
    assert equal.rate == pytest.approx(20 / 2.0)
    assert equal.layout.rate is None and equal.layout.frames == 21
    equal.layout.check(data[:1].resampled(21).layout)


def test_controls_are_resampled_and_cut_along() -> None:
    arrays = [np.arange(9.0)[:, None], np.arange(5.0)[:, None]]
    data = Sequences.from_arrays(arrays, rate=4.0, controls=arrays)
    for changed in (data.resampled(rate=2.0), data.resampled(7), data.windows(3, 2)):
        assert changed.controls is not None
        torch.testing.assert_close(changed.controls, changed.values)


def test_resampling_refuses_what_it_cannot_do() -> None:
    data = Sequences.from_arrays([np.zeros((3, 1)), np.zeros((1, 1))], rate=1.0)
    for wrong in ({}, {"frames": 5, "rate": 2.0}):
        with pytest.raises(ValueError, match="either frames or rate"):
            data.resampled(**wrong)
    with pytest.raises(ValueError, match="sequence 1 has 1 frame"):
        data.resampled(5)
    with pytest.raises(ValueError, match=r"rate must be a positive number, in Hz; got -1\.0"):
        data[:1].resampled(rate=-1.0)
    with pytest.raises(ValueError, match="at least 2"):
        data[:1].resampled(1)


def test_select_and_where() -> None:
    data = Sequences.from_arrays(
        [np.tile([1.0, 2.0, 3.0], (4, 1))] * 3,
        rate=1.0,
        channels=["hip", "knee", "foot"],
        units=["rad", "rad", "m"],
        groups={"subject": [35, 35, 49], "trial": [1, 2, 1]},
    )
    some = data.select(channels=["foot", "hip"])
    assert some.values[0, 0].tolist() == [3.0, 1.0] and some.units == ("m", "rad")
    assert data.where(subject="35", trial=[1, 3]).groups["subject"] == ("35",)
    with pytest.raises(UnknownNameError, match="no channel 'hipp'; did you mean hip"):
        data.select(channels=["hipp"])
    with pytest.raises(TypeError, match="must come as a list"):
        data.select(channels="hip")
    with pytest.raises(
        ValueError, match="nothing matches subject=7; the data have subject: 35, 49"
    ):
        data.where(subject=7)


@pytest.mark.parametrize("rate", [0, -1.0, float("nan"), float("inf"), "fast"])
def test_a_rate_that_is_none_is_refused(rate: object) -> None:
    with pytest.raises(ValueError, match="rate must be a positive number, in Hz; got"):
        Sequences.from_arrays([np.zeros((5, 2))], rate=rate)  # type: ignore[arg-type]


def test_a_group_column_is_a_list() -> None:
    with pytest.raises(TypeError, match="group column 'subject' needs 2 rows, in a list; got 3"):
        Sequences.from_arrays(np.zeros((2, 5, 2)), rate=1.0, groups={"subject": 3})  # type: ignore[dict-item]
