"""Parts of a prediction: which rows, which draws of paths, and their noise."""

from __future__ import annotations

import torch
from torch import Tensor

from zoo.prediction.predictive import Predictive

__all__ = ["marginals", "picks", "rows_among", "tensor_of", "with_noise"]


def tensor_of(value: object, what: str) -> Tensor:
    """Numbers as a tensor; what holds none is refused by name."""
    try:
        found = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        found = None
    if found is None or found.is_complex():
        raise TypeError(f"{what} must be a tensor of numbers; got {type(value).__name__}")
    return found


def rows_among(index: object, count: int, what: str) -> Tensor:
    """Numbers of rows, from a truth value for each of ``count`` or from their numbers."""
    found = tensor_of(index, f"the index of {what}")
    if found.dtype == torch.bool and found.shape == (count,):
        return found.nonzero()[:, 0]
    if found.ndim != 1 or found.dtype == torch.bool or found.is_floating_point():
        raise TypeError(
            f"{what} are chosen by a list of numbers or by {count} truth values; got {index!r}"
        )
    if len(found) and not (-count <= int(found.min()) and int(found.max()) < count):
        raise IndexError(f"there are {count} {what}; got {found.tolist()}")
    return found.long()


def picks(count: int, paths: Tensor, generator: torch.Generator) -> Tensor:
    """``count`` rows of ``paths``, none twice before each was drawn once."""
    total = paths.shape[0]
    rounds = [
        torch.randperm(total, generator=generator, device=paths.device)
        for _ in range(-(-count // total))
    ]
    return torch.cat(rounds)[:count]


def with_noise(path: Tensor, noise: Tensor | None, generator: torch.Generator) -> Tensor:
    """``path`` with white noise of that standard deviation, if any."""
    if noise is None:
        return path
    return path + noise * torch.randn(
        path.shape, generator=generator, dtype=path.dtype, device=path.device
    )


def marginals(p: Predictive, count: int, generator: torch.Generator) -> Tensor:
    """Draws of every entry by itself."""
    like = p.location
    shape = (count, *like.shape[1:])
    pick = torch.randint(like.shape[0], shape, generator=generator, device=like.device)
    scale = p.spread
    noise = None if scale is None else scale.expand_as(like).gather(0, pick)
    return with_noise(like.gather(0, pick), noise, generator)
