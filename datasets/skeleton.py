"""A tree of bones turned by joint angles, and the positions of its joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.split import named_columns

__all__ = ["Bone", "Skeleton"]

Triple = tuple[float, float, float]
ROTATIONS = ("rx", "ry", "rz")
TRANSLATIONS = ("tx", "ty", "tz")


@dataclass(frozen=True, kw_only=True)
class Bone:
    """A rigid bone: where it points at rest, how long it is, and how its joint turns.

    ``direction`` is a unit vector of the rest pose, ``length`` in m. The joint turns about
    axes that are turned by ``axis`` (rad, in the order ``axis_order``) against the world at rest,
    by the angles ``dof`` in that order, within ``limits`` (rad).
    """

    name: str
    parent: str | None
    direction: Triple = (0.0, 0.0, 0.0)
    length: float = 0.0
    axis: Triple = (0.0, 0.0, 0.0)
    axis_order: str = "XYZ"
    dof: tuple[str, ...] = ()
    limits: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """Bones in an order in which parents come first; the first is the root, without length.

    ``metre`` is how many metres one unit of length of the file was. ``position`` (m) is where
    the root stands at rest.

    >>> arm = Skeleton(name="arm", bones=(
    ...     Bone(name="root", parent=None, dof=("tx", "ty", "tz", "rx", "ry", "rz")),
    ...     Bone(name="humerus", parent="root", direction=(1.0, 0.0, 0.0), length=0.3, dof=("rz",)),
    ... ))
    >>> quarter = torch.tensor([torch.pi / 2])
    >>> arm.positions(quarter, channels=["humerus_rz"]).round(decimals=3).abs()
    tensor([[0.0000, 0.0000, 0.0000],
            [0.0000, 0.3000, 0.0000]])
    """

    name: str
    bones: tuple[Bone, ...]
    position: Triple = (0.0, 0.0, 0.0)
    metre: float = 1.0

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints: the root, and the far end of every bone."""
        return tuple(bone.name for bone in self.bones)

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Index of every bone's parent; −1 for the root."""
        return tuple(-1 if b.parent is None else self.joints.index(b.parent) for b in self.bones)

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """Pairs of joints to draw a line between."""
        return tuple((p, i) for i, p in enumerate(self.parents) if p >= 0)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of all degrees of freedom, bone by bone: ``root_tx``, …, ``ltoes_rx``."""
        return tuple(f"{bone.name}_{dof}" for bone in self.bones for dof in bone.dof)

    @property
    def units(self) -> tuple[str, ...]:
        """m for translations, rad for rotations."""
        return tuple("m" if c[-2] == "t" else "rad" for c in self.channels)

    @property
    def limits(self) -> Float[Tensor, "channel 2"]:
        """Lowest and highest angle of every channel in rad; infinite where none is given."""
        free = (-torch.inf, torch.inf)
        rows = [b.limits or (free,) * len(b.dof) for b in self.bones]
        return torch.tensor([pair for row in rows for pair in row], dtype=torch.float64)

    def positions(
        self, values: Float[Tensor, "*frame channel"], channels: Sequence[str] | None = None
    ) -> Float[Tensor, "*frame joint 3"]:
        """Positions of the joints in m by forward kinematics.

        ``values`` are rad and m in the order of ``channels`` (all of the skeleton's, where None);
        degrees of freedom that are not among them are 0, so that angles alone give the body with
        its centre fixed. Each joint turns its bone by C·M·Cᵀ, C the turn of its axes and
        M = R_z R_y R_x of its angles.
        """
        names = self.channels if channels is None else channels
        if values.shape[-1] != len(names):
            raise ValueError(
                f"values have {values.shape[-1]} channels; {len(names)} are needed ({names[0]}, …)"
            )
        columns = named_columns(self.channels, names, "channel of the skeleton")
        full = values.new_zeros(*values.shape[:-1], len(self.channels))
        full[..., columns] = values
        given = dict(zip(self.channels, full.unbind(-1), strict=True))
        turns: list[Tensor] = []
        places: list[Tensor] = []
        for bone, parent in zip(self.bones, self.parents, strict=True):
            axes = _axes(bone).to(values)
            turn = axes @ _turn(bone, given, values[..., 0]) @ axes.mT
            shift = self._shift(bone, given, values[..., 0])
            turns.append(turn if parent < 0 else turns[parent] @ turn)
            reach = (turns[-1] @ shift[..., None])[..., 0]
            places.append(shift if parent < 0 else places[parent] + reach)
        return torch.stack(places, -2)

    def _shift(self, bone: Bone, given: dict[str, Tensor], like: Tensor) -> Tensor:
        """From the parent to the joint, in the bone's own frame at rest."""
        if bone.parent is None:
            moved = [given.get(f"{bone.name}_{t}", torch.zeros_like(like)) for t in TRANSLATIONS]
            return torch.stack(moved, -1) + like.new_tensor(self.position)
        vector = bone.length * like.new_tensor(bone.direction)
        return vector.expand(*like.shape, 3)


def _turn(bone: Bone, given: dict[str, Tensor], like: Tensor) -> Float[Tensor, "*frame 3 3"]:
    turn = torch.eye(3, dtype=like.dtype, device=like.device).expand(*like.shape, 3, 3)
    for dof in bone.dof:
        if dof in ROTATIONS:
            turn = _about(dof[1], given[f"{bone.name}_{dof}"]) @ turn
    return turn


def _axes(bone: Bone) -> Float[Tensor, "3 3"]:
    axes = torch.eye(3, dtype=torch.float64)
    for letter in bone.axis_order.lower():
        angle = torch.tensor(bone.axis["xyz".index(letter)], dtype=torch.float64)
        axes = _about(letter, angle) @ axes
    return axes


def _about(letter: str, angle: Float[Tensor, "*frame"]) -> Float[Tensor, "*frame 3 3"]:
    """Rotation by ``angle`` about one of the axes x, y, z."""
    i = "xyz".index(letter)
    j, k = (i + 1) % 3, (i + 2) % 3
    turn = angle.new_zeros(*angle.shape, 3, 3)
    turn[..., i, i] = 1.0
    turn[..., j, j] = turn[..., k, k] = angle.cos()
    turn[..., k, j] = angle.sin()
    turn[..., j, k] = -angle.sin()
    return turn
