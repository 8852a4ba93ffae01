"""New movements from demonstrations: what every entry that generates must keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support import CHANNELS, FRAMES, movements, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.strategies import Exact
from zoo.datasets.records import Sequences
from zoo.errors import ExtrapolationWarning
from zoo.prediction.prediction import Prediction

NAMES = CATALOGUE.names(can="generate")
EXACT = [name for name in NAMES if isinstance(CATALOGUE[name].inference, Exact)]
DISCRETE = [name for name in EXACT if CATALOGUE[name].config.get("kind") != "rhythmic"]
FOLLOWING = ("vae-dmp", "vae-dmp-rhythmic", "ae-dmp", "dmp", "dmp-rhythmic", "pca-dmp")
every = pytest.mark.parametrize("name", NAMES)
exact = pytest.mark.parametrize("name", EXACT)
far = pytest.mark.filterwarnings("ignore::zoo.errors.ExtrapolationWarning")


def generated(name: str, like: Sequences | None = None, **wishes: Any) -> Prediction:
    """Three new movements, or those after ``like``."""
    return run_of(name).generate(like or movements()[:3], draws=4, **wishes)


def check(prediction: Prediction, frames: int) -> None:
    """Three whole movements of that many frames in the data's units."""
    assert prediction.shape == (3, frames, CHANNELS)
    assert prediction.lengths is not None and prediction.lengths.tolist() == [frames] * 3
    assert bool(prediction.mean.isfinite().all()) and bool((prediction.std >= 0).all())
    assert set(prediction.units) == {"rad"} and prediction.names == movements().channels
    assert prediction.seconds is not None and len(prediction.seconds) == frames


@every
@pytest.mark.parametrize("duration", [0.8, 1.0, 2.0])
def test_duration_stretches_the_frames(name: str, duration: float) -> None:
    check(generated(name, duration=duration), round((FRAMES - 1) * duration) + 1)


@every
def test_goals_are_one_for_all_or_one_for_each(name: str) -> None:
    goals = movements().values[3:6, -1].numpy()
    each = generated(name, goal=goals)
    check(each, FRAMES)
    check(generated(name, goal=goals[0]), FRAMES)
    assert not torch.equal(each.mean, generated(name).mean)


@pytest.mark.parametrize(
    "name",
    [
        "vae-dmp",
        "vae-dmp-rhythmic",
        "ae-dmp",
        "dmp",
        "dmp-rhythmic",
        "pca-dmp",
        "promp",
        "promp-rhythmic",
    ],
)
def test_a_goal_far_beyond_the_demonstrations_is_told_of(name: str) -> None:
    """0.3 of a joint's range too far; within a twentieth nothing."""
    low, high = movements().values.amin((0, 1)), movements().values.amax((0, 1))
    goal = movements().values[0, -1].clone()
    goal[2] = high[2] + 0.05 * (high - low)[2]
    generated(name, goal=goal.numpy())
    goal[2] = high[2] + 0.3 * (high - low)[2]
    with pytest.warns(ExtrapolationWarning, match=rf"^{name}: goals .* joint_2 to .* rad\)"):
        generated(name, goal=goal.numpy())


@far
@pytest.mark.parametrize("name", DISCRETE)
def test_the_goal_is_reached(name: str) -> None:
    apart = movements().values[3:6, -1] - movements().values[:3, -1]
    goals = movements().values[:3, -1] + 3 * apart  # where joints go together: few components do
    error = (generated(name, goal=goals.numpy()).mean[:, -1] - goals).abs().max()
    before = (generated(name).mean[:, -1] - goals).abs().max()
    assert float(error) < 0.2 * float(before)


@every
def test_switching_goes_onto_one_movement_or_one_for_each(name: str) -> None:
    switch = {"start": 6, "steps": 5}
    check(generated(name, onto=movements()[3:6], **switch), FRAMES)
    check(generated(name, onto=movements()[3:4], **switch), FRAMES)
    stretched = generated(name, onto=movements()[3:4], start=30, steps=5, duration=2.0)
    check(stretched, 2 * FRAMES - 1)


@exact
def test_a_switched_movement_begins_as_demonstrated_and_ends_on_the_other(name: str) -> None:
    switched = generated(name, onto=movements()[5:6], start=6, steps=5).mean
    here, there = generated(name).mean, generated(name, movements()[[5, 5, 5]]).mean
    torch.testing.assert_close(switched[:, :6], here[:, :6])
    apart = [float((path - there)[:, -1].norm(dim=-1).mean()) for path in (switched, here)]
    assert apart[0] < apart[1]


@every
def test_goal_duration_and_switch_combine_and_repeat(name: str) -> None:
    wishes = {
        "goal": movements().values[6, -1].numpy(),
        "duration": 1.5,
        "onto": movements()[4:5],
        "start": 10,
        "steps": 4,
    }
    first = generated(name, **wishes)
    check(first, round((FRAMES - 1) * 1.5) + 1)
    assert torch.equal(first.mean, generated(name, **wishes).mean)


@every
@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        ({"goal": [1.0, 2.0]}, r"goal has shape \(2,\)"),
        ({"goal": [np.nan] * CHANNELS}, "goal must be finite"),
        ({"duration": 0.0}, "duration must be positive"),
        ({"duration": 0.01}, "leaves 1 of 24 frames"),
        ({"start": 5}, "name the movements"),
        ({"onto": [0, 1], "steps": 3}, "onto has 2 movements; 1 or 3"),
        ({"onto": [0], "start": 20, "steps": 10}, "does not fit in 24 frames"),
        ({"onto": [0], "start": -1}, "start must be at least 0"),
        ({"onto": [0], "steps": 0}, "steps must be at least 1"),
    ],
)
def test_impossible_wishes_are_named(name: str, wishes: dict[str, Any], message: str) -> None:
    given = {k: movements()[v] if k == "onto" else v for k, v in wishes.items()}
    with pytest.raises(ValueError, match=message):
        generated(name, **given)


@far
@exact
def test_movements_of_several_lengths_keep_their_own_goals_and_switches(name: str) -> None:
    whole = [v.numpy() for v in movements().values]
    arrays = [v[: FRAMES - 4 * (i % 2)] for i, v in enumerate(whole)]
    given = {"rate": 30.0, "channels": movements().channels, "units": "rad"}
    ragged = Sequences.from_arrays(arrays, **given)
    run = zoo.fit(zoo.create(name, ragged), ragged)
    goals = np.stack([a[-1] + 0.1 * i for i, a in enumerate(arrays)])
    longer = run.generate(ragged, goal=goals, duration=2.0, draws=4)
    assert longer.lengths is not None
    assert longer.lengths.tolist() == [2 * len(a) - 1 for a in arrays]
    alone = run.generate(ragged[1:2], goal=goals[1], duration=2.0, draws=4)
    torch.testing.assert_close(longer.mean[1, : alone.shape[1]], alone.mean[0])
    onto = movements()[[1, 2, 3, 4, 5, 6, 7, 0]]
    switched = run.generate(ragged, onto=onto, start=5, steps=4, draws=4)
    alone = run.generate(ragged[1:2], onto=onto[1:2], start=5, steps=4, draws=4)
    torch.testing.assert_close(switched.mean[1, : alone.shape[1]], alone.mean[0])
    with pytest.raises(ValueError, match="onto has movements of 20 to 24 frames"):
        run.generate(ragged, onto=ragged, start=5, steps=4, draws=4)
