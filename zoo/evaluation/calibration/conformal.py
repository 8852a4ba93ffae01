"""Normalised split conformal intervals, of which whole groups are the unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from zoo.evaluation.answers import Answer
from zoo.evaluation.calibration.curve import Curve
from zoo.evaluation.calibration.odd import tempered
from zoo.evaluation.calibration.pool import (
    LEVELS,
    Pool,
    normal_level,
    normal_score,
    scores_of_draws,
)
from zoo.evaluation.calibration.stretch import By, Stretch, crossed, standardised
from zoo.prediction.prediction import Prediction

__all__ = ["Conformal"]


@dataclass(frozen=True, kw_only=True)
class Conformal:
    r"""Normalised split conformal intervals μ ± q(p) σ b_c d_t.

    The score is \|y − μ\| / (σ b_c d_t), with factors fitted without the score's own group. q(p)
    is the smallest score that a share p (1 + 1/G_eff) of the scores does not exceed, each group
    weighing the same. G_eff (``worth``) is what the groups are worth as independent entries
    (:class:`~zoo.evaluation.calibration.pool.Pool`). Where all entries of a group stand or fall
    together G_eff = G, the hierarchical conformal quantile with its guarantee for a new group; with
    one entry a group it is the usual split conformal quantile, (n + 1) p scores out of n. Between
    the two the guarantee is approximate. ``reach`` is the widest level that the groups support;
    beyond it q grows like a Gaussian's. The result is symmetric about the mean and has no density.
    """

    kind: ClassVar[str] = "conformal"
    stretch: Stretch
    thresholds: Curve
    groups: int
    worth: float
    reach: float

    @classmethod
    def fit(cls, answer: Answer, by: tuple[By, ...]) -> Self:
        """Factors from all groups, thresholds from scores of groups left out in turn."""
        sizes = tempered(standardised(answer), answer).abs()
        scores = sizes / crossed(sizes, answer, by, 1, common=False)
        pool = Pool.of(scores, answer)
        corrected = LEVELS * (1 + 1 / pool.independent)
        supported = corrected <= 1
        if not bool(supported.any()):
            raise ValueError(f"{answer.groups} groups are too few for any conformal interval")
        return cls(
            stretch=Stretch.fit(sizes, answer, by, 1, common=False),
            thresholds=Curve.through(
                normal_score((1 + LEVELS[supported]) / 2),
                pool.quantile(corrected[supported]),
                from_zero=True,
            ),
            groups=answer.groups,
            worth=pool.independent,
            reach=float(LEVELS[supported][-1]),
        )

    def predictive(self, raw: Prediction) -> None:
        """No mixture: only the quantiles are known."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Mean plus the threshold of that level times the corrected standard deviation."""
        score = torch.tensor(NormalDist().inv_cdf(level), dtype=torch.float64)
        threshold = self.thresholds(score.abs()) * score.sign()
        return raw.mean + threshold.to(raw.mean) * self._spread(raw)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Level of the quantile that ``value`` is."""
        reduced = ((value - raw.mean) / self._spread(raw)).double()
        score = self.thresholds.inverse(reduced.abs()) * reduced.sign()
        return normal_level(score).to(value)

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Each draw moved to the corrected quantile of its own raw level."""
        score = scores_of_draws(raw, draws).double()
        threshold = (self.thresholds(score.abs()) * score.sign()).to(draws)
        return raw.mean + threshold * self._spread(raw)

    def rows(self, index: slice | Tensor) -> Self:
        """The correction of some movements, which is that of all."""
        return self

    def blend(self, other: Conformal, share: float) -> Conformal:
        """Between this correction and another, at a share of the way."""
        return Conformal(
            stretch=self.stretch.blend(other.stretch, share),
            thresholds=self.thresholds.blend(other.thresholds, share),
            groups=min(self.groups, other.groups),
            worth=min(self.worth, other.worth),
            reach=min(self.reach, other.reach),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        meta = {"groups": self.groups, "worth": self.worth, "reach": self.reach}
        return {"kind": self.kind, **meta}, {**self.stretch.state(), **self.thresholds.state()}

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(
            stretch=Stretch.from_state(tensors),
            thresholds=Curve.from_state(tensors),
            groups=int(meta["groups"]),
            worth=float(meta["worth"]),
            reach=float(meta["reach"]),
        )

    def _spread(self, raw: Prediction) -> Tensor:
        spread = raw.std * self.stretch.of(raw)
        return spread.clamp(min=torch.finfo(spread.dtype).tiny)
