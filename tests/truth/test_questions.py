"""What is asked of a run: which entries are missing, and tasks that have no answer."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from support import CHANNELS, FRAMES, movements

import zoo
from zoo.errors import MovementLengthError, NotCalibratedWarning, NotCapableError, UnknownNameError
from zoo.evaluation.questions import hide_joints, hide_section

TRAIN, HELD_OUT = movements()[:6], movements()[6:]
QUICK: dict[str, Any] = {"latent_dim": 2, "epochs": 2}


@pytest.fixture(scope="module")
def whole() -> zoo.Run:
    """A model of movements of 24 frames: it reconstructs nothing shorter."""
    return zoo.fit(zoo.create("vae-dmp", TRAIN, **QUICK), TRAIN)


def test_a_task_without_an_answer_is_a_line_that_says_so(whole: zoo.Run) -> None:
    """One refusal once ended the whole evaluation; the other tasks are scored as ever."""
    short = HELD_OUT.first(20)
    table = zoo.evaluate(whole, short, setup=zoo.Setup(seen=10, draws=20))
    assert {row.task for row in table.rows} == {"forecast", "impute joints", "impute section"}
    assert [r.task for r in table.refusals] == ["reconstruct"]
    alone = zoo.evaluate(whole, short, tasks=["forecast"], setup=zoo.Setup(seen=10, draws=20))
    assert alone["forecast"]["rmse"] == table["forecast"]["rmse"] and not alone.refusals
    assert "No answer to reconstruct by vae-dmp: movements have 20 frames" in table.to_markdown()
    assert table.to_json()["refused"][0]["task"] == "reconstruct"
    with pytest.raises(KeyError, match="no answer to reconstruct: movements have 20 frames"):
        table["reconstruct"]
    joined = zoo.Table.join([table, alone])
    assert joined.select("reconstruct").refusals == table.refusals
    with pytest.raises(MovementLengthError, match="movements have 20 frames"):
        zoo.evaluate(whole, short, tasks=["reconstruct"])


def test_what_cannot_be_calibrated_is_a_warning(whole: zoo.Run) -> None:
    short = movements().first(20)
    unseen = zoo.Sequences.from_arrays(
        [a + 0.01 for a in short.arrays], rate=30.0, units="rad", channels=short.channels
    )
    setup = zoo.Setup(seen=10, draws=20)
    with pytest.warns(NotCalibratedWarning, match="reconstruct has no answer .* stays uncal"):
        whole.calibrate(unseen, method="scale", setup=setup)
    assert "forecast" in whole.calibration.tasks and "reconstruct" not in whole.calibration.tasks


def test_named_channels_are_hidden_and_no_others() -> None:
    for hidden, columns in (
        (("joint_2",), [2]),
        (("joint_5", "joint_0"), [0, 5]),
        (("joint",), None),
    ):
        if columns is None:
            with pytest.raises(ValueError, match="names all 7 channels"):
                hide_joints(TRAIN, hidden)
            continue
        holed = hide_joints(TRAIN, hidden)
        gone = ~holed.mask.any(1).any(0)
        assert gone.nonzero().flatten().tolist() == columns
        assert not bool(holed.values[..., columns].any())
        kept = [i for i in range(CHANNELS) if i not in columns]
        assert torch.equal(holed.values[..., kept], TRAIN.values[..., kept])


def test_a_joint_stands_for_all_its_channels() -> None:
    legs = zoo.Sequences.from_arrays(
        torch.ones(2, 5, 4).numpy(),
        rate=1.0,
        channels=["hip_rx", "hip_ry", "hipbone_rx", "knee_rx"],
    )
    holed = hide_joints(legs, ("hip",))
    assert holed.mask[0, 0].tolist() == [False, False, True, True]
    with pytest.raises(UnknownNameError, match=r"no channel or joint 'nee_rx' to hide.*knee_rx"):
        hide_joints(legs, ("nee_rx",))


def test_a_share_hides_that_share_drawn_by_the_seed() -> None:
    hidden = [~hide_joints(TRAIN, 0.4, seed=s).mask[0, 0] for s in range(8)]
    assert {int(h.sum()) for h in hidden} == {3}
    assert len({tuple(h.tolist()) for h in hidden}) > 1


def test_a_section_is_where_it_was_asked_for() -> None:
    holed = hide_section(TRAIN, (4, 9))
    assert (~holed.mask.any(-1)).nonzero()[:, 1].unique().tolist() == [4, 5, 6, 7, 8]
    middle = (~hide_section(TRAIN, 0.25).mask[0].any(-1)).nonzero().flatten()
    assert middle.tolist() == list(range(9, 15))
    with pytest.raises(ValueError, match="shortest movement, which has 24"):
        hide_section(TRAIN, (0, FRAMES))
    with pytest.raises(ValueError, match="shortest movement, which has 24"):
        hide_section(TRAIN, (20, 30))


def test_one_channel_has_no_joints_to_hide() -> None:
    with pytest.raises(NotCapableError, match="at least 2 channels"):
        hide_joints(TRAIN.select(["joint_0"]), 0.2)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"hidden": 0.0}, "above 0 and below 1; got 0.0"),
        ({"hidden": 1.5}, "above 0 and below 1; got 1.5"),
        ({"hidden": ()}, r"hidden needs names of channels or joints; got \(\)"),
        ({"hidden": (1,)}, "hidden needs names"),
        ({"hidden": "joint_1"}, "hidden takes a share or names .* in a tuple; got 'joint_1'"),
        ({"section": 1.0}, "above 0 and below 1"),
        ({"section": (9, 4)}, "0 <= start < stop"),
        ({"section": (0.1, 0.2)}, "0 <= start < stop"),
        ({"section": "all"}, "section takes a share or frames"),
        ({"seen": 0}, "seen must be at least 1; got 0"),
        ({"draws": 0}, "draws must be at least 1; got 0"),
    ],
)
def test_a_setup_that_means_nothing_is_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises((ValueError, TypeError), match=reason):
        zoo.Setup(**settings)


@pytest.mark.filterwarnings("ignore::zoo.errors.OtherQuestionWarning")
def test_evaluation_and_calibration_are_told_what_will_be_missing() -> None:
    """Scored entries are those named; bands of a channel are mended by its own errors."""
    setup = zoo.Setup(hidden=("joint_3",), section=(8, 12), draws=20)
    run = zoo.fit(zoo.create("pca", TRAIN, latent_dim=2), TRAIN)
    table = zoo.evaluate(run, HELD_OUT, setup=setup)
    assert table["impute joints"].entries == 2 * FRAMES
    assert table["impute section"].entries == 2 * 4 * CHANNELS
    noisy = TRAIN.values.clone()
    noise = torch.randn(noisy.shape[:2], generator=torch.Generator().manual_seed(0))
    noisy[..., 3] += noise.to(noisy)
    unseen = zoo.Sequences.from_arrays(
        list(noisy.numpy()), rate=30.0, units="rad", channels=TRAIN.channels
    )
    asked = hide_joints(HELD_OUT, ("joint_3",))
    raw = run.impute(asked).std[..., 3]
    run.calibrate(unseen, method="scale", tasks=["impute joints"], setup=setup)
    assert bool((run.impute(asked).std[..., 3] > 2 * raw).all())
    with pytest.raises(UnknownNameError, match="no channel or joint 'elbow'"):
        zoo.evaluate(run, HELD_OUT, setup=zoo.Setup(hidden=("elbow",)))
