"""Templates to which demonstrations are aligned: a primitive's roll-out, and a path of a basis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.models.primitives.conjugate_regression import FLOOR
from zoo.models.primitives.rollout import Primitive, roll_out
from zoo.models.primitives.sufficient_statistics import of_weights, sights, squares, sums_of
from zoo.models.primitives.weights import Basis
from zoo.movement.timing import Movements, Timing, align, duration, period_of, phases

__all__ = ["BasisOf", "anchors", "anchors_of", "basis_timings", "primitive_timings"]

BasisOf = Callable[[int, Timing], Basis]

TEMPOS, DIRECTIONS = (1.0, 0.8, 0.9, 1.1, 1.25), 16
RATIO = 1e-2
RIDGE = 1e-6


def primitive_timings(
    primitive: Primitive, movements: Movements, period: float | None
) -> list[Timing]:
    """Duration of discrete movements; tempo and phase of rhythmic ones, by roll-outs."""
    if primitive.kind == "discrete":
        return [duration(len(x)) for x, _ in movements]
    middle = period_of(movements) if period is None else period
    choices = phases(middle, TEMPOS, DIRECTIONS)

    def fitted(some: Movements, timings: list[Timing]) -> Float[Tensor, "channel kernel"]:
        ratio = some[0][0].new_full(some[0][0].shape[1:], RATIO)
        sums, _ = sums_of(primitive, ratio, some, timings)
        precision, linear = of_weights(sums, anchors_of(primitive, some, timings))
        total = precision.sum(0) * (len(linear) / len(precision))
        size = total.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None].clamp_min(FLOOR)
        ridge = RIDGE * size * torch.eye(total.shape[-1], dtype=total.dtype)
        weights: Tensor = torch.linalg.solve(total + ridge, linear.sum(0)[..., None])
        return weights[..., 0]

    def nearest(x: Tensor, seen: Tensor, template: Tensor) -> int:
        θ = torch.cat([anchors(primitive, x, seen, choices[0]), template], dim=1)
        paths = torch.stack([roll_out(primitive, len(x), choice) @ θ.T for choice in choices])
        (view,) = sights(primitive, choices[:1], x.new_full(x.shape[1:], RATIO), seen)
        errors = view.errors((x - paths) * seen)
        return int(squares(errors, len(choices)).sum(-1).argmin())

    return align(movements, choices, fitted, nearest)


def basis_timings(basis: BasisOf, movements: Movements, choices: Sequence[Timing]) -> list[Timing]:
    """The choice for every movement, by the least-squares path of all as they lie."""

    @lru_cache(maxsize=4)
    def all_of(frames: int) -> tuple[Tensor, Tensor]:
        bases = [basis(frames, choice) for choice in choices]
        return torch.stack([b.phases for b in bases]), bases[0].synergies

    def fitted(some: Movements, timings: list[Timing]) -> Float[Tensor, " weight"]:
        pairs = zip(some, timings, strict=True)
        parts = [(basis(len(x), timing), x, seen) for (x, seen), timing in pairs]
        total = torch.stack([b.precision(seen.to(x)) for b, x, seen in parts]).sum(0)
        linear = torch.stack([b.linear(x * seen) for b, x, seen in parts]).sum(0)
        ridge = RIDGE * total.diagonal().mean() * torch.eye(len(total), dtype=total.dtype)
        template: Tensor = torch.linalg.solve(total + ridge, linear)
        return template

    def nearest(x: Tensor, seen: Tensor, template: Tensor) -> int:
        """Σ (y² − 2xy) of the template's path y over the entries observed is least."""
        φ, synergies = all_of(len(x))
        table = synergies @ template.unflatten(0, (synergies.shape[1], φ.shape[2]))
        square = torch.einsum("tc,ck,cl->tkl", seen.to(x), table, table)
        own = torch.einsum("htk,tkl,htl->h", φ, square, φ)
        return int((own - 2 * torch.einsum("htk,tk->h", φ, (x * seen) @ table)).argmin())

    return align(movements, choices, fitted, nearest)


def anchors_of(
    primitive: Primitive, movements: Movements, timings: Sequence[Timing]
) -> Float[Tensor, "sequence channel 3"]:
    """The anchors of every movement."""
    pairs = zip(movements, timings, strict=True)
    return torch.stack([anchors(primitive, x, seen, timing) for (x, seen), timing in pairs])


def anchors(
    primitive: Primitive,
    x: Float[Tensor, "time channel"],
    seen: Bool[Tensor, "time channel"],
    timing: Timing,
) -> Float[Tensor, "channel 3"]:
    """y₁, ẏ₁ and g of a movement: its first observed frames and its last, or a rhythm's mean."""
    if len(x) > 1 and bool(seen.all()):
        goal = x[-1] if primitive.kind == "discrete" else x.mean(0)
        return torch.stack([x[0], (x[1] - x[0]) * timing.unit, goal], dim=1)
    order = torch.arange(len(x))[:, None].expand_as(seen)
    first = order.where(seen, len(x) - 1).amin(0)
    second = order.where(seen & (order > first), len(x)).amin(0)
    last = order.where(seen, 0).amax(0)
    begin = x.gather(0, first[None])[0]
    next_ = x.gather(0, second.clamp(max=len(x) - 1)[None])[0]
    velocity = (next_ - begin) / (second - first).clamp(min=1) * timing.unit
    velocity = velocity.where(second < len(x), 0)
    middle = x.sum(0) / seen.sum(0).clamp(min=1)
    goal = x.gather(0, last[None])[0] if primitive.kind == "discrete" else middle
    return torch.stack([begin, velocity, goal], dim=1)
