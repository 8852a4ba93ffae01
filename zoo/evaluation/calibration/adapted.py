"""Spreads that follow the errors which a model made in the frames observed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.evaluation.questions import Question, Setup, ask
from zoo.prediction.prediction import Prediction, Recalibration
from zoo.prediction.predictive import Predictive

__all__ = ["Adapted", "difficulty", "rehearsal"]

FRAMES = 4
LEAST = 1e-3


def rehearsal(data: Sequences) -> Question | None:
    """The forecast of the second half of what was observed from its first; None of few frames.

    Nothing that is to be forecast is in it.

    >>> import numpy as np
    >>> data = Sequences.from_arrays(np.zeros((2, 21, 3)), rate=30.0)
    >>> question = rehearsal(data)
    >>> question.given.values.shape[1], question.horizon
    (10, 11)
    """
    shortest = int(data.lengths.min())
    if shortest < FRAMES:
        return None
    half = shortest // 2
    return ask("forecast", data, Setup(seen=half, horizon=shortest - half))


def difficulty(prediction: Prediction, truth: Tensor, mask: Tensor) -> Float[Tensor, " sequence"]:
    r"""Mean of \|y − μ\| / σ over all known entries of each movement.

    An absolute error, not its square: what people do otherwise is concentrated on few joints, and
    a root mean square would widen all bands by these.
    """
    σ = prediction.raw.std
    size = (truth.to(σ) - prediction.raw.mean).abs() / σ.clamp(min=torch.finfo(σ.dtype).tiny)
    known = mask.to(size.device) & size.isfinite()
    total = torch.where(known, size, 0.0).flatten(1).sum(1)
    return (total / known.flatten(1).sum(1).clamp(min=1)).clamp(min=LEAST)


@dataclass(frozen=True, kw_only=True, eq=False)
class Adapted:
    """A correction of spreads that were stretched before, each movement's by its own factor.

    Normalised conformal prediction with the difficulty of a new movement estimated from what was
    observed of it: Papadopoulos, Vovk & Gammerman, *Regression conformal prediction with nearest
    neighbours*, JAIR 40 (2011).
    """

    correction: Recalibration
    factor: Float[Tensor, " sequence"]

    def widened(self, raw: Prediction) -> Prediction:
        """The raw prediction with its spread stretched."""
        factor = self.factor.view(-1, *[1] * (len(raw.shape) - 1))
        like = raw.predictive.location
        return replace(raw, predictive=raw.predictive.stretched(factor.to(like)))

    def predictive(self, raw: Prediction) -> Predictive | None:
        """The corrected mixture, where it is one."""
        return self.correction.predictive(self.widened(raw))

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the corrected distribution."""
        return self.correction.quantile(self.widened(raw), level)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Distribution function of the corrected distribution."""
        return self.correction.cdf(self.widened(raw), value)

    def rows(self, index: slice | Tensor) -> Adapted:
        """The correction of some movements."""
        return Adapted(correction=self.correction.rows(index), factor=self.factor[index])

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws stretched, and then corrected."""
        factor = self.factor.to(draws).view(-1, *[1] * (len(raw.shape) - 1))
        return self.correction.transport(self.widened(raw), raw.mean + factor * (draws - raw.mean))
