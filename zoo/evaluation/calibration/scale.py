"""A distribution stretched about its mean, by channel and lead time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from torch import Tensor

from zoo.evaluation.answers import Answer
from zoo.evaluation.calibration.odd import tempered
from zoo.evaluation.calibration.stretch import By, Stretch, standardised
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

__all__ = ["Scale"]


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The whole distribution stretched about its mean, σ̃ = σ a b_c d_t; it keeps its density.

    a² b_c² d_t² is the mean of z² = (y − μ)² / σ², which maximises a Gaussian's likelihood, with
    all groups weighing the same and b, d shrunk. Joint draws keep their dependence.
    """

    kind: ClassVar[str] = "scale"
    stretch: Stretch
    groups: int

    @classmethod
    def fit(cls, answer: Answer, by: tuple[By, ...]) -> Self:
        """Variance factors from the mean squared standardised residual."""
        sizes = tempered(standardised(answer), answer).square()
        return cls(stretch=Stretch.fit(sizes, answer, by, 2), groups=answer.groups)

    def predictive(self, raw: Prediction) -> Predictive:
        """The stretched mixture."""
        return raw.predictive.stretched(self.stretch.of(raw))

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the stretched mixture."""
        return raw.mean + self.stretch.of(raw) * (raw.quantile(level) - raw.mean)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Distribution function of the stretched mixture."""
        return raw.cdf(raw.mean + (value - raw.mean) / self.stretch.of(raw))

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws stretched about the mean."""
        return raw.mean + self.stretch.of(raw) * (draws - raw.mean)

    def rows(self, index: slice | Tensor) -> Self:
        """The correction of some movements, which is that of all."""
        return self

    def blend(self, other: Scale, share: float) -> Scale:
        """Between this correction and another, at a share of the way."""
        stretch = self.stretch.blend(other.stretch, share)
        return Scale(stretch=stretch, groups=min(self.groups, other.groups))

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        return {"kind": self.kind, "groups": self.groups}, self.stretch.state()

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(stretch=Stretch.from_state(tensors), groups=int(meta["groups"]))
