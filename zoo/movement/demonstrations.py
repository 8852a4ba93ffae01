"""Training movements: checked, grouped, and what of them was observed."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.datasets.records import Pairs, Sequences
from zoo.types import Batch

__all__ = ["extremes", "movement_groups", "movements_of", "seen_entries", "seen_movements"]


def movements_of(name: str, data: Sequences | Pairs, dtype: torch.dtype) -> Sequences:
    """Training movements with 0 where nothing was observed; a channel never observed is refused."""
    if not isinstance(data, Sequences):
        raise TypeError(f"{name} needs Sequences; got {type(data).__name__}")
    never = ~data.mask.any(1).any(0)
    if never.any():
        channel = data.channels[int(never.nonzero()[0])]
        raise ValueError(f"channel {channel} is missing in every frame; drop it")
    return replace(data, values=torch.where(data.mask, data.values, 0.0).to(dtype))


def movement_groups(data: Sequences) -> Int[Tensor, " sequence"]:
    """Number of the movement that every row was cut from: windows differ in ``start`` alone.

    Without groups every row is a movement of its own.
    """
    names = [k for k in data.groups if k != "start"]
    if not names:
        return torch.arange(len(data), device=data.lengths.device)
    numbers: dict[tuple[object, ...], int] = {}
    rows = zip(*(data.groups[name] for name in names), strict=True)
    found = [numbers.setdefault(row, len(numbers)) for row in rows]
    return data.lengths.new_tensor(found)


def seen_entries(batch: Batch) -> Bool[Tensor, "window *time channel"]:
    """The mask of a batch, spelled out where it is complete."""
    if batch.mask is not None:
        return batch.mask
    return torch.ones_like(batch.values, dtype=torch.bool)


def seen_movements(batch: Batch) -> Bool[Tensor, "sequence frame channel"]:
    """The mask of the whole movements of a batch, spelled out where these are complete."""
    if batch.movement_mask is not None:
        return batch.movement_mask
    return torch.ones_like(batch.movements, dtype=torch.bool)


def extremes(
    values: Float[Tensor, "sequence time channel"], mask: Bool[Tensor, "sequence time channel"]
) -> Float[Tensor, "2 channel"]:
    """Least and greatest observed value of every channel.

    >>> extremes(torch.tensor([[[1.0], [5.0], [2.0]]]), torch.tensor([[[True], [False], [True]]]))
    tensor([[1.],
            [2.]])
    """
    flat, seen = values.flatten(0, 1), mask.flatten(0, 1)
    if bool(seen.all()):
        return torch.stack([flat.amin(0), flat.amax(0)])
    low = flat.masked_fill(~seen, torch.inf).amin(0)
    high = flat.masked_fill(~seen, -torch.inf).amax(0)
    return torch.stack([low, high])
