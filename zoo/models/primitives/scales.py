"""Student's t as an equal mixture of Gaussians: evenly ranked values of its random scale."""

from __future__ import annotations

import torch
from jaxtyping import Float
from scipy.special import gammaincinv
from torch import Tensor

__all__ = ["student_scales"]

GAUSSIAN = 100


def student_scales(degrees: float, count: int) -> Float[Tensor, " count"]:
    """s of ``count`` equally likely components s N(0, Σ), together a t of ν ``degrees`` of freedom.

    s² = ν/χ²_ν at evenly ranked levels; above 100 degrees one component stands for all.

    >>> student_scales(3, 4).mul(100).round().tolist()
    [72.0, 98.0, 131.0, 208.0]
    >>> student_scales(1000, 4).tolist()
    [1.0]
    """
    if degrees > GAUSSIAN:
        return torch.ones(1, dtype=torch.float64)
    levels = 1 - (torch.arange(count, dtype=torch.float64) + 0.5) / count
    half = torch.as_tensor(gammaincinv(degrees / 2, levels.numpy()), dtype=torch.float64)
    return (degrees / 2 / half).sqrt()
