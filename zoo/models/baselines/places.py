"""Where forecasts of held-out movements begin."""

from __future__ import annotations

__all__ = ["places", "starts"]


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
