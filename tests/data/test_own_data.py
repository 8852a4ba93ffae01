"""One's own data: arrays, frames and labelled arrays are read as they are, or refused by name."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr

from zoo.datasets.records import Pairs, Sequences

VALUES = np.random.default_rng(0).normal(size=(3, 12, 2)).cumsum(1)
SECONDS = np.arange(12) / 30
NAMES = ["hip", "knee"]


def record(**other: Any) -> Sequences:
    return Sequences.from_arrays(VALUES, rate=30.0, channels=NAMES, units="rad", **other)


def frame(i: int, **columns: Any) -> pd.DataFrame:
    return pd.DataFrame({**columns, "hip": VALUES[i, :, 0], "knee": VALUES[i, :, 1]})


def table() -> pd.DataFrame:
    """Three movements in one frame, as a laboratory's program writes them."""
    parts = [frame(i, trial=i, subject="ab"[i // 2], time=SECONDS + i) for i in range(3)]
    return pd.concat([p.rename(columns={"knee": "knee [rad]"}) for p in parts])


def labelled(**attrs: str) -> xr.DataArray:
    coords = {"channel": NAMES, "time": SECONDS, "subject": ("trial", ["a", "a", "b"])}
    return xr.DataArray(VALUES, dims=("trial", "time", "channel"), coords=coords, attrs=attrs)


MASKS = {
    "tensor": torch.tensor([True, False, True]),
    "array": np.array([True, False, True]),
    "list": [True, False, True],
}


@pytest.mark.parametrize("kind", MASKS)
def test_truth_values_choose_rows(kind: str) -> None:
    pairs = Pairs.from_arrays(VALUES[:, 0], VALUES[:, 1, 0])
    for data in (record(), pairs):
        assert next(iter(data[MASKS[kind]].groups.values())) == ("0", "2")
        with pytest.raises(ValueError, match=r"3 rows need 3 truth values; got shape \(2,\)"):
            data[MASKS[kind][:2]]


@pytest.mark.parametrize("index", [np.int64(2), torch.tensor(2), -1, [2], slice(2, 3)])
def test_numbers_choose_rows(index: Any) -> None:
    assert record()[index].groups == {"trial": ("2",)}


@pytest.mark.parametrize("index", [1.0, [1.5], "0", True, None, np.zeros((2, 2), int)])
def test_what_chooses_no_rows_is_refused(index: Any) -> None:
    with pytest.raises(TypeError, match="rows are chosen by"):
        record()[index]


READ: dict[str, Any] = {
    "array": (VALUES, {"rate": 30.0, "channels": NAMES}),
    "generator": ((v for v in VALUES), {"rate": 30.0, "channels": NAMES}),
    "tensors": (
        [torch.tensor(v).requires_grad_() for v in VALUES],
        {"rate": 30, "channels": NAMES},
    ),
    "frames": ([frame(i) for i in range(3)], {"rate": 30.0}),
    "frames with times": ([frame(i, t=SECONDS) for i in range(3)], {}),
    "frames in ms": ([frame(i, **{"time [ms]": 1e3 * SECONDS}) for i in range(3)], {}),
    "frames of dates": (
        [frame(i).set_index(pd.to_datetime(SECONDS, unit="s")) for i in range(3)],
        {},
    ),
    "frames in another order": ([frame(0), frame(1)[["knee", "hip"]], frame(2)], {"rate": 30.0}),
    "frames in the order asked for": (
        [frame(i)[["knee", "hip"]] for i in range(3)],
        {"rate": 30.0, "channels": NAMES},
    ),
    "one frame": (table(), {}),
    "array of records": (table().drop(columns="subject").to_records(index=False), {}),
    "labelled": (labelled(units="rad"), {}),
    "labelled, other order": (labelled().transpose("channel", "trial", "time"), {}),
    "list of labelled": ([x.transpose("channel", "time") for x in labelled()], {}),
    "variables": (labelled().to_dataset("channel"), {}),
}


@pytest.mark.parametrize("kind", READ)
def test_movements_are_read_as_they_are(kind: str) -> None:
    given, keywords = READ[kind]
    data = Sequences.from_arrays(given, **keywords)
    np.testing.assert_array_equal(data.values, VALUES)
    assert data.channels == ("hip", "knee") and data.rate == 30.0 and data.provenance == "own"
    assert bool(data.mask.all())


def test_labels_ride_along() -> None:
    one, two = Sequences.from_arrays(table()), Sequences.from_arrays(labelled(units="rad"))
    assert one.units == ("", "rad") and two.units == ("rad", "rad")
    assert one.groups == {"trial": ("0", "1", "2"), "subject": ("a", "a", "b")}
    assert two.groups == {"subject": ("a", "a", "b")}
    assert Sequences.from_arrays(frame(0), rate=1.0, units="deg").units == ("deg", "deg")


def test_units_follow_their_channels() -> None:
    """To the order asked for, and out of a Dataset whose variables have units of their own."""
    mixed = pd.DataFrame(VALUES[0], columns=["hip [deg]", "knee [N]"])
    turned = Sequences.from_arrays(mixed, rate=1.0, channels=["knee", "hip"])
    assert turned.units == ("N", "deg")
    np.testing.assert_array_equal(turned.values[0], VALUES[0, :, ::-1])
    several = [mixed, mixed[["knee [N]", "hip [deg]"]]]
    assert Sequences.from_arrays(several, rate=1.0).units == ("deg", "N")
    dataset = xr.Dataset(
        {"hip": ("time", VALUES[0, :, 0]), "knee": ("time", VALUES[0, :, 1])},
        coords={"time": np.arange(VALUES.shape[1]) / 10},
    )
    dataset["hip"].attrs["units"], dataset["knee"].attrs["units"] = "deg", "N"
    assert Sequences.from_arrays(dataset).units == ("deg", "N")


def test_one_matrix_is_one_movement_and_a_named_column_is_one_channel() -> None:
    assert record().values[:1].equal(Sequences.from_arrays(VALUES[0], rate=30.0).values)
    column = VALUES[0, :, 0]
    series = pd.Series(column, name="hip [rad]")
    for data in (
        Sequences.from_arrays(column, rate=30.0, channels=["hip"]),
        Sequences.from_arrays([column], rate=30.0, channels=["hip"]),
        Sequences.from_arrays([series], rate=30.0),
        Sequences.from_arrays(xr.DataArray(column, dims="time", name="hip"), rate=30.0),
    ):
        assert data.channels == ("hip",) and data.values[0, :, 0].tolist() == column.tolist()


def test_masked_entries_are_missing() -> None:
    hidden = VALUES > 1
    masked = np.ma.masked_array(np.where(hidden, np.inf, VALUES), mask=hidden)
    for given in (masked, list(masked), [list(m) for m in masked]):
        data = Sequences.from_arrays(given, rate=30.0)
        np.testing.assert_array_equal(data.mask, ~hidden)
    pairs = Pairs.from_arrays(VALUES[:, 0], masked[:, -1])
    np.testing.assert_array_equal(pairs.mask, ~hidden[:, -1])
    with pytest.raises(ValueError, match="inputs must be complete; item"):
        Pairs.from_arrays(masked[:, -1], VALUES[:, 0])
    gaps = frame(0).astype("Float64").where(~hidden[0])
    np.testing.assert_array_equal(Sequences.from_arrays(gaps, rate=1.0).mask[0], ~hidden[0])


def test_integers_and_truth_values_are_numbers() -> None:
    steps = np.array([[0, 2**53], [1, -(2**53)]])
    assert Sequences.from_arrays(steps, rate=1.0).values[0].tolist() == steps.tolist()
    assert Sequences.from_arrays(steps > 0, rate=1.0).values.sum() == 2


REFUSED: dict[str, Any] = {
    "complex": (VALUES + 1j, TypeError, "complex numbers: take real and imaginary part"),
    "objects": (np.array([[1, None]], dtype=object), TypeError, "holds None; numbers are needed"),
    "nested lists": ([[[1.0, None]]], TypeError, "sequence 0 holds None; numbers are needed"),
    "text": (np.array([["1", "2"]]), TypeError, "holds text; real numbers are needed"),
    "dates": (VALUES.astype("datetime64[s]"), TypeError, "holds dates"),
    "large integers": (np.array([[2**53 + 1]]), ValueError, "integers beyond 2**53"),
    "infinite": (np.full((2, 2), np.inf), ValueError, "infinite at row 0, column 0"),
    "ragged": ([[[1.0, 2.0], [3.0]]], ValueError, "sequence 0 is no array of numbers: rows of"),
    "one dimension": (VALUES[0, :, 0], ValueError, "channels=['knee'], makes it a movement"),
    "vectors": ([VALUES[0, :, 0]], ValueError, "must be (time, channel); got shape (12,)"),
    "four dimensions": (VALUES[None], ValueError, "must be (time, channel); got shape (1, 3"),
    "number": (5.0, ValueError, "must be (time, channel); got shape ()"),
    "nothing": (None, TypeError, "must be an array of numbers; got None"),
    "empty": ([], ValueError, "no sequence is given; at least one is needed"),
    "dict": ({"a": VALUES[0]}, TypeError, "a list of arrays is needed"),
    "path": ("walk.csv", TypeError, "zoo.load_data('walk.csv') reads a file"),
    "other columns": (
        [frame(0), frame(1).rename(columns={"hip": "hop"})],
        ValueError,
        "sequence 1 lacks hip and has hop besides, where sequence 0 has hip, knee",
    ),
    "named and not": ([frame(0), VALUES[1]], ValueError, "all movements or none must have names"),
    "rows dropped": (frame(0).drop(index=5), ValueError, "goes from 4 to 6 after row 4"),
    "rows shuffled": (frame(0).sample(frac=1, random_state=0), ValueError, "must follow one"),
    "irregular times": (
        frame(0, time=SECONDS).drop(index=5),
        ValueError,
        "is irregular: frames are 0.03333 s apart, but 0.06667 s after row 4",
    ),
    "falling times": (frame(0, time=SECONDS[::-1]), ValueError, "must rise from frame to frame"),
    "other rate": (frame(0, time=2 * SECONDS), ValueError, "run at 15 Hz; the rate given is 30"),
    "time in hours": (frame(0, **{"time [h]": SECONDS}), ValueError, "is in 'h'; times are read"),
    "column of text": (frame(0, who="a"), TypeError, "column 'who' of the data holds 'a'"),
    "one name twice": (frame(0, **{"hip [rad]": 1.0}), ValueError, "several columns named hip"),
    "several levels": (
        pd.concat({"left": frame(0)}, axis=1),
        ValueError,
        "('left', 'hip') has several levels",
    ),
    "torn movement": (
        pd.concat([table(), table()[:3]]),
        ValueError,
        "rows of trial 0, subject a begin again at row 36",
    ),
    "unknown dimensions": (labelled().rename(time="x"), ValueError, "must be named time or frame"),
    "unlike variables": (
        xr.Dataset({"a": ("time", SECONDS), "b": (("trial", "time"), VALUES[..., 0])}),
        ValueError,
        "variables of the data must have the same dimensions",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_read_is_refused_by_name(kind: str) -> None:
    given, error, message = REFUSED[kind]
    with pytest.raises(error, match=re.escape(message)):
        Sequences.from_arrays(given, rate=30.0)


def test_keywords_and_labels_must_agree() -> None:
    with pytest.raises(ValueError, match="rate is needed, in Hz"):
        Sequences.from_arrays(VALUES)
    with pytest.raises(ValueError, match=r"unit of hip is 'deg'; .* has 'rad'"):
        Sequences.from_arrays(labelled(units="rad"), units="deg")
    with pytest.raises(ValueError, match="channels name ankle, knee; choose columns by"):
        Sequences.from_arrays(frame(0), rate=1.0, channels=["ankle", "knee"])
    with pytest.raises(ValueError, match="'trial' is given and in the data, with other values"):
        Sequences.from_arrays(table(), groups={"trial": "xyz"})
    for names in ("ab", [1, 2]):
        with pytest.raises(TypeError, match="channel names must"):
            Sequences.from_arrays(VALUES, rate=1.0, channels=names)  # type: ignore[arg-type]


@pytest.mark.parametrize(("rate", "decimals"), [(120, 3), (29.97, 4), (23.976, 9), (2.5, 1)])
def test_rates_are_told_by_times_of_few_decimals(rate: float, decimals: int) -> None:
    times = np.round(np.arange(400) / rate, decimals)
    values = pd.DataFrame({"time": times, "hip": times})
    assert Sequences.from_arrays(values).rate == rate


def test_controls_bring_their_names() -> None:
    data = record(controls=[frame(i) for i in range(3)])
    assert data.control_names == ("hip", "knee") and data.controls.equal(data.values)  # type: ignore[union-attr]


def test_frames_of_items_tell_features_and_targets() -> None:
    both = frame(0).rename(columns={"knee": "f_z [N]"})
    pairs = Pairs.from_arrays(both[["hip"]], both["f_z [N]"])
    assert (pairs.features, pairs.channels, pairs.units) == (("hip",), ("f_z",), ("N",))
    items = xr.DataArray(VALUES[0], dims=("item", "channel"), coords={"channel": NAMES})
    again = Pairs.from_arrays(items, items[:, 0].rename("load"))
    assert (again.features, again.channels) == (("hip", "knee"), ("load",))
    with pytest.raises(ValueError, match="unlike order: at row 0 their index is 0 and 11"):
        Pairs.from_arrays(both[["hip"]], both["f_z [N]"][::-1])
    with pytest.raises(ValueError, match="items along 'item', targets along 'other'"):
        Pairs.from_arrays(items, items[:, 0].rename(item="other"))
    with pytest.raises(ValueError, match=r"x\[:, None\] makes it items of one feature"):
        Pairs.from_arrays(VALUES[0, :, 0], VALUES[0, :, 1])
    with pytest.raises(TypeError, match="targets holds complex numbers"):
        Pairs.from_arrays(VALUES[0], VALUES[0, :, 1] + 1j)
