"""The simulated arm: kinematics by other roads, lines, goals and the reaching data."""

import math
import time

import numpy as np
import pytest
import torch

from zoo.datasets import reaching, robot_arm
from zoo.datasets.robot_arm import (
    GOALS,
    HELD_OUT,
    HOME,
    LIMITS,
    ORIENTATION,
    START,
    end_effector,
    inverse_kinematics,
    link_frames,
)


@pytest.fixture(scope="module")
def angles() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 4 * torch.rand(40, 6, generator=generator, dtype=torch.float64) - 2


def twist(axis: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Generator of a rotation about a line in space."""
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    x, y, z = axis.tolist()
    matrix[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    matrix[:3, 3] = -torch.linalg.cross(axis, point)
    return matrix


def test_kinematics_equal_the_product_of_exponentials(angles: torch.Tensor) -> None:
    rest = link_frames(torch.zeros(6, dtype=torch.float64))
    twists = [twist(frame[:3, 2], frame[:3, 3]) for frame in rest[:6]]
    pose = torch.eye(4, dtype=torch.float64).expand(len(angles), 4, 4)
    for i, generator in enumerate(twists):
        pose = pose @ torch.linalg.matrix_exp(angles[:, i, None, None] * generator)
    torch.testing.assert_close(link_frames(angles)[:, -1], pose @ rest[-1], rtol=0, atol=1e-12)


def test_geometry_of_the_stretched_arm_by_hand() -> None:
    upright = torch.tensor([0, -math.pi / 2, math.pi / 2, 0, 0, 0], dtype=torch.float64)
    # Upper arm straight up; forearm and tool hang down from an elbow 0.12 m in front of it.
    expected = torch.tensor([0.18 + 0.12, 0.0, 0.4 + 0.6 - 0.62 - 0.115], dtype=torch.float64)
    torch.testing.assert_close(end_effector(upright), expected, rtol=0, atol=1e-12)


def test_kinematics_equal_the_robotics_toolbox(angles: torch.Tensor) -> None:
    toolbox = pytest.importorskip("roboticstoolbox")
    arm = toolbox.models.DH.KR5()
    poses = np.stack([np.asarray(arm.fkine(q.numpy())) for q in angles])
    np.testing.assert_allclose(link_frames(angles)[:, -1].numpy(), poses, rtol=0, atol=1e-12)
    np.testing.assert_allclose(LIMITS.T.numpy(), arm.qlim, atol=1e-12)


def test_inverse_kinematics_reach_position_and_orientation() -> None:
    aim = torch.tensor([[0.5, 0.3, 0.3], [0.9, -0.2, 0.3], [0.6, 0.7, 0.3]], dtype=torch.float64)
    pose = link_frames(inverse_kinematics(aim, near=HOME))[:, -1]
    torch.testing.assert_close(pose[:, :3, 3], aim, rtol=0, atol=1e-9)
    turned = ORIENTATION.expand(3, 3, 3)
    torch.testing.assert_close(pose[:, :3, :3], turned, rtol=0, atol=1e-9)


def test_jacobian_equals_finite_differences(angles: torch.Tensor) -> None:
    aim = torch.zeros(40, 3, dtype=torch.float64)
    _, jacobian = robot_arm._error_and_jacobian(angles, aim, ORIENTATION)
    automatic = torch.autograd.functional.jacobian(lambda q: end_effector(q).sum(0), angles)
    torch.testing.assert_close(jacobian[:, :3], automatic.transpose(0, 1), rtol=0, atol=1e-12)


def test_a_place_out_of_reach_is_named() -> None:
    with pytest.raises(ValueError, match=r"does not reach \[3.0, 0.0, 0.3\] m"):
        inverse_kinematics(torch.tensor([[3.0, 0.0, 0.3]], dtype=torch.float64), near=HOME)


def test_wrong_number_of_joints_is_named() -> None:
    with pytest.raises(ValueError, match="6 joints; angles have 5"):
        end_effector(torch.zeros(5))


@pytest.mark.parametrize(
    ("data", "goals"), [(robot_arm.load(), GOALS), (robot_arm.load_held_out(), HELD_OUT)]
)
def test_demonstrations_are_straight_lines_within_the_limits(data, goals) -> None:
    assert data.values.shape == (len(goals), 76, 6)
    assert data.provenance == "simulated"
    assert data.groups["goal"] == tuple(goals)
    assert bool(((data.values > LIMITS[:, 0]) & (data.values < LIMITS[:, 1])).all())
    assert float(data.values.diff(dim=1).abs().max()) < 0.06
    tips = end_effector(data.values)
    start = torch.tensor([*START, 0.3], dtype=torch.float64)
    for tip, goal in zip(tips, goals.values(), strict=True):
        line = torch.tensor([*goal, 0.3], dtype=torch.float64) - start
        torch.testing.assert_close(tip[0], start, rtol=0, atol=1e-9)
        torch.testing.assert_close(tip[-1], start + line, rtol=0, atol=1e-9)
        away = torch.linalg.cross(tip - start, line.expand_as(tip)) / line.norm()
        assert float(away.abs().max()) < 1e-9


def test_every_joint_moves() -> None:
    assert bool(
        (robot_arm.load().values.amax((0, 1)) - robot_arm.load().values.amin((0, 1)) > 0.3).all()
    )


def test_reaching_ends_at_its_goal_within_the_noise_of_the_joints() -> None:
    quiet = reaching.load(movements=24, noise=0.0)
    tips = end_effector(quiet.values)[:, -1]
    for goal in set(quiet.groups["goal"]):
        same = [i for i, g in enumerate(quiet.groups["goal"]) if g == goal]
        torch.testing.assert_close(
            tips[same], tips[same[:1]].expand(len(same), 3), atol=1e-9, rtol=0
        )
    height = end_effector(quiet.values)[..., 2]
    torch.testing.assert_close(height, torch.full_like(height, 0.3), rtol=0, atol=1e-9)
    noisy = reaching.load(movements=24)
    spread = (noisy.values - quiet.values).std()
    assert float(spread) == pytest.approx(0.004, rel=0.1)


def test_reaching_repeats_with_its_seed_and_is_quick() -> None:
    began = time.perf_counter()
    data = reaching.load()
    assert time.perf_counter() - began < 2
    assert torch.equal(data.values, reaching.load().values)
    assert not torch.equal(data.values, reaching.load(seed=1).values)
    assert (len(data), len(set(data.groups["operator"])), len(set(data.groups["goal"]))) == (
        120,
        12,
        30,
    )
    assert bool(((data.values > LIMITS[:, 0]) & (data.values < LIMITS[:, 1])).all())


@pytest.mark.parametrize(("option", "value"), [("movements", 0), ("noise", -1.0)])
def test_impossible_reaching_is_refused(option: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{option} must"):
        reaching.load(**{option: value})
