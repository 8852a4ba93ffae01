"""Scaling: moments of the observed entries, the way back, and what does not vary."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.scaling import Kind, Scaler, suited
from zoo.errors import UnlikeUnitsWarning

KINDS: tuple[Kind, ...] = ("standard", "center", "range", "none")


def ragged(seed: int = 0, holes: float = 0.2) -> Sequences:
    """Three movements of unequal length with missing entries, a constant channel and a control."""
    rng = np.random.default_rng(seed)
    arrays = [rng.normal(3, [1.0, 5.0, 0.0], size=(n, 3)) for n in (9, 5, 12)]
    for array in arrays:
        array[1:][rng.random((len(array) - 1, 3)) < holes] = np.nan
    controls = [rng.normal(size=(len(a), 1)) for a in arrays]
    return Sequences.from_arrays(arrays, rate=10.0, controls=controls, channels=["a", "b", "flat"])


@pytest.mark.parametrize("kind", KINDS)
def test_the_way_back_gives_the_data(kind: Kind) -> None:
    data = ragged()
    scaler = Scaler.fit(data, kind)
    scaled = scaler.apply(data)
    back = scaled.values * scaler.channel_scale + scaler.channel_shift
    torch.testing.assert_close(back[data.mask], data.values[data.mask], rtol=0, atol=1e-12)
    assert not scaled.values[~data.mask].any()


def test_moments_are_those_of_the_observed_entries() -> None:
    data = ragged()
    entries = np.concatenate(data.arrays)
    std = np.nanstd(entries, 0)
    pooled = np.full(3, np.sqrt((std**2).mean()) / 0.2)
    for kind, expected in (("standard", std), ("center", pooled)):
        scaler = Scaler.fit(data, kind)  # type: ignore[arg-type]
        np.testing.assert_allclose(scaler.channel_shift, np.nanmean(entries, 0), rtol=1e-12)
        np.testing.assert_allclose(scaler.channel_scale[:2], expected[:2], rtol=1e-12)


def test_range_has_mean_zero_and_touches_one() -> None:
    data = ragged()
    scaled = Scaler.fit(data, "range").apply(data)
    for channel in range(2):
        entries = scaled.values[..., channel][scaled.mask[..., channel]]
        assert abs(float(entries.mean())) < 1e-12
        assert float(entries.abs().max()) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("kind", ["standard", "range"])
def test_a_channel_that_does_not_vary_is_named_and_keeps_its_unit(kind: Kind) -> None:
    scaler = Scaler.fit(ragged(), kind)
    assert scaler.constant == ("flat",)
    assert scaler.channel_scale[2] == 1


@pytest.mark.parametrize("kind", ["standard", "center", "range"])
@pytest.mark.parametrize("factor", [2.0**-40, 2.0**6, 2.0**40])
def test_scaled_numbers_do_not_depend_on_the_unit(kind: Kind, factor: float) -> None:
    """A power of two changes no digit, so that the scaled data must keep their bits."""
    data = ragged()
    other = replace(data, values=data.values * factor, units=("mrad",) * 3)
    one, two = Scaler.fit(data, kind), Scaler.fit(other, kind)
    assert torch.equal(one.apply(data).values, two.apply(other).values)
    assert one.constant == two.constant == ("flat",)


def test_one_scale_for_channels_of_several_units_is_warned_of() -> None:
    mixed = replace(ragged(), units=("m", "rad", "rad"))
    with pytest.warns(UnlikeUnitsWarning, match="channels in m, rad by one number"):
        Scaler.fit(mixed, "center")
    Scaler.fit(mixed, "standard")


@pytest.mark.parametrize(
    ("units", "factor", "kind"),
    [
        ("", 1e3, "standard"),
        ("", 2.0, "center"),
        ("rad", 1e3, "center"),
        ("rad m", 1.0, "standard"),
    ],
)
def test_one_scale_is_left_for_channels_that_have_none(
    units: str, factor: float, kind: Kind
) -> None:
    values = np.random.default_rng(0).normal(size=(3, 40, 2)) * [1.0, factor]
    labels = units.split() if " " in units else units
    data = Sequences.from_arrays(values, rate=10.0, units=labels)
    assert suited(data, "standard") == "standard"
    if kind == "center":
        assert suited(data, "center") == "center"
        return
    with pytest.warns(UnlikeUnitsWarning, match="scaling='standard' is used"):
        assert suited(data, "center") == "standard"


def test_padding_and_missing_entries_have_no_say() -> None:
    data = ragged()
    shorter = Sequences.from_arrays(data.arrays[:2], rate=10.0)
    one = Scaler.fit(shorter)
    other = Scaler.fit(Sequences.from_arrays([np.concatenate(data.arrays[:2])], rate=10.0))
    torch.testing.assert_close(one.channel_scale, other.channel_scale, rtol=1e-12, atol=0)


def test_inputs_of_pairs_are_scaled_by_their_own_moments() -> None:
    rng = np.random.default_rng(0)
    pairs = Pairs.from_arrays(rng.normal(5, 2, (40, 2)), rng.normal(-1, 3, 40))
    scaled = Scaler.fit(pairs).apply(pairs)
    np.testing.assert_allclose(scaled.inputs.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(scaled.inputs.std(0, unbiased=False), 1, rtol=1e-12)
    np.testing.assert_allclose(scaled.targets.std(0, unbiased=False), 1, rtol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(KINDS))
def test_json_round_trip_is_exact(seed: int, kind: Kind) -> None:
    import json

    scaler = Scaler.fit(ragged(seed), kind)
    back = Scaler.from_json(json.loads(json.dumps(scaler.to_json())))
    for name in ("channel_scale", "channel_shift", "input_scale", "input_shift"):
        assert torch.equal(getattr(back, name), getattr(scaler, name))
    assert (back.kind, back.constant) == (scaler.kind, scaler.constant)
