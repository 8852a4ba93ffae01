"""What bands fitted on few groups can promise, and the warning where that is less than 90 %."""

from __future__ import annotations

import math
import sys
import warnings

from torch import Tensor

from zoo.errors import FewGroupsWarning
from zoo.evaluation.answers import Answer
from zoo.prediction.prediction import Prediction, Recalibration

__all__ = ["caller", "promised", "warn_of_few"]

LEVEL = 0.9


def promised(level: float, groups: int) -> float:
    """Coverage that conformal bands of ``groups`` exchangeable groups can promise a new one.

    With n groups they take the ⌈(n + 1) level⌉-th smallest of n scores; where that is beyond n, no
    finite band has the level, and the widest, up to the largest score, has n / (n + 1). Vovk,
    Gammerman & Shafer, *Algorithmic learning in a random world*, 2005; for groups Lee, Barber &
    Willett, *Distribution-free inference with hierarchical data*, 2023.

    >>> promised(0.9, 9), promised(0.9, 3)
    (0.9, 0.75)
    """
    return level if rank(level, groups) <= groups else groups / (groups + 1)


def rank(level: float, groups: int) -> int:
    """⌈(n + 1) level⌉: which of n scores, in ascending order, is the band's half width.

    >>> rank(0.9, 9), rank(0.9, 3)
    (9, 4)
    """
    return math.ceil((groups + 1) * level - 1e-9)


def warn_of_few(
    answer: Answer, found: Recalibration, worth: float, reach: float, what: str
) -> None:
    """Warn where the groups cannot promise 90 %, and say what the band rests on instead.

    ``what`` was calibrated for; ``worth`` are the independent entries that the groups are counted
    as, ``reach`` the widest level that these support.
    """
    groups = answer.groups
    if promised(LEVEL, groups) >= LEVEL:
        return
    raw, mask = answer.prediction, answer.mask
    wider = _width(raw.recalibrated(found), mask) / _width(raw, mask)
    warnings.warn(
        f"{what}: conformal bands fitted on {groups} groups; the most that so few can promise "
        f"for a new group is {promised(LEVEL, groups):.0%}, since a {LEVEL:.0%} band with a "
        f"guarantee takes the score of rank {rank(LEVEL, groups)} and there are {groups}. The band "
        f"given counts the groups' entries as {worth:.1f} independent ones (enough for "
        f"{reach:.0%}, continued like a Gaussian's beyond) and is on average {wider:.2f} times as "
        "wide as the raw one; nothing is promised for it",
        FewGroupsWarning,
        stacklevel=caller(),
    )


def caller() -> int:
    """The ``stacklevel`` of the line that called the package."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).startswith("zoo."):
        level, frame = level + 1, frame.f_back
    return level


def _width(prediction: Prediction, mask: Tensor) -> float:
    low, high = prediction.interval(LEVEL)
    return float((high - low)[mask].double().mean())
