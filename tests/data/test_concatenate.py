"""Records joined into one: rows and padding by hand, and every difference named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support import movements, pairs

import zoo
from zoo.datasets.records import Pairs, Sequences


def record(length: int, value: float, **changes: Any) -> Sequences:
    """Two movements of two channels and a control, each entry ``value``."""
    options: dict[str, Any] = {
        "rate": 60.0,
        "channels": ["hip", "knee"],
        "units": "rad",
        "groups": {"trial": [f"{value}-{i}" for i in range(2)], "subject": ["a", "a"]},
        "controls": [np.full((length, 1), -value)] * 2,
        "control_names": ["torque"],
        "control_units": "Nm",
        "name": f"record {value:g}",
    }
    return Sequences.from_arrays([np.full((length, 2), value)] * 2, **{**options, **changes})


def test_movements_of_unlike_length_are_padded_as_missing() -> None:
    whole = zoo.concatenate([record(5, 1.0), record(8, 2.0), record(3, 3.0)])
    assert whole.lengths.tolist() == [5, 5, 8, 8, 3, 3] and whole.values.shape == (6, 8, 2)
    assert whole.controls is not None and whole.controls.shape == (6, 8, 1)
    for i, (length, value) in enumerate(
        zip(whole.lengths.tolist(), [1, 1, 2, 2, 3, 3], strict=True)
    ):
        assert bool((whole.values[i, :length] == value).all())
        assert bool((whole.controls[i, :length] == -value).all())
        assert bool(whole.mask[i, :length].all()) and not bool(whole.mask[i, length:].any())
        assert not bool(whole.values[i, length:].any())
    assert whole.groups["trial"] == ("1.0-0", "1.0-1", "2.0-0", "2.0-1", "3.0-0", "3.0-1")
    assert whole.name == "record 1 + record 2 + record 3"


def test_parts_of_a_record_joined_are_the_record() -> None:
    data = movements(missing=True)
    again = zoo.concatenate([data[:3], data[3:5], data[5:]])
    for one, other in ((again.values, data.values), (again.mask, data.mask)):
        assert torch.equal(one, other)
    assert again.groups == data.groups and again.layout == data.layout and again.name == data.name
    assert torch.equal(zoo.concatenate([data]).values, data.values)
    whole = pairs(missing=True)
    joined = zoo.concatenate([whole[:20], whole[20:]])
    assert isinstance(joined, Pairs) and torch.equal(joined.inputs, whole.inputs)
    assert torch.equal(joined.targets, whole.targets) and torch.equal(joined.mask, whole.mask)
    assert joined.groups == whole.groups


def test_the_rate_of_time_normalised_movements_is_that_of_the_mean_duration() -> None:
    """As if they had been normalised together."""
    slow, fast = (
        Sequences.from_arrays([np.random.default_rng(n).normal(size=(n, 2))] * k, rate=60.0)
        for n, k in ((50, 1), (20, 3))
    )
    together = zoo.concatenate([slow, fast]).resampled(10)
    apart = zoo.concatenate([slow.resampled(10), fast.resampled(10)])
    assert apart.rate == pytest.approx(together.rate) and apart.layout.rate is None
    assert torch.equal(apart.values, together.values)


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (
            lambda: record(5, 2.0, channels=["hip", "ankle"]),
            "channels differ: number 1 is 'knee' in the first record, 'ankle' in record 1",
        ),
        (
            lambda: record(5, 2.0).select(["hip"]),
            "channels differ: 2 in the first record, 1 in record 1",
        ),
        (
            lambda: record(5, 2.0, units="deg"),
            "units differ: number 0 is 'rad' in the first record, 'deg' in record 1",
        ),
        (lambda: record(5, 2.0, rate=120.0), "rates differ: 60 Hz in the first record, 120 Hz"),
        (
            lambda: record(5, 2.0, control_names=["force"]),
            "control names differ: number 0 is 'torque' in the first record, 'force'",
        ),
        (
            lambda: record(5, 2.0, control_units="N"),
            "control units differ: number 0 is 'Nm' in the first record, 'N'",
        ),
        (
            lambda: record(5, 2.0, controls=None, control_names=None),
            "control names differ: 1 in the first record, 0 in record 1",
        ),
        (
            lambda: record(5, 2.0, groups={"trial": ["x", "y"]}),
            "group column 'subject' is missing in record 1",
        ),
        (
            lambda: record(5, 2.0, groups={"trial": "xy", "subject": "ab", "day": "12"}),
            "group column 'day' is missing in the first record",
        ),
        (lambda: record(5, 2.0).resampled(5), "time normalised differ: False in the first"),
        (
            lambda: record(5, 2.0).to(dtype=torch.float32),
            "number types of values differ: torch.float64 .* torch.float32 in record 1",
        ),
        (
            lambda: replace(record(5, 2.0), controls=torch.zeros(2, 7, 1).double()),
            "controls go on for 0 frames after .* for 2 in record 1",
        ),
    ],
)
def test_records_that_differ_are_refused_by_what_differs(other: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        zoo.concatenate([record(5, 1.0), other()])


def test_unlike_kinds_and_nothing_are_refused() -> None:
    with pytest.raises(TypeError, match="the first is Sequences, record 1 is Pairs"):
        zoo.concatenate([record(5, 1.0), pairs()])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="at least one record"):
        zoo.concatenate([])
    with pytest.raises(ValueError, match="takes a list"):
        zoo.concatenate(record(5, 1.0))  # type: ignore[arg-type]
    unlike = [record(5, 1.0).resampled(4), record(5, 2.0).resampled(6)]
    with pytest.raises(ValueError, match="one number of frames; got 4 to 6"):
        zoo.concatenate(unlike)
    other = replace(pairs(), features=("a", "b", "c"))
    with pytest.raises(ValueError, match="features differ: number 0"):
        zoo.concatenate([pairs(), other])
