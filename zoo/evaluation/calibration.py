"""Recalibration of predictive spreads on groups that the model never saw.

What is exchangeable between calibration and use is a whole group (a movement), never a frame. Few
groups have to do, so the factors of channels and lead times are shrunk (:class:`Factors`), every
group weighs the same, and scores that set a level come from groups left out of the factors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, ClassVar, Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.errors import UnknownNameError
from zoo.evaluation.answers import Answer, Groups, group_sums
from zoo.evaluation.curve import Curve
from zoo.evaluation.factors import By, Factors, crossed, standardised
from zoo.prediction import Prediction, Predictive, Recalibration

__all__ = [
    "RECALIBRATIONS",
    "Conformal",
    "Isotonic",
    "Scale",
    "recalibrate",
    "recalibration_from_state",
]

_LEVELS = torch.arange(1, 100, dtype=torch.float64) / 100
_NODES = 33


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The whole distribution stretched about its mean, σ̃ = σ a b_c d_t; it keeps its density.

    a² b_c² d_t² is the mean of z² = (y − μ)² / σ², which maximises a Gaussian's likelihood, with
    all groups weighing the same and b, d shrunk. Joint draws keep their dependence.
    """

    kind: ClassVar[str] = "scale"
    factors: Factors
    groups: int

    @classmethod
    def fit(cls, answer: Answer, by: tuple[By, ...]) -> Self:
        """Variance factors from the mean squared standardised residual."""
        sizes = standardised(answer).square()
        return cls(factors=Factors.fit(sizes, answer, by, 2), groups=answer.groups)

    def predictive(self, raw: Prediction) -> Predictive:
        """The stretched mixture."""
        return _stretched(raw.predictive, self.factors.of(raw))

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the stretched mixture."""
        return raw.mean + self.factors.of(raw) * (raw.quantile(level) - raw.mean)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Distribution function of the stretched mixture."""
        return raw.cdf(raw.mean + (value - raw.mean) / self.factors.of(raw))

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Draws stretched about the mean."""
        return raw.mean + self.factors.of(raw) * (draws - raw.mean)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        return {"kind": self.kind, "groups": self.groups}, self.factors.state()

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(factors=Factors.from_state(tensors), groups=int(meta["groups"]))


@dataclass(frozen=True, kw_only=True)
class Conformal:
    r"""Normalised split conformal intervals μ ± q(p) σ b_c d_t.

    The score is \|y − μ\| / (σ b_c d_t), with factors fitted without the score's own group. q(p)
    is the smallest score that a share p (1 + 1/G_eff) of the scores does not exceed, each group
    weighing the same. G_eff (``worth``), between the number of groups G and that of entries,
    is what the groups are worth as independent entries: p (1 − p) over the squared standard error
    of the groups' coverages, both summed over p = 50 %, …, 90 %. Where all entries of a group
    stand or fall together G_eff = G, the hierarchical conformal quantile with its guarantee for a
    new group; with one entry a group it is the usual split conformal quantile, (n + 1) p scores
    out of n. Between the two the guarantee is approximate. ``reach`` is the widest level that the
    groups support; beyond it q grows like a Gaussian's. The result is symmetric about the mean
    and has no density.
    """

    kind: ClassVar[str] = "conformal"
    factors: Factors
    thresholds: Curve
    groups: int
    worth: float
    reach: float

    @classmethod
    def fit(cls, answer: Answer, by: tuple[By, ...]) -> Self:
        """Factors from all groups, thresholds from scores of groups left out in turn."""
        sizes = standardised(answer).abs()
        scores = sizes / crossed(sizes, answer, by, 1, common=False)
        pooled, weight = _weighted(scores, answer)
        worth = _worth(pooled, weight, scores, answer)
        corrected = _LEVELS * (1 + 1 / worth)
        supported = corrected <= 1
        if not bool(supported.any()):
            raise ValueError(f"{answer.groups} groups are too few for any conformal interval")
        return cls(
            factors=Factors.fit(sizes, answer, by, 1, common=False),
            thresholds=Curve.through(
                _score((1 + _LEVELS[supported]) / 2),
                _weighted_quantile(pooled, weight, corrected[supported]),
                from_zero=True,
            ),
            groups=answer.groups,
            worth=worth,
            reach=float(_LEVELS[supported][-1]),
        )

    def predictive(self, raw: Prediction) -> None:
        """No mixture: only the quantiles are known."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Mean plus the threshold of that level times the corrected spread."""
        score = torch.tensor(NormalDist().inv_cdf(level), dtype=torch.float64)
        threshold = self.thresholds(score.abs()) * score.sign()
        return raw.mean + threshold.to(raw.mean) * self._spread(raw)

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Level of the quantile that ``value`` is."""
        reduced = ((value - raw.mean) / self._spread(raw)).double()
        score = self.thresholds.inverse(reduced.abs()) * reduced.sign()
        return _level(score).to(value)

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Each draw moved to the corrected quantile of its own raw level."""
        score = _scores_of_draws(raw, draws).double()
        threshold = (self.thresholds(score.abs()) * score.sign()).to(draws)
        return raw.mean + threshold * self._spread(raw)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        meta = {"groups": self.groups, "worth": self.worth, "reach": self.reach}
        return {"kind": self.kind, **meta}, {**self.factors.state(), **self.thresholds.state()}

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(
            factors=Factors.from_state(tensors),
            thresholds=Curve.from_state(tensors),
            groups=int(meta["groups"]),
            worth=float(meta["worth"]),
            reach=float(meta["reach"]),
        )

    def _spread(self, raw: Prediction) -> Tensor:
        return raw.std * self.factors.of(raw)


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
        pooled, weight = _weighted(scores, answer)
        return cls(
            scale=Scale.fit(answer, by),
            levels=Curve.through(_score(_LEVELS), _weighted_quantile(pooled, weight, _LEVELS)),
            groups=answer.groups,
        )

    def predictive(self, raw: Prediction) -> None:
        """No mixture: only the quantiles are known."""

    def quantile(self, raw: Prediction, level: float) -> Tensor:
        """Quantile of the stretched mixture at the level that comes true that often."""
        score = torch.tensor(NormalDist().inv_cdf(level), dtype=torch.float64)
        return self.scale.transport(raw, raw.quantile_at(float(self.levels(score))))

    def cdf(self, raw: Prediction, value: Tensor) -> Tensor:
        """Observed frequency of the stretched mixture's level."""
        reduced = raw.mean + (value - raw.mean) / self.scale.factors.of(raw)
        score = self.levels.inverse(raw.normal_score(reduced).double())
        return _level(score).to(value)

    def transport(self, raw: Prediction, draws: Tensor) -> Tensor:
        """Each draw moved to the corrected quantile of its own raw level."""
        score = self.levels(_scores_of_draws(raw, draws).double()).to(draws)
        knots = torch.stack([raw.quantile_at(s / 2) for s in range(-8, 9)])
        return self.scale.transport(raw, _read(knots, 2 * score + 8))

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
    """A correction of ``prediction``'s spread, to be used on predictions of the same kind.

    ``kind`` is ``conformal``, ``isotonic`` or ``scale``; ``by`` says which factors are fitted
    beside the common one. Groups are those of :func:`~zoo.evaluation.answers.clusters`.

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
    return _kind(kind).fit(answer, by)


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


def _scores_of_draws(raw: Prediction, draws: Tensor) -> Tensor:
    """Normal scores of many draws; of a mixture, read off 33 nodes between its extreme draws."""
    if raw.predictive.location.shape[0] == 1 or len(draws) <= _NODES:
        return raw.normal_score(draws)
    low, high = draws.amin(0), draws.amax(0)
    share = torch.linspace(0, 1, _NODES).to(draws).view(-1, *[1] * low.ndim)
    nodes = raw.normal_score(torch.lerp(low, high, share))
    return _read(nodes, (draws - low) / (high - low).clamp(min=1e-30) * (_NODES - 1))


def _read(table: Tensor, place: Tensor) -> Tensor:
    """Heights of a table along its first axis at fractional rows; end pieces are continued."""
    below = place.floor().clamp(0, len(table) - 2)
    low, high = table.gather(0, below.long()), table.gather(0, below.long() + 1)
    return torch.lerp(low, high, place - below)


def _score(levels: Tensor) -> Tensor:
    scores: Tensor = torch.special.ndtri(levels)
    return scores


def _level(scores: Tensor) -> Tensor:
    levels: Tensor = torch.special.ndtr(scores)
    return levels


def _weighted(scores: Tensor, answer: Answer) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Known scores in ascending order and the share of the scores that ends with each."""
    counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)
    weight = 1 / (answer.groups * counts[answer.cluster])
    weight = weight.view(-1, *[1] * (scores.ndim - 1)).expand_as(scores)
    ordered, place = scores[answer.mask].sort()
    return ordered, weight[answer.mask][place].cumsum(0)


def _weighted_quantile(ordered: Tensor, share: Tensor, levels: Tensor) -> Tensor:
    """Smallest score at which the share reaches each level."""
    place = torch.searchsorted(share, levels.to(share) - 1e-9)
    return ordered[place.clamp(max=len(ordered) - 1)]


def _worth(pooled: Tensor, share: Tensor, scores: Tensor, answer: Answer) -> float:
    """G_eff: independent entries that give coverages as certain as these groups do."""
    counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)
    present = counts > 0
    levels = _LEVELS[49:90].to(scores)
    variance = torch.zeros_like(levels)
    for i, threshold in enumerate(_weighted_quantile(pooled, share, levels)):
        inside = ((scores <= threshold) & answer.mask).flatten(1).sum(1)
        coverage = group_sums(inside, answer.cluster)[present] / counts[present]
        variance[i] = coverage.var() / answer.groups
    worth = (levels * (1 - levels)).sum() / variance.sum()
    return float(worth.clamp(answer.groups, float(counts.sum())))
