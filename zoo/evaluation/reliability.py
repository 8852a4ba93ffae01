"""Whether probabilities come true: PIT values and observed against nominal frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.evaluation.answers import Answer, Estimate, estimate, group_sums

__all__ = ["LEVELS", "Reliability"]

LEVELS = (0.5, 0.8, 0.9, 0.95)
_GRID = torch.arange(1, 100, dtype=torch.float64) / 100


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """PIT values F(y) of the known entries, and how often central intervals held the truth.

    ``observed`` belongs to the ``nominal`` central levels 1 %, …, 99 %; ``error`` is its standard
    error over groups, None with one group. ``calibration_error`` is the mean of
    |share of PIT values ≤ p − p| over p = 1 %, …, 99 %, so that bias counts too.
    """

    nominal: Float[Tensor, " level"]
    observed: Float[Tensor, " level"]
    error: Float[Tensor, " level"] | None
    pit: Float[Tensor, " n"]
    calibration_error: Estimate
    groups: int

    @classmethod
    def of(cls, answer: Answer) -> Self:
        """Reliability of a prediction that has a standard deviation."""
        pit = answer.prediction.cdf(answer.truth).double()
        inside = (2 * pit - 1).abs()[..., None] <= _GRID.to(pit)
        below = pit[..., None] <= _GRID.to(pit)
        counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)[:, None]
        counts, held = counts[counts[:, 0] > 0], _counted(inside, answer)
        shares = held.sum(0) / counts.sum()
        return cls(
            nominal=_GRID,
            observed=shares,
            error=_standard_error(held, counts, shares) if len(counts) > 1 else None,
            pit=pit[answer.mask],
            calibration_error=_calibration_error(_counted(below, answer), counts),
            groups=len(counts),
        )


def _counted(events: Tensor, answer: Answer) -> Float[Tensor, "group level"]:
    """Number of known entries of every group that has any for which an event is true."""
    known = (events & answer.mask[..., None]).flatten(1, -2).sum(1)
    present = group_sums(answer.mask.flatten(1).sum(1), answer.cluster) > 0
    return group_sums(known, answer.cluster)[present]


def _standard_error(held: Tensor, counts: Tensor, shares: Tensor) -> Tensor:
    """Linearised standard error of a ratio of group sums."""
    groups = len(counts)
    deviation = (held - shares * counts).square().sum(0)
    return (deviation * groups / (groups - 1)).sqrt() / counts.sum()


def _calibration_error(below: Tensor, counts: Tensor) -> Estimate:
    def statistic(sums: Tensor) -> Tensor:
        return (sums[..., 1:] / sums[..., :1] - _GRID.to(sums)).abs().mean(-1)

    found = estimate(torch.cat([counts, below], 1), statistic)
    if found is None:
        raise ValueError("no PIT values")
    return found
