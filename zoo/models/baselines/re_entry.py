"""Training movements continued from any frame, and entered again where one of them ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.baselines.analogues import sums_of_squares

__all__ = ["ALIGNMENTS", "Align", "Library", "Places", "dips"]

Align = Literal["none", "last", "mean", "fading"]
ALIGNMENTS: tuple[Align, ...] = ("none", "last", "mean", "fading")
JUMP_CONTEXT = 10


@dataclass(frozen=True)
class Places:
    """Frames of training movements."""

    movement: Int[Tensor, "*place"]
    frame: Int[Tensor, "*place"]


def dips(costs: Float[Tensor, "*query movement frame"], count: int) -> Places:
    """The ``count`` cheapest frames that are no dearer than both frames beside them.

    Where a query has fewer, they are taken in turn again; infinite costs are never taken.

    >>> found = dips(torch.tensor([[3.0, 1.0, 2.0, 0.0, 5.0]]), 3)
    >>> found.frame.tolist()
    [3, 1, 3]
    """
    beside = torch.nn.functional.pad(costs, (1, 1), value=torch.inf)
    slope = (costs > beside[..., :-2]) | (costs > beside[..., 2:])
    low = costs.masked_fill(slope, torch.inf).flatten(-2)
    order = low.topk(min(count, low.shape[-1]), largest=False)
    able = order.values.isfinite().sum(-1, keepdim=True)
    if not bool(able.all()):
        raise ValueError("no training movement is left that is long enough to compare with")
    turn = torch.arange(count, device=costs.device) % able
    index = order.indices.gather(-1, turn)
    return Places(index // costs.shape[-1], index % costs.shape[-1])


@dataclass(frozen=True)
class Library:
    """Training movements: ``values`` without gaps, ``seen`` says which entries were observed.

    ``allowed`` says which of them may be used.
    """

    values: Float[Tensor, "movement frame channel"]
    seen: Bool[Tensor, "movement frame channel"]
    lengths: Int[Tensor, " movement"]
    allowed: Bool[Tensor, " movement"]

    def costs(
        self,
        x: Float[Tensor, "query time channel"],
        mask: Bool[Tensor, "query time channel"],
        contexts: Sequence[int],
    ) -> Float[Tensor, "context query movement frame"]:
        """Mean squared differences of the last frames of ``x`` to the run that ends at a frame.

        Over entries observed in both; contexts longer than ``x`` are as long as ``x``. Infinite
        where a movement is too short or not allowed.
        """
        movements, frames = self.values.shape[:2]
        y, n = (self.values * self.seen).flatten(0, 1), self.seen.flatten(0, 1).to(x)
        square, both = x.new_zeros(2, len(x), movements, frames)
        found = {}
        for back in range(min(max(contexts), x.shape[1], frames)):
            known = mask[:, -1 - back].to(x)
            added = sums_of_squares(x[:, -1 - back] * known, known, y, n)
            for total, part in zip((square, both), added, strict=True):
                total[..., back:] += part.view(-1, movements, frames)[..., : frames - back]
            found[back + 1] = self._mean(square, both, back)
        return torch.stack([found[min(c, max(found))] for c in contexts])

    def jumps(self) -> Places:
        """For the end of every movement the place most like it that has a quarter to come."""
        steps = torch.arange(-JUMP_CONTEXT, 0, device=self.lengths.device)
        index = (self.lengths[:, None] + steps).clamp(min=0)
        row = torch.arange(len(self.lengths), device=index.device)[:, None]
        known = self.seen[row, index] & (self.lengths[:, None] + steps >= 0)[..., None]
        context = max(1, min(JUMP_CONTEXT, int(self.lengths.min()) // 2))
        costs = self.costs(self.values[row, index], known, [context])[0]
        time = torch.arange(costs.shape[-1], device=index.device)
        last = self.lengths - 1 - (self.lengths // 4).clamp(min=1)
        found = dips(costs.masked_fill(time > last[:, None], torch.inf), 1)
        return Places(found.movement[:, 0], found.frame[:, 0])

    def onward(self, start: Places, horizon: int, jumps: Places | None) -> Places:
        """The places after ``start``; without ``jumps`` the last frame of a movement is held."""
        movement, frame = start.movement, start.frame
        path = []
        for _ in range(horizon):
            over = frame + 1 >= self.lengths[movement]
            if jumps is None:
                frame = torch.where(over, frame, frame + 1)
            else:
                frame = torch.where(over, jumps.frame[movement], frame) + 1
                movement = torch.where(over, jumps.movement[movement], movement)
            path.append((movement, frame))
        after = (torch.stack(part, -1) for part in zip(*path, strict=True))
        return Places(*after)

    def at(self, path: Places) -> Float[Tensor, "place query time channel"]:
        """The frames of a path (query, place, time)."""
        return self.values[path.movement, path.frame].transpose(0, 1)

    def offset(
        self,
        x: Float[Tensor, "query time channel"],
        mask: Bool[Tensor, "query time channel"],
        start: Places,
        context: int,
        align: Align,
    ) -> Float[Tensor, "place query channel"]:
        """What ``x`` lies above the places: 0, or in the last frame, or on average over some."""
        known = min(context, x.shape[1]) if align == "mean" else int(align != "none")
        back = torch.arange(known, device=x.device)
        near = self.values[start.movement[..., None], (start.frame[..., None] - back).clamp(min=0)]
        here, seen = x[:, None, -1 - back], mask[:, None, -1 - back]
        return (((here - near) * seen).sum(2) / seen.sum(2).clamp(min=1)).transpose(0, 1)

    def fade(self, horizon: int, context: int, align: Align) -> Float[Tensor, "lead 1"]:
        """How much of the offset is left after each frame: exp(−h/``context``), or all."""
        lead = torch.arange(1, horizon + 1, dtype=self.values.dtype, device=self.values.device)
        return torch.exp(-lead / (context if align == "fading" else torch.inf))[:, None]

    def _mean(self, square: Tensor, both: Tensor, back: int) -> Tensor:
        time = torch.arange(square.shape[-1], device=square.device)
        inside = (time >= back) & (time < self.lengths[:, None]) & self.allowed[:, None]
        mean = torch.where(both > 0, square / both.clamp(min=1), torch.finfo(square.dtype).max)
        return mean.masked_fill(~inside, torch.inf)
