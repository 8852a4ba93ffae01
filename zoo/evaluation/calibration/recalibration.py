"""Recalibration of predictive standard deviations on held-out groups.

What is exchangeable between calibration and use is a whole group (a movement), never a frame. Few
groups have to do, so the factors of channels and lead times are shrunk (:class:`Stretch`), every
group weighs the same, and scores that set a level come from groups left out of the factors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, ClassVar, Protocol, Self

import torch
from torch import Tensor

from zoo.errors import UnknownNameError
from zoo.evaluation.answers import Answer, Groups
from zoo.evaluation.calibration.curve import Curve
from zoo.evaluation.calibration.pool import (
    LEVELS,
    Pool,
    look_up,
    normal_level,
    normal_score,
    scores_of_draws,
)
from zoo.evaluation.calibration.promise import warn_of_few
from zoo.evaluation.calibration.stretch import By, Stretch, crossed, standardised
from zoo.prediction.prediction import Prediction, Recalibration
from zoo.prediction.predictive import Predictive

__all__ = [
    "RECALIBRATIONS",
    "Conformal",
    "Isotonic",
    "Scale",
    "recalibrate",
    "recalibration_from_state",
]


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
        sizes = standardised(answer).square()
        return cls(stretch=Stretch.fit(sizes, answer, by, 2), groups=answer.groups)

    def predictive(self, raw: Prediction) -> Predictive:
        """The stretched mixture."""
        return _stretched(raw.predictive, self.stretch.of(raw))

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the stretched mixture."""
        return raw.mean + self.stretch.of(raw) * (raw.quantile(level) - raw.mean)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Distribution function of the stretched mixture."""
        return raw.cdf(raw.mean + (value - raw.mean) / self.stretch.of(raw))

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws stretched about the mean."""
        return raw.mean + self.stretch.of(raw) * (draws - raw.mean)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        return {"kind": self.kind, "groups": self.groups}, self.stretch.state()

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(stretch=Stretch.from_state(tensors), groups=int(meta["groups"]))


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
        sizes = standardised(answer).abs()
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
        factors = crossed(standardised(answer).square(), answer, by, 2).to(raw.mean)
        reduced = raw.mean + (answer.truth - raw.mean) / factors
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


class _Kind(Protocol):
    def fit(self, answer: Answer, by: tuple[By, ...]) -> Recalibration: ...

    def from_state(self, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Recalibration: ...


RECALIBRATIONS: dict[str, _Kind] = {k.kind: k for k in (Conformal, Isotonic, Scale)}


def recalibrate(
    kind: str,
    prediction: Prediction,
    truth: Tensor,
    mask: Tensor | None = None,
    groups: Groups | None = None,
    *,
    by: tuple[By, ...] = ("channel", "time"),
) -> Recalibration:
    """A correction of ``prediction``'s bands, to be used on predictions of the same kind.

    ``kind`` is ``conformal``, ``isotonic`` or ``scale``; ``by`` says which factors are fitted
    beside the common one. Groups are those of :func:`~zoo.evaluation.answers.clusters`. Of too few
    for a conformal 90 % band with a guarantee (see
    :func:`~zoo.evaluation.calibration.promise.promised`) a :class:`~zoo.errors.FewGroupsWarning`
    says what they can promise and what the bands became.

    >>> import torch
    >>> raw = Prediction(
    ...     predictive=Predictive(location=torch.zeros(1, 400, 1), noise=torch.ones(1)),
    ...     axes=("item", "target"), names=("f_z",), units=("N",), task="regress")
    >>> truth = 3 * torch.randn(400, 1, generator=torch.Generator().manual_seed(0))
    >>> mended = raw.recalibrated(recalibrate("scale", raw, truth))
    >>> bool(2.7 < mended.std[0, 0] < 3.3)
    True
    """
    answer = Answer.of(prediction.raw, truth, mask, groups)
    if answer.groups < 2:
        raise ValueError("recalibration needs at least 2 groups (movements or items); got 1")
    found = _kind(kind).fit(answer, by)
    if isinstance(found, Conformal):
        warn_of_few(answer, found, found.worth, found.reach)
    return found


def recalibration_from_state(meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Recalibration:
    """The recalibration that ``state()`` gave JSON and tensors of."""
    return _kind(meta["kind"]).from_state(meta, tensors)


def _kind(name: str) -> _Kind:
    if name not in RECALIBRATIONS:
        raise UnknownNameError(f"no recalibration {name!r}; there are {', '.join(RECALIBRATIONS)}")
    return RECALIBRATIONS[name]


def _stretched(p: Predictive, factor: Tensor) -> Predictive:
    mean = p.location.mean(0)
    return replace(
        p,
        location=mean + factor * (p.location - mean),
        noise=None if p.noise is None else p.noise * factor,
        epistemic=None if p.epistemic is None else p.epistemic * factor,
        draws=None if p.draws is None else mean + factor * (p.draws - mean),
    )
