"""Bodies that channels move: a human skeleton and a robot arm."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.cmu_mocap import load_skeleton
from zoo.datasets.robot_arm import link_frames
from zoo.datasets.skeleton import Skeleton

__all__ = ["Arm", "Body", "Human", "body_for"]

ANGLE = re.compile(r"[a-z]+_[rt][xyz]")
ARM_CHANNELS = tuple(f"joint_{i}" for i in range(1, 7))


class Body(Protocol):
    """Something with joints in space, moved by named channels."""

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """Pairs of joints with a limb between them."""
        ...

    @property
    def sides(self) -> tuple[str, ...]:
        """``left``, ``right`` or ``middle`` for every edge."""
        ...

    def place(
        self, values: Float[Tensor, "*frame channel"], names: Sequence[str]
    ) -> Float[Tensor, "*frame joint 3"]:
        """Positions in m, the second coordinate pointing up."""
        ...


@dataclass(frozen=True)
class Human:
    """A skeleton of motion capture; channels that are not given rest at 0."""

    skeleton: Skeleton

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """Bones."""
        return self.skeleton.edges

    @property
    def sides(self) -> tuple[str, ...]:
        """By the first letter of the bone's name."""
        middle = {"root", "lowerback", "lowerneck"}
        named = {"l": "left", "r": "right"}
        ends = (self.skeleton.joints[i] for _, i in self.edges)
        return tuple("middle" if e in middle else named.get(e[0], "middle") for e in ends)

    def place(
        self, values: Float[Tensor, "*frame channel"], names: Sequence[str]
    ) -> Float[Tensor, "*frame joint 3"]:
        """Forward kinematics of the skeleton."""
        return self.skeleton.positions(values.double(), channels=names)


@dataclass(frozen=True)
class Arm:
    """The six-joint robot arm of §6.3.2.

    >>> Arm().place(torch.zeros(1, 6), ARM_CHANNELS).shape
    torch.Size([1, 7, 3])
    """

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """Links, from the base to the tool."""
        return tuple((i, i + 1) for i in range(6))

    @property
    def sides(self) -> tuple[str, ...]:
        """Links alternate, so that they can be told apart."""
        return tuple("middle" if i % 2 else "right" for i in range(6))

    def place(
        self, values: Float[Tensor, "*frame channel"], names: Sequence[str]
    ) -> Float[Tensor, "*frame joint 3"]:
        """Origins of the base and all links; the arm's z axis points up."""
        x, y, z = link_frames(values.double())[..., :3, 3].unbind(-1)
        return torch.stack([x, z, -y], -1)


def body_for(names: Sequence[str], body: Body | None = None) -> Body:
    """The body that channels of these names move, where none is given.

    Joint angles of the robot arm are its own; others are sought in the skeleton of CMU subject 35,
    on which the 50 angles of §5.3.1 are defined.
    """
    if body is not None:
        return body
    if tuple(names) == ARM_CHANNELS:
        return Arm()
    _check([name for name in names if not ANGLE.fullmatch(name)])
    human = Human(load_skeleton(35))
    _check([name for name in names if name not in human.skeleton.channels])
    return human


def _check(foreign: Sequence[str]) -> None:
    if foreign:
        raise ValueError(
            f"channel {foreign[0]!r} moves no body known here; give body=, such as "
            "Human(skeleton) with the skeleton of these data"
        )
