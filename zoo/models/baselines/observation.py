"""What the baselines share: masked moments and the observed site."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool
from torch import Tensor

from zoo.models.baselines.ancestral import Ancestral, Law
from zoo.movement.demonstrations import seen_entries
from zoo.types import Batch

__all__ = ["moments", "normal", "observe", "observe_in_turn"]


def moments(values: Tensor, mask: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, standard deviation (n − 1) and count of the entries observed, over one axis.

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


def observe(batch: Batch, likelihood: dist.TorchDistribution) -> Tensor:
    """The observed site ``x``: the observed entries of every window under ``likelihood``."""
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
