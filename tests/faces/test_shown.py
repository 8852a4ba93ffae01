"""What objects show of themselves: pictures, frames, data sets, and HTML in a notebook."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from support import movements, pairs, run_of

import zoo
from zoo.catalogue import CATALOGUE


def answer() -> zoo.Prediction:
    return run_of("promp").forecast(movements().first(20), horizon=3)


def panel() -> Axes:
    return Figure().subplots()


def test_xarray_has_names_units_and_seconds() -> None:
    found, p = answer().to_xarray(0.8), answer()
    np.testing.assert_array_equal(found["mean"], p.mean.double())
    np.testing.assert_array_equal(found["high"], p.interval(0.8)[1].double())
    assert found["time"].values.tolist() == pytest.approx([20 / 30, 21 / 30, 22 / 30])
    assert found["channel"].values.tolist() == list(p.names)
    assert set(found["unit"].values.tolist()) == {"rad"} and found.attrs["level"] == 0.8


def test_frames_after_a_movement_s_end_are_missing_or_left_out() -> None:
    data = zoo.Sequences.from_arrays([np.ones((9, 2)), np.ones((6, 2))], rate=10.0)
    found = zoo.fit(zoo.create("mean", data), data).reconstruct(data)
    assert int(found.to_xarray()["mean"].isnull().sum()) == 3 * 2
    pandas = pytest.importorskip("pandas")
    frame = found.to_pandas()
    assert isinstance(frame, pandas.DataFrame) and len(frame) == 15 * 2
    assert frame["time"].max() == pytest.approx(0.8)


def test_a_frame_has_a_row_a_target() -> None:
    pytest.importorskip("pandas")
    found = run_of("gp").regress(pairs())
    frame = found.to_pandas()
    assert list(frame.columns[:3]) == ["item", "target", "unit"] and len(frame) == 120
    assert frame["mean"].tolist() == found.mean.double().flatten().tolist()


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"to_pandas needs pandas.*pip install pandas"):
        answer().to_pandas()


def test_a_picture_draws_on_the_axes_given() -> None:
    ax = panel()
    assert answer().plot(ax, channels="joint_2") is ax.figure
    (mean,) = (line for line in ax.lines if line.get_label() == "mean")
    assert list(mean.get_ydata()) == answer().mean[0, :, 2].tolist()
    assert ax.get_ylabel() == "rad" and ax.get_xlabel() == "time (s)"
    assert [len(answer().plot(channels=["joint_1", "joint_3"]).axes)] == [2]


def test_movements_are_drawn_with_their_gaps() -> None:
    ax = panel()
    movements(missing=True).plot(ax, channels="joint_1")
    assert len(ax.lines) == 8
    assert [math.isnan(v) for v in ax.lines[0].get_ydata()[2:7]] == [False, True, True, True, False]
    assert len(movements().plot().axes) == 4


def test_a_training_is_drawn_and_a_closed_form_has_none() -> None:
    ax = panel()
    run = run_of("vae")
    run.plot_history(ax)
    row = run.history[-1]
    assert ax.lines[0].get_ydata()[-1] == row["reconstruction"] - row["kl"]
    rising = run_of("gp").plot_history().axes[0].lines[0].get_ydata()
    assert rising[-1] > rising[0] and np.isfinite(rising).all()
    with pytest.raises(ValueError, match="promp was trained in closed form"):
        run_of("promp").plot_history()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"ax": 3}, "ax must be matplotlib axes; got int"),
        ({"channels": []}, "must name at least one of"),
        ({"channels": "toe"}, "no channel 'toe'"),
        ({"sequence": 9}, "sequence must be below 8"),
        ({"sequence": -1}, "sequence must be at least 0"),
        ({"sequence": 0.5}, "sequence must be a whole number"),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_name(wrong: dict[str, object], said: str) -> None:
    with pytest.raises((TypeError, ValueError), match=said):
        answer().plot(**wrong)


def test_one_axes_shows_one_channel() -> None:
    with pytest.raises(ValueError, match="one ax shows one channel; got 2"):
        answer().plot(panel(), channels=["joint_0", "joint_1"])


def test_every_public_object_has_a_display() -> None:
    run = run_of("promp")
    shown = {
        "8": movements(),
        "60": pairs(),
        "promp": run,
        "forecast": answer(),
        "not trained yet": zoo.create("pca", movements()),
        "Ensemble of promp": zoo.Ensemble(members=(run, run)),
        "error": zoo.evaluate(run, movements().resampled(20), tasks=["reconstruct"]),
        "exact posterior": CATALOGUE["promp"],
        "vae-dmp": CATALOGUE,
    }
    for word, thing in shown.items():
        assert word in thing._repr_html_() and "<table>" in thing._repr_html_()


def test_a_display_escapes_what_a_user_wrote() -> None:
    data = zoo.Sequences.from_arrays(torch.zeros(1, 4, 1), rate=1.0, channels=["<b>"], name="<i>")
    assert "<b>" not in data._repr_html_() and "<i>" not in data._repr_html_()
