"""What the baselines share: checked training data, masked moments, the observed site."""

from __future__ import annotations

from dataclasses import replace

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from zoo.datasets.records import Pairs, Sequences
from zoo.dynamics.ancestral import Ancestral, Law
from zoo.errors import NotFittedError
from zoo.types import Batch

__all__ = [
    "check_fitted",
    "moments",
    "movement_groups",
    "movements_of",
    "normal",
    "observe",
    "observe_in_turn",
    "seen_entries",
    "seen_movements",
]


def movements_of(name: str, data: Sequences | Pairs, dtype: torch.dtype) -> Sequences:
    """Training movements with 0 where nothing was seen; a channel never seen is refused by name."""
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


def moments(values: Tensor, mask: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, standard deviation (n − 1) and count of the entries seen, over one axis.

    >>> x = torch.tensor([[1.0, 3.0], [3.0, 0.0]])
    >>> mean, deviation, count = moments(x, torch.tensor([[True, True], [True, False]]), 0)
    >>> mean.tolist(), count.tolist()
    ([2.0, 3.0], [2.0, 1.0])
    """
    count = mask.sum(dim).to(values)
    mean = (values * mask).sum(dim) / count.clamp(min=1)
    residual = (values - mean.unsqueeze(dim)) * mask
    variance = residual.square().sum(dim) / (count - 1).clamp(min=1)
    return mean, variance.sqrt(), count


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


def observe(batch: Batch, likelihood: dist.TorchDistribution) -> Tensor:
    """The observed site ``x``: the seen entries of every window under ``likelihood``."""
    with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
        site = likelihood.mask(seen_entries(batch)).to_event(2)
        x: Tensor = pyro.sample("x", site, obs=batch.given(batch.values))
    return x


def normal(
    mean: Tensor, deviation: Tensor, observed: Bool[Tensor, "movement frame channel"]
) -> dist.TorchDistribution:
    """Independent entries of frames, those that are missing left out of the density."""
    frames: dist.TorchDistribution = dist.Normal(mean, deviation).mask(observed).to_event(1)
    return frames


def observe_in_turn(batch: Batch, law: Law) -> Tensor:
    """The observed site ``x`` of movements whose every frame depends on those before it."""
    with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
        site = Ancestral(law, seen_entries(batch), batch.values.new_empty(0))
        x: Tensor = pyro.sample("x", site, obs=batch.given(batch.values))
    return x


def check_fitted(name: str, buffer: Tensor) -> None:
    """Raise a NotFittedError while ``buffer`` is still the empty placeholder."""
    if buffer.numel() == 0:
        raise NotFittedError(f"{name} has seen no data yet; call zoo.fit or condition first")
