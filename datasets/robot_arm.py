"""Simulated data of a 6-DoF KUKA KR5 arm whose end effector moves on straight lines (§6.3.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.records import Sequences

__all__ = [
    "GOALS",
    "HELD_OUT",
    "HOME",
    "LIMITS",
    "LINKS",
    "ORIENTATION",
    "RATE",
    "START",
    "end_effector",
    "follow_path",
    "inverse_kinematics",
    "joint_sequences",
    "link_frames",
    "load",
    "load_held_out",
    "minimum_jerk",
]

# d (m), a (m), α (rad) of every link in standard Denavit-Hartenberg convention: KR5 arc with a
# tool of 11.5 cm, as in Corke's Robotics Toolbox.
LINKS = torch.tensor(
    [
        [0.4, 0.18, -math.pi / 2],
        [0.0, 0.6, 0.0],
        [0.0, 0.12, math.pi / 2],
        [-0.62, 0.0, -math.pi / 2],
        [0.0, 0.0, math.pi / 2],
        [-0.115, 0.0, math.pi],
    ],
    dtype=torch.float64,
)
LIMITS = torch.deg2rad(
    torch.tensor(
        [[-155, 155], [-180, 65], [-15, 158], [-350, 350], [-130, 130], [-350, 350]],
        dtype=torch.float64,
    )
)
HEIGHT = 0.3
RATE = 25.0
FRAMES = 76
START = (0.7, -0.3)
GOALS = {
    "p_1": (0.7, 0.7),
    "p_2": (0.9, 0.5),
    "p_3": (0.5, 0.7),
    "p_4": (0.9, 0.2),
    "p_5": (0.4, 0.4),
}
HELD_OUT = {"p_6": (0.5, 0.5), "p_7": (0.8, 0.8)}
CHANNELS = tuple(f"joint_{i}" for i in range(1, 7))
TILT = math.radians(20)
ORIENTATION = torch.tensor(
    [
        [-math.cos(TILT), 0.0, -math.sin(TILT)],
        [0.0, 1.0, 0.0],
        [math.sin(TILT), 0.0, -math.cos(TILT)],
    ],
    dtype=torch.float64,
)
HOME = torch.tensor([0.2, -0.9, 0.4, 0.0, 0.8, 2.9], dtype=torch.float64)


def link_frames(
    angles: Float[Tensor, "*batch joint"],
) -> Float[Tensor, "*batch frame 4 4"]:
    """Poses of the base and of all six links in the base frame; ``angles`` in rad."""
    d, a, alpha = LINKS.to(angles).unbind(-1)
    c, s, ca, sa = angles.cos(), angles.sin(), alpha.cos(), alpha.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = [c, -s * ca, s * sa, a * c, s, c * ca, -c * sa, a * s, zero, zero + sa, zero + ca]
    step = torch.stack([*rows, zero + d, zero, zero, zero, one], -1).unflatten(-1, (4, 4))
    frames = [torch.eye(4).to(angles).expand_as(step[..., 0, :, :])]
    for i in range(6):
        frames.append(frames[-1] @ step[..., i, :, :])
    return torch.stack(frames, -3)


def end_effector(angles: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch 3"]:
    """Position of the tool tip in m for joint ``angles`` in rad.

    >>> [round(x, 3) for x in end_effector(torch.zeros(6)).tolist()]
    [0.9, 0.0, -0.335]
    """
    if angles.shape[-1] != 6:
        raise ValueError(f"the KR5 has 6 joints; angles have {angles.shape[-1]}")
    return link_frames(angles)[..., -1, :3, 3]


def _error_and_jacobian(
    angles: Float[Tensor, "batch 6"], position: Float[Tensor, "batch 3"], rotation: Tensor
) -> tuple[Float[Tensor, "batch 6"], Float[Tensor, "batch 6 6"]]:
    frames = link_frames(angles)
    axes, origins = frames[:, :6, :3, 2], frames[:, :6, :3, 3]
    tip, turned = frames[:, 6, :3, 3], frames[:, 6, :3, :3]
    linear = torch.linalg.cross(axes, tip[:, None] - origins)
    jacobian = torch.cat([linear, axes], -1).mT
    turn = torch.linalg.cross(turned, rotation.expand_as(turned), dim=-2).sum(-1) / 2
    return torch.cat([position - tip, turn], -1), jacobian


def inverse_kinematics(
    position: Float[Tensor, "batch 3"],
    *,
    near: Float[Tensor, "*batch joint"],
    rotation: Float[Tensor, "3 3"] = ORIENTATION,
    tolerance: float = 1e-10,
    iterations: int = 60,
) -> Float[Tensor, "batch joint"]:
    """Joint angles in rad that bring the tool to ``position`` (m) and ``rotation``.

    Gauss-Newton from ``near``, damped by the squared error so that it ends quadratically.
    Raises a ValueError for a pose that the arm cannot reach from there to ``tolerance``.

    >>> q = inverse_kinematics(torch.tensor([[0.7, 0.2, 0.3]]).double(), near=HOME)
    >>> bool((end_effector(q) - torch.tensor([0.7, 0.2, 0.3])).abs().max() < 1e-7)
    True
    """
    angles = near.expand(len(position), 6)
    eye = torch.eye(6, dtype=angles.dtype)
    for _ in range(iterations):
        error, jacobian = _error_and_jacobian(angles, position, rotation)
        size = error.square().sum(-1)
        if bool((size <= tolerance**2).all()):
            return angles
        normal = jacobian.mT @ jacobian + (size / 10)[:, None, None] * eye
        angles = angles + torch.linalg.solve(normal, (jacobian.mT @ error[..., None])[..., 0])
    worst = int(size.argmax())
    raise ValueError(
        f"the arm does not reach {[round(x, 3) for x in position[worst].tolist()]} m: "
        f"error {float(size[worst].sqrt()):.1e} after {iterations} iterations"
    )


def minimum_jerk(time: Tensor) -> Tensor:
    """Path fraction of the smoothest reach at ``time`` in [0, 1]; at rest at both ends."""
    t = time.clamp(0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def follow_path(path: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch time joint"]:
    """Joint angles in rad that take the tool along ``path`` (m).

    Each frame is solved from the one before, so that the arm never changes its configuration.
    """
    angles = [inverse_kinematics(path[:, 0], near=HOME)]
    for t in range(1, path.shape[1]):
        angles.append(inverse_kinematics(path[:, t], near=angles[-1]))
    return torch.stack(angles, 1)


def load() -> Sequences:
    """The five demonstrations p_0 → p_1 … p_5 of §6.3.2: 76 frames of six joint angles in rad.

    Fig. 52 gives no coordinates. Here p_0 = (0.7, -0.3) and the goals (0.7, 0.7), (0.9, 0.5),
    (0.5, 0.7), (0.9, 0.2), (0.4, 0.4) m at z = 0.3 m surround p_6, while p_7 lies beyond them.
    The tool keeps its orientation, leaning 20° back from the vertical, so that all six joints
    move; the timing is minimum-jerk, at rest at both ends as a discrete DMP assumes, over 3 s.

    >>> data = load()
    >>> data.values.shape, data.groups["goal"]
    (torch.Size([5, 76, 6]), ('p_1', 'p_2', 'p_3', 'p_4', 'p_5'))
    """
    return _demonstrations(GOALS, "robot-arm")


def load_held_out() -> Sequences:
    """The optimal movements from p_0 to the goals p_6 and p_7, which are never trained on.

    >>> tip = end_effector(load_held_out().values)[:, -1]
    >>> [[round(abs(x), 6) for x in p] for p in tip.tolist()]
    [[0.5, 0.5, 0.3], [0.8, 0.8, 0.3]]
    """
    return _demonstrations(HELD_OUT, "robot-arm/held-out")


def _demonstrations(goals: dict[str, tuple[float, float]], name: str) -> Sequences:
    start = torch.tensor([*START, HEIGHT], dtype=torch.float64)
    goal = torch.tensor([[*g, HEIGHT] for g in goals.values()], dtype=torch.float64)
    fraction = minimum_jerk(torch.linspace(0, 1, FRAMES, dtype=torch.float64))
    angles = follow_path(start + fraction[:, None] * (goal - start)[:, None])
    groups = {"goal": list(goals), "line": [f"p_0-{g}" for g in goals]}
    return joint_sequences(angles, groups, name)


def joint_sequences(angles: Tensor, groups: Mapping[str, Sequence[object]], name: str) -> Sequences:
    """A record of joint angles of this arm."""
    return Sequences.from_arrays(
        list(angles.numpy()),
        rate=RATE,
        channels=CHANNELS,
        units="rad",
        groups=groups,
        name=name,
        provenance="simulated",
    )
