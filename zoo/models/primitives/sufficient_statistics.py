"""What observed entries say of a movement's parameters, under the linear-Gaussian model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from zoo.models.primitives.kalman import PathNoise, Smoother
from zoo.models.primitives.rollout import Primitive, roll_out
from zoo.movement.timing import Movements, Timing

__all__ = [
    "Sight",
    "Sums",
    "in_parts",
    "of_weights",
    "sights",
    "square_after",
    "squares",
    "sums_of",
]

COLUMNS = 500
SEQUENCE, CHANNEL = (-4, -3, -2, -2, -2), (-3, -2, -1, -1, -1)


@dataclass(frozen=True)
class Sums:
    """θ of a movement has the likelihood exp(−½ θᵀ ``precision`` θ + ``linear`` θ), in units of σ.

    ``square`` is ‖L⁻¹x‖², ``log_volume`` log |L|, L Lᵀ the covariance of x given θ. The sequence
    axis of ``precision`` has length 1 where all movements are observed alike, its channel axis
    where all channels are.
    """

    precision: Float[Tensor, "*ratio #sequence #channel parameter parameter"]
    linear: Float[Tensor, "*ratio sequence channel parameter"]
    square: Float[Tensor, "*ratio sequence channel"]
    count: Float[Tensor, "*ratio sequence #channel"]
    log_volume: Float[Tensor, "*ratio sequence #channel"]

    @property
    def parts(self) -> tuple[Tensor, ...]:
        """All of them, in order."""
        return tuple(getattr(self, f.name) for f in fields(self))

    def at(self, ratio: int) -> Sums:
        """Those under one of several noise ratios."""
        return Sums(*(part[ratio] for part in self.parts))

    def of_channels(self, ratio: Int[Tensor, " channel"]) -> Sums:
        """Those under one of several noise ratios, each channel its own."""
        if bool((ratio == ratio[0]).all()):
            return self.at(int(ratio[0]))
        channel = torch.arange(len(ratio))
        wide = [_expanded(p, a, len(ratio)) for p, a in zip(self.parts, CHANNEL, strict=True)]
        first = [p.movedim(a, 1)[ratio, channel] for p, a in zip(wide, CHANNEL, strict=True)]
        return Sums(*(p.movedim(0, a) for p, a in zip(first, CHANNEL, strict=True)))

    def log_density(self, variance: Float[Tensor, " channel"]) -> Float[Tensor, " sequence"]:
        """log p(x | θ = 0), of channels with variance σ²."""
        white = self.square / variance + self.count * (2 * math.pi * variance).log()
        density: Tensor = -(white / 2 + self.log_volume).sum(-1)
        return density

    def of_movements(self, rows: Shaped[Tensor, " some"]) -> Sums:
        """Those of some movements."""
        precision, *rest = self.parts
        alike = len(precision) == 1
        return Sums(precision if alike else precision[rows], *(part[rows] for part in rest))


@dataclass(frozen=True)
class Sight:
    """A timing and observed entries: how they see movements, which hold 0 elsewhere.

    ``smoother`` has a pattern for every channel, or one for all. Columns are movements and channels
    as it takes them.
    """

    smoother: Smoother
    design: Float[Tensor, "time parameter"]

    def errors(
        self, x: Float[Tensor, "sequence time channel"]
    ) -> Float[Tensor, "*ratio pattern time column"]:
        """L⁻¹x; the same for all timings of one tempo."""
        return self.smoother.whiten(_columns(x, self._alike))

    def sums(
        self, errors: Float[Tensor, "*ratio pattern time column"], count: int, frames: int
    ) -> Sums:
        """What the first ``frames`` frames of ``count`` movements say, of their :meth:`errors`."""
        r, e = self._white[..., :frames, :], errors[..., :frames, :]
        volume = self.smoother.log_root[..., :frames].sum(-1)
        known = self.smoother.seen[..., :frames].sum(-1).to(e)
        return Sums(
            precision=(r.mT @ r).unsqueeze(-4),
            linear=_rows(r.mT @ e, count),
            square=squares(e, count),
            count=known.unsqueeze(-2).expand(*known.shape[:-1], count, -1),
            log_volume=volume.unsqueeze(-2).expand(*volume.shape[:-1], count, -1),
        )

    def follow(
        self, x: Float[Tensor, "*batch time channel"]
    ) -> Float[Tensor, "*batch time channel"]:
        """E[n | x] at θ = 0."""
        flat = x.flatten(0, -3)
        columns = self.smoother.follow(_columns(flat, self._alike))
        return _rows(columns, len(flat)).mT.view_as(x)

    @cached_property
    def given(self) -> Float[Tensor, "pattern time parameter"]:
        """What θ adds to E[y | θ, x], the rest of which follows x."""
        seen = self.smoother.seen[..., None]
        return self.design - self.smoother.follow(self.design * seen)

    @cached_property
    def _white(self) -> Float[Tensor, "*ratio pattern time parameter"]:
        return self.smoother.whiten(self.design * self.smoother.seen[..., None])

    @property
    def _alike(self) -> bool:
        return self.smoother.seen.shape[-2] == 1


def sights(
    primitive: Primitive,
    timings: Sequence[Timing],
    ratio: Float[Tensor, "*ratio channel"],
    seen: Bool[Tensor, "time channel"],
) -> list[Sight]:
    """The same entries in the light of every timing; timings of one tempo share the smoother."""
    frames, channels = seen.shape
    keys = torch.cat([ratio.reshape(-1, channels), seen.to(ratio)]).T
    first, index = keys[:1], None
    if bool((keys != first).any()):
        first, index = torch.unique(keys, dim=0, return_inverse=True)
    ratios = first[:, :-frames].T.reshape(*ratio.shape[:-1], len(first))
    known = first[:, -frames:].bool()

    def smoother(unit: float) -> Smoother:
        noise = PathNoise(primitive.system(Timing(unit)), frames)
        if bool(known.all()):
            found = _complete(noise, tuple(ratios.flatten().tolist()), ratios.shape)
        else:
            found = Smoother.of(noise, ratios, known)
        return found if index is None else found.at(index)

    shared = {unit: smoother(unit) for unit in {t.unit for t in timings}}
    return [Sight(shared[t.unit], roll_out(primitive, frames, t)) for t in timings]


@lru_cache(maxsize=8)
def _complete(noise: PathNoise, ratios: tuple[float, ...], shape: torch.Size) -> Smoother:
    """The smoother of movements without gaps, which are all alike."""
    ratio = torch.tensor(ratios, dtype=torch.float64).view(shape)
    return Smoother.of(noise, ratio, torch.ones(shape[-1], noise.frames, dtype=torch.bool))


def sums_of(
    primitive: Primitive,
    ratio: Float[Tensor, "*ratio channel"],
    movements: Movements,
    timings: Sequence[Timing],
) -> tuple[Sums, Sums]:
    """Sums of every movement, and those of its first quarter alone."""
    parts, order = [], []
    for rows in _groups(movements, timings):
        order += rows
        seen = movements[rows[0]][1]
        (view,) = sights(primitive, [timings[rows[0]]], ratio, seen)
        frames, begun = len(seen), max(2, len(seen) // 4)
        x = torch.stack([movements[i][0] for i in rows]) * seen
        parts.append(in_parts(x, [(view, frames), (view, begun)]))
    back = torch.tensor(order).argsort()
    whole, early = (_together(each, back) for each in zip(*parts, strict=True))
    return whole, early


def in_parts(
    x: Float[Tensor, "sequence time channel"], asked: Sequence[tuple[Sight, int]]
) -> list[Sums]:
    """What the first frames of movements say at timings of one tempo, some movements at a time."""
    found = []
    for part in x.split(max(1, COLUMNS // x.shape[2])):
        errors = asked[0][0].errors(part)
        found.append([view.sums(errors, len(part), frames) for view, frames in asked])
    return [_joined(each) for each in zip(*found, strict=True)]


def squares(
    errors: Float[Tensor, "*ratio pattern time column"], count: int
) -> Float[Tensor, "*ratio sequence channel"]:
    """‖L⁻¹x‖² of every movement and channel."""
    size = torch.linalg.vector_norm(errors, dim=-2, keepdim=True)
    return _rows(size, count)[..., 0].square()


def of_weights(sums: Sums, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Precision and linear term of w, given the anchors."""
    cross = sums.precision[..., 3:, :3] @ starts[..., None]
    return sums.precision[..., 3:, 3:], sums.linear[..., 3:] - cross[..., 0]


def square_after(sums: Sums, θ: Tensor) -> Tensor:
    """‖whitened x − R θ‖² of the leading parameters θ."""
    count = θ.shape[-1]
    curve = (θ * (sums.precision[..., :count, :count] @ θ[..., None])[..., 0]).sum(-1)
    return (sums.square - 2 * (θ * sums.linear[..., :count]).sum(-1) + curve).clamp_min(0)


def _groups(movements: Movements, timings: Sequence[Timing]) -> list[list[int]]:
    """Movements of one timing with the same entries observed."""
    found: dict[tuple[Timing, bytes], list[int]] = {}
    for i, ((_, seen), timing) in enumerate(zip(movements, timings, strict=True)):
        found.setdefault((timing, seen.numpy().tobytes()), []).append(i)
    return list(found.values())


def _joined(parts: Sequence[Sums]) -> Sums:
    """Movements observed alike, one after the other."""
    precision, *rest = zip(*(p.parts for p in parts), strict=True)
    return Sums(precision[0], *(torch.cat(r, a) for r, a in zip(rest, SEQUENCE[1:], strict=True)))


def _together(parts: Sequence[Sums], order: Tensor) -> Sums:
    """Movements observed in several ways, in ``order``."""
    if len(parts) == 1:
        return parts[0]
    channels = max(p.precision.shape[-3] for p in parts)
    wide = [_full(p, p.linear.shape[-3], channels) for p in parts]
    rows = zip(*wide, strict=True)
    return Sums(
        *(torch.cat(r, a).index_select(a, order) for r, a in zip(rows, SEQUENCE, strict=True))
    )


def _full(sums: Sums, sequences: int, channels: int) -> list[Tensor]:
    """All parts with their sequence axis, and all but ``linear`` and ``square`` of ``channels``."""
    found = []
    for part, axis, channel in zip(sums.parts, SEQUENCE, CHANNEL, strict=True):
        wide = _expanded(part, axis, sequences)
        found.append(_expanded(wide, channel, max(channels, wide.shape[channel])))
    return found


def _expanded(part: Tensor, axis: int, size: int) -> Tensor:
    shape = list(part.shape)
    shape[axis] = size
    return part.expand(shape)


def _columns(x: Tensor, alike: bool) -> Float[Tensor, "pattern time column"]:
    """Movements and channels as columns; channels as patterns where they are not observed alike."""
    columns: Tensor = x.transpose(0, 1).flatten(1)[None] if alike else x.permute(2, 1, 0)
    return columns


def _rows(columns: Tensor, count: int) -> Float[Tensor, "*ratio sequence channel row"]:
    if columns.shape[-3] > 1:
        return columns.movedim(-1, -3)
    rows: Tensor = columns.squeeze(-3).unflatten(-1, (count, -1)).movedim(-3, -1)
    return rows
