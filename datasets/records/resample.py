"""Movements on another time grid: equal lengths or another rate, without aliasing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.arguments import whole_number
from zoo.datasets.records.checks import stacked
from zoo.datasets.records.clock import checked_rate

__all__ = ["Grid", "resample", "resample_movements"]

_SMALL = 1e-9


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Movements on their new time grid; ``rate`` in Hz, of the mean duration where they differ."""

    values: Float[Tensor, "sequence time channel"]
    mask: Bool[Tensor, "sequence time channel"]
    lengths: Int[Tensor, " sequence"]
    controls: Float[Tensor, "sequence time control"] | None
    rate: float


class Movements(Protocol):
    """What is resampled: padded movements with their mask, lengths and rate."""

    @property
    def values(self) -> Tensor: ...
    @property
    def mask(self) -> Tensor: ...
    @property
    def lengths(self) -> Tensor: ...
    @property
    def controls(self) -> Tensor | None: ...
    @property
    def rate(self) -> float: ...


def resample_movements(data: Movements, frames: int | None, rate: float | None) -> Grid:
    """All movements with ``frames`` frames each, or at ``rate`` Hz; exactly one is given."""
    times = _times(data, frames, rate)
    lengths = data.lengths.tolist()
    new = [
        resample(v[:n], m[:n], at)
        for v, m, n, at in zip(data.values, data.mask, lengths, times, strict=True)
    ]
    known = None
    if data.controls is not None:
        whole = [
            torch.ones_like(c[:n], dtype=torch.bool)
            for c, n in zip(data.controls, lengths, strict=True)
        ]
        known = stacked(
            [
                resample(c[: len(m)], m, at)[0]
                for c, m, at in zip(data.controls, whole, times, strict=True)
            ]
        )
    intervals = sum(len(at) - 1 for at in times)
    spans = float(data.lengths.sum() - len(lengths))
    return Grid(
        values=stacked([v for v, _ in new]),
        mask=stacked([m for _, m in new]),
        lengths=torch.tensor([len(at) for at in times]),
        controls=known,
        rate=data.rate * intervals / spans if rate is None else rate,
    )


def _times(data: Movements, frames: int | None, rate: float | None) -> list[Tensor]:
    """New times of every movement, in its old frames."""
    if (frames is None) == (rate is None):
        raise ValueError("resampled needs either frames or rate (Hz), not both and not neither")
    last = (data.lengths - 1).tolist()
    if min(last) < 1:
        raise ValueError(f"sequence {last.index(min(last))} has 1 frame; 2 are needed to resample")
    if rate is not None:
        rate = checked_rate(rate)
        step = data.rate / rate
        return [torch.arange(int(n / step + _SMALL) + 1, dtype=torch.float64) * step for n in last]
    frames = whole_number(frames, "frames", 2)
    return [torch.linspace(0, n, frames, dtype=torch.float64) for n in last]


def resample(
    values: Float[Tensor, "time channel"],
    mask: Bool[Tensor, "time channel"],
    at: Float[Tensor, " new"],
) -> tuple[Float[Tensor, "new channel"], Bool[Tensor, "new channel"]]:
    r"""Local linear regression at the times ``at`` (in old frames) with a triangular kernel.

    The kernel is as wide as the coarser of the two grids: on a finer grid this is linear
    interpolation, on the same grid the identity, on a coarser one a low-pass filter that keeps
    what is linear in time exactly, at the ends and beside holes too. Missing entries weigh
    nothing; a new entry is missing where less than half of its kernel was observed.

    >>> ramp = torch.arange(9.0)[:, None]
    >>> resample(ramp, torch.ones(9, 1, dtype=torch.bool), torch.tensor([0.0, 4.25, 8.0]))[0]
    tensor([[0.0000],
            [4.2500],
            [8.0000]])
    """
    x, m = values.double(), mask.double()
    frames = torch.arange(len(x), dtype=x.dtype)
    step = max(1.0, float(at[1] - at[0])) if len(at) > 1 else 1.0
    d = frames - at.to(x)[:, None]
    w = (1 - d.abs() / step).clamp(min=0)
    s0, s1, s2 = w @ m, (w * d) @ m, (w * d * d) @ m
    y0, y1 = w @ (x * m), (w * d) @ (x * m)
    determinant = s0 * s2 - s1 * s1
    regular = determinant > _SMALL * step**2
    line = (s2 * y0 - s1 * y1) / torch.where(regular, determinant, 1.0)
    level = y0 / s0.clamp(min=_SMALL)
    seen = s0 >= 0.5 * w.sum(1, keepdim=True) - _SMALL
    resampled = torch.where(seen, torch.where(regular, line, level), 0.0)
    return resampled.to(values.dtype), seen
