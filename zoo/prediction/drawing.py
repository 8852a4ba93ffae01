"""Draws of a prediction: which paths, and their noise."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["picks", "with_noise"]


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
