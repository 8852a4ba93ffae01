"""Scores of many groups in one pool where every group weighs the same, and tables of draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.evaluation.answers import Answer, group_sums
from zoo.prediction.prediction import Prediction

__all__ = ["LEVELS", "Pool", "look_up", "normal_level", "normal_score", "scores_of_draws"]

LEVELS = torch.arange(1, 100, dtype=torch.float64) / 100
_NODES = 33


@dataclass(frozen=True, kw_only=True)
class Pool:
    """Known scores in ascending order with the share of the weight that ends at each.

    ``independent`` is G_eff, the independent entries that give coverages as certain as these
    groups do: p (1 − p) over the squared standard error of the groups' coverages, both summed
    over p = 50 %, …, 90 %; between the number of groups and that of entries.
    """

    ordered: Float[Tensor, " n"]
    share: Float[Tensor, " n"]
    independent: float

    @classmethod
    def of(cls, scores: Float[Tensor, "sequence *rest"], answer: Answer) -> Self:
        """Pool the scores where ``answer`` has a known truth."""
        counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)
        weight = 1 / (answer.groups * counts[answer.cluster])
        weight = weight.view(-1, *[1] * (scores.ndim - 1)).expand_as(scores)
        ordered, place = scores[answer.mask].sort()
        share = weight[answer.mask][place].cumsum(0)
        independent = _independent(_quantile(ordered, share, LEVELS[49:90]), scores, answer)
        return cls(ordered=ordered, share=share, independent=independent)

    def quantile(self, levels: Float[Tensor, " level"]) -> Float[Tensor, " level"]:
        """Smallest score at which the share reaches each level."""
        return _quantile(self.ordered, self.share, levels)


def normal_score(levels: Tensor) -> Tensor:
    """Φ⁻¹."""
    scores: Tensor = torch.special.ndtri(levels)
    return scores


def normal_level(scores: Tensor) -> Tensor:
    """Φ."""
    levels: Tensor = torch.special.ndtr(scores)
    return levels


def scores_of_draws(raw: Prediction, draws: Tensor) -> Tensor:
    """Normal scores of many draws; of a mixture, read off 33 nodes between its extreme draws."""
    if raw.predictive.location.shape[0] == 1 or len(draws) <= _NODES:
        return raw.normal_score(draws)
    low, high = draws.amin(0), draws.amax(0)
    share = torch.linspace(0, 1, _NODES).to(draws).view(-1, *[1] * low.ndim)
    nodes = raw.normal_score(torch.lerp(low, high, share))
    return look_up(nodes, (draws - low) / (high - low).clamp(min=1e-30) * (_NODES - 1))


def look_up(table: Float[Tensor, "row *rest"], place: Float[Tensor, "sample *rest"]) -> Tensor:
    """Heights of a table at fractional rows; the end pieces are continued."""
    below = place.floor().clamp(0, len(table) - 2)
    low, high = table.gather(0, below.long()), table.gather(0, below.long() + 1)
    return torch.lerp(low, high, place - below)


def _quantile(ordered: Tensor, share: Tensor, levels: Tensor) -> Tensor:
    place = torch.searchsorted(share, levels.to(share) - 1e-9)
    return ordered[place.clamp(max=len(ordered) - 1)]


def _independent(thresholds: Tensor, scores: Tensor, answer: Answer) -> float:
    counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)
    present = counts > 0
    levels = LEVELS[49:90].to(scores)
    variance = torch.zeros_like(levels)
    for i, threshold in enumerate(thresholds):
        inside = ((scores <= threshold) & answer.mask).flatten(1).sum(1)
        coverage = group_sums(inside, answer.cluster)[present] / counts[present]
        variance[i] = coverage.var() / answer.groups
    found = (levels * (1 - levels)).sum() / variance.sum()
    return float(found.clamp(answer.groups, float(counts.sum())))
