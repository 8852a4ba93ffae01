"""Directions in which channels move together."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.inference.factors import closed_form, expectation_maximisation

__all__ = ["synergies_of"]


def synergies_of(
    values: Float[Tensor, "sequence time channel"],
    mask: Bool[Tensor, "sequence time channel"],
    count: int | None,
) -> tuple[Float[Tensor, "channel synergy"], Float[Tensor, " channel"]]:
    """Loading and mean of the principal components of all frames.

    Every channel stands alone where ``count`` is None or not below their number.

    >>> synergies, mean = synergies_of(torch.zeros(1, 5, 3), torch.ones(1, 5, 3).bool(), None)
    >>> synergies.shape, mean.shape
    (torch.Size([3, 3]), torch.Size([3]))
    """
    channels = values.shape[2]
    if count is None or count >= channels:
        return torch.eye(channels, dtype=values.dtype), values.new_zeros(channels)
    frames, seen = values[mask.any(-1)], mask[mask.any(-1)]
    if bool(seen.all()):
        found = closed_form(frames, count, 1e-4)
    else:
        found = expectation_maximisation(frames, seen, count, 1e-4, iterations=500, tolerance=1e-6)
    return found.loading, found.mean
