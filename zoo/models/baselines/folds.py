"""Which training movements are held out together, and where their forecasts begin."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

__all__ = ["folds_of", "places", "starts"]

FOLDS = 4


def folds_of(group: Int[Tensor, " sequence"]) -> Int[Tensor, " sequence"]:
    """At most four folds, whole groups in turn.

    >>> import torch
    >>> folds_of(torch.tensor([7, 7, 2, 5, 9, 1])).tolist()
    [0, 0, 1, 2, 3, 0]
    """
    order = list(dict.fromkeys(group.tolist()))
    return group.new_tensor([order.index(g) % FOLDS for g in group.tolist()])


def starts(frames: int) -> list[int]:
    """Numbers of observed frames, few and many, after which forecasts are compared.

    >>> starts(300), starts(4)
    ([3, 75, 150, 225], [1, 2, 3])
    """
    return sorted({min(3, frames // 2), frames // 4, frames // 2, 3 * frames // 4} - {0})


def places(first: int, last: int, count: int) -> list[int]:
    """Numbers evenly spaced between two.

    >>> places(0, 9, 4)
    [0, 3, 6, 9]
    """
    return sorted({round(first + i * (last - first) / max(count - 1, 1)) for i in range(count)})
