"""Where windows of equal length lie in movements of unequal length."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from zoo.arguments import whole_number

__all__ = ["cut"]


def cut(
    lengths: Int[Tensor, " sequence"], length: int, stride: int
) -> tuple[Int[Tensor, "window 1"], Int[Tensor, "window time"]]:
    """Movement and frames of every window of ``length`` frames, one every ``stride`` frames.

    >>> cut(torch.tensor([3, 4]), 3, 1)
    (tensor([[0],
            [1],
            [1]]), tensor([[0, 1, 2],
            [0, 1, 2],
            [1, 2, 3]]))
    """
    length, stride = whole_number(length, "length"), whole_number(stride, "stride")
    short = int(lengths.argmin())
    if int(lengths[short]) < length:
        raise ValueError(
            f"windows of {length} frames were asked for; sequence {short} has {int(lengths[short])}"
        )
    counts = (lengths - length) // stride + 1
    sequence = torch.repeat_interleave(torch.arange(len(lengths)), counts)
    first = torch.arange(len(sequence)) - (counts.cumsum(0) - counts)[sequence]
    return sequence[:, None], first[:, None] * stride + torch.arange(length)
