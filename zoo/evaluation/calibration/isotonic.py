"""Levels mapped to the frequencies observed."""

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
    look_up,
    normal_level,
    normal_score,
    scores_of_draws,
)
from zoo.evaluation.calibration.scale import Scale
from zoo.evaluation.calibration.stretch import By, crossed, standardised
from zoo.prediction.prediction import Prediction

__all__ = ["Isotonic"]


@dataclass(frozen=True, kw_only=True)
class Isotonic:
    """The stretched distribution with its levels mapped to those observed, R(F(y)).

    R is the isotonic map from nominal to observed frequency of the PIT values, kept as a
    monotone curve between normal scores so that the tails stay usable; skew is corrected too.
    """

    kind: ClassVar[str] = "isotonic"
    scale: Scale
    levels: Curve
    groups: int

    @classmethod
    def fit(cls, answer: Answer, by: tuple[By, ...]) -> Self:
        """Weighted quantiles of the PIT values' normal scores, on groups left out of the scale."""
        raw = answer.prediction
        z = tempered(standardised(answer), answer)
        factors = crossed(z.square(), answer, by, 2)
        reduced = raw.mean + (z / factors).to(raw.mean) * raw.std
        scores = torch.where(answer.mask, raw.normal_score(reduced).double(), 0.0)
        pool = Pool.of(scores, answer)
        return cls(
            scale=Scale.fit(answer, by),
            levels=Curve.through(normal_score(LEVELS), pool.quantile(LEVELS)),
            groups=answer.groups,
        )

    def predictive(self, raw: Prediction) -> None:
        """No mixture: only the quantiles are known."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the stretched mixture at the level whose observed frequency it is."""
        score = torch.tensor(NormalDist().inv_cdf(level), dtype=torch.float64)
        return self.scale.transport(raw, raw.quantile_at(float(self.levels(score))))

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Observed frequency of the stretched mixture's level."""
        reduced = raw.mean + (value - raw.mean) / self.scale.stretch.of(raw)
        score = self.levels.inverse(raw.normal_score(reduced).double())
        return normal_level(score).to(value)

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Each draw moved to the corrected quantile of its own raw level."""
        score = self.levels(scores_of_draws(raw, draws).double()).to(draws)
        knots = torch.stack([raw.quantile_at(s / 2) for s in range(-8, 9)])
        return self.scale.transport(raw, look_up(knots, 2 * score + 8))

    def rows(self, index: slice | Tensor) -> Self:
        """The correction of some movements, which is that of all."""
        return self

    def blend(self, other: Isotonic, share: float) -> Isotonic:
        """Between this correction and another, at a share of the way."""
        return Isotonic(
            scale=self.scale.blend(other.scale, share),
            levels=self.levels.blend(other.levels, share),
            groups=min(self.groups, other.groups),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        meta, tensors = self.scale.state()
        return {**meta, "kind": self.kind}, {**tensors, **self.levels.state()}

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(
            scale=Scale.from_state(meta, tensors),
            levels=Curve.from_state(tensors),
            groups=int(meta["groups"]),
        )
