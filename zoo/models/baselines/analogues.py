"""Comparing movements entry by entry: the pure functions behind nearest neighbours."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = [
    "alignment_cost",
    "carried",
    "error_sums",
    "interpolated",
    "sums_of_squares",
]


def alignment_cost(
    x: Float[Tensor, "time channel"],
    m: Bool[Tensor, "time channel"],
    memory: Float[Tensor, "movement frame channel"],
    seen: Bool[Tensor, "movement frame channel"],
    lengths: Int[Tensor, " movement"],
    weight: Float[Tensor, "time time"],
) -> Float[Tensor, "time movement shift"]:
    """Weighted mean squared difference of ``x``, shifted onto every movement of ``memory``.

    Shift s lays frame t of ``x`` on frame t + s − (time − 1); where that is outside the movement
    the cost is infinite. ``weight[t]`` says how much every frame counts for frame t. Frames that
    find no partner count as two random frames would: twice the variance.
    """
    frames, (movements, longest, _) = len(x), memory.shape
    y, n = (memory * seen).flatten(0, 1), seen.flatten(0, 1).to(x)
    square, both = sums_of_squares(x * m, m.to(x), y, n)
    time = torch.arange(frames, device=x.device)[:, None]
    partner = torch.arange(frames + longest - 1, device=x.device) - (frames - 1) + time
    outside = ((partner < 0) | (partner >= lengths[:, None, None])).transpose(0, 1)
    index = partner.clamp(0, longest - 1)[:, None].expand(-1, movements, -1)
    square, both = (
        v.unflatten(1, (movements, longest)).gather(2, index) * ~outside for v in (square, both)
    )
    full = (weight @ m.sum(1).to(x))[:, None, None].clamp(min=torch.finfo(x.dtype).tiny)
    square, both = (torch.einsum("tu,uns->tns", weight, v) for v in (square, both))
    cost = (square + 2 * _variance(y, n) * (full - both)) / full
    return cost.masked_fill(outside, torch.inf)


def _variance(y: Float[Tensor, "row channel"], n: Float[Tensor, "row channel"]) -> Tensor:
    """Variance of the entries observed, averaged over channels."""
    count = n.sum(0).clamp(min=1)
    mean = y.sum(0) / count
    return (((y - mean) * n).square().sum(0) / count).mean()


def error_sums(error: Tensor, near: Tensor, asked: Tensor) -> Float[Tensor, "3 *rest"]:
    """Sums over the first axis of squared error, neighbours' variance and their number."""
    variance = near.var(0, unbiased=False)
    return (torch.stack([error.square(), variance, torch.ones_like(error)]) * asked).sum(1)


def sums_of_squares(x: Tensor, m: Tensor, y: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """Squared difference of rows of x and of y over entries observed in both, and their number."""
    square = x.square() @ n.T + m @ y.square().T - 2 * x @ y.T
    return square.clamp(min=0), m @ n.T


def carried(
    rows: Float[Tensor, "lead channel"], known: Bool[Tensor, "lead channel"]
) -> Float[Tensor, "lead channel"]:
    """Unknown rows take the last known one before them."""
    lead = torch.arange(len(rows), device=rows.device)[:, None]
    return rows.gather(0, torch.where(known, lead, 0).cummax(0).values)


def interpolated(values: Tensor, seen: Tensor, mean: Tensor) -> Tensor:
    """Missing entries linear in time between those seen, held at the ends, ``mean`` if none is."""
    frames = values.shape[1]
    time = torch.arange(frames, device=values.device)[:, None].expand_as(values)
    before = torch.where(seen, time, -1).cummax(1).values
    after = torch.where(seen, time, frames).flip(1).cummin(1).values.flip(1)
    low = torch.where(before < 0, after, before).clamp(max=frames - 1)
    high = torch.where(after == frames, before, after).clamp(min=0)
    share = (time - low).to(values) / (high - low).clamp(min=1)
    filled = torch.lerp(values.gather(1, low), values.gather(1, high), share.clamp(0, 1))
    return torch.where((before < 0) & (after == frames), mean, filled)
