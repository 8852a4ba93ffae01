"""What of every channel the other channels cannot tell of held-out movements."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zoo.movement.cross_validation import held_out_errors

__all__ = ["blocks", "unshared"]

BLOCKS = 5
RIDGES = (0.01, 0.1, 1.0, 10.0)
LEAST = 0.02


def blocks(channels: int) -> Int[Tensor, " channel"]:
    """Neighbouring channels that are held out together.

    >>> blocks(7).tolist()
    [0, 0, 1, 2, 2, 3, 4]
    """
    return torch.arange(channels) * min(BLOCKS, channels) // channels


def unshared(
    parameters: Float[Tensor, "sequence channel parameter"],
) -> Float[Tensor, " channel"]:
    """Square error of a ridge on the other blocks' channels, over that of the mean movement.

    Errors are those of each movement under the others, in closed form; the ridge has the least of
    them. The share stays within 0.02 and 0.98: the error over few movements is itself uncertain.
    """
    count, channels, _ = parameters.shape
    deviation = parameters - parameters.mean(0)
    size = deviation.square().sum((0, 2)).clamp_min(torch.finfo(parameters.dtype).tiny)
    scaled, block = deviation / size.sqrt()[:, None], blocks(channels)
    found = []
    for b in block.unique():
        others, own = scaled[:, block != b].flatten(1), scaled[:, block == b].flatten(1)
        kernel = others @ others.mT * (count / max(1, int((block != b).sum())))
        values, vectors = torch.linalg.eigh(kernel)
        rest = [(vectors * (r / (values + r))) @ vectors.mT - 1 / count for r in RIDGES]
        errors = [held_out_errors(m, own, torch.arange(count)).square().sum(0) for m in rest]
        found.append(torch.stack(errors).unflatten(1, (int((block == b).sum()), -1)).sum(2))
    each = torch.cat(found, dim=1) * ((count - 1) / count) ** 2
    return each[each.sum(1).argmin()].clamp(LEAST, 1 - LEAST)
