"""Scores of a prediction against the truth: errors, proper scores and calibration."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from zoo.errors import NoDensityError, NoJointSamplesError
from zoo.evaluation.answers import Answer, Estimate, Groups, estimate, group_sums
from zoo.evaluation.proper import crps, energy_scores, variogram_scores
from zoo.evaluation.reliability import LEVELS, Reliability
from zoo.prediction.prediction import Prediction

__all__ = ["SCORES", "Scores", "score"]

_PERCENT = tuple(round(100 * level) for level in LEVELS)

SCORES: dict[str, tuple[str, str]] = {
    "mse": ("MSE", "{unit}²"),
    "mse_sd": ("SD of squared errors", "{unit}²"),
    "rmse": ("RMSE", "{unit}"),
    "r2": ("R², mean of channels", ""),
    "std": ("predicted SD, mean", "{unit}"),
    "nll": ("NLL an entry", "nats"),
    "nll_raw": ("NLL, spread uncorrected", "nats"),
    "crps": ("CRPS", "{unit}"),
    "energy": ("energy score", "{unit}"),
    "variogram": ("variogram score", "{unit}"),
    **{f"interval_{p}": (f"interval score {p} %", "{unit}") for p in _PERCENT},
    **{f"coverage_{p}": (f"inside {p} % band", "%") for p in _PERCENT},
    **{f"width_{p}": (f"width of {p} % band", "{unit}") for p in _PERCENT},
    "calibration_error": ("calibration error", "%"),
}


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores by name, each with its standard error over groups; those not to be had are absent.

    ``channels`` holds RMSE, R² (None where the truth is constant) and 90 % coverage of every
    channel. ``unit`` is "mixed units" where channels differ: pooled errors then mix them.
    """

    task: str
    unit: str
    entries: int
    groups: int
    values: dict[str, Estimate]
    channels: tuple[dict[str, Any], ...]
    reliability: Reliability | None

    def __getitem__(self, name: str) -> Estimate | None:
        """A score by its name in ``SCORES``; None where the prediction cannot give it."""
        if name not in SCORES:
            raise KeyError(f"no score {name!r}; there are {', '.join(SCORES)}")
        return self.values.get(name)

    def unit_of(self, name: str) -> str:
        """Unit of a score."""
        template = SCORES[name][1]
        if "{unit}" in template and not self.unit:
            return ""
        return template.format(unit=self.unit)

    def to_json(self) -> dict[str, Any]:
        """All scores as plain data."""
        curve = self.reliability
        return {
            "task": self.task,
            "entries": self.entries,
            "groups": self.groups,
            "scores": {
                name: {
                    "value": _finite(e.value),
                    "error": _finite(e.error),
                    "unit": self.unit_of(name),
                }
                for name, e in self.values.items()
            },
            "channels": list(self.channels),
            "reliability": None
            if curve is None
            else {"nominal": curve.nominal.tolist(), "observed": curve.observed.tolist()},
        }


def score(
    prediction: Prediction,
    truth: Tensor,
    mask: Tensor | None = None,
    groups: Groups | None = None,
    *,
    by: str | None = None,
    draws: int = 200,
    seed: int = 0,
    joint: bool = True,
) -> Scores:
    """Every score that ``prediction`` can honestly be given; unknown truth is left out.

    Standard errors are jackknifed over groups (movements, trials): see
    :func:`~zoo.evaluation.answers.clusters`. ``draws`` joint samples give the energy and variogram
    scores, which ``joint=False`` leaves out. A deterministic prediction gets error scores only.
    """
    if draws < 2:
        raise ValueError(f"draws must be at least 2; got {draws}")
    answer = Answer.of(prediction, truth, mask, groups, by)
    entrywise, reliability = _errors(answer), None
    values = {k: _mean(v, answer) for k, v in entrywise.items()}
    values |= _error_summaries(answer, entrywise["mse"])
    if prediction.has_spread:
        reliability = Reliability.of(answer)
        entrywise |= _spread_scores(answer)
        values |= {k: _mean(v, answer) for k, v in entrywise.items()}
        values |= _joint_scores(answer, draws, seed) if joint else {}
        values["calibration_error"] = _percent(reliability.calibration_error)
    return Scores(
        task=prediction.task,
        unit=_unit(prediction.units),
        entries=int(answer.mask.sum()),
        groups=answer.groups,
        values={k: v for k in SCORES if (v := values.get(k)) is not None},
        channels=_by_channel(answer, entrywise),
        reliability=reliability,
    )


def _errors(answer: Answer) -> dict[str, Tensor]:
    return {"mse": (answer.truth - answer.prediction.mean.double()).square()}


def _error_summaries(answer: Answer, squares: Tensor) -> dict[str, Estimate | None]:
    columns = _columns(answer, squares, squares.square())
    spread = columns.sum(0)
    sd = (spread[1] / spread[2] - (spread[0] / spread[2]).square()).clamp(min=0).sqrt()
    return {
        "mse_sd": Estimate(float(sd)),
        "rmse": estimate(columns, lambda s: (s[..., 0] / s[..., 2]).clamp(min=0).sqrt()),
        "r2": estimate(_r2_columns(answer, squares).flatten(1), _mean_r2(squares.shape[-1])),
    }


def _spread_scores(answer: Answer) -> dict[str, Tensor]:
    prediction, truth = answer.prediction, answer.truth
    scores = {"std": prediction.std.double(), "crps": crps(prediction, truth)}
    with suppress(NoDensityError):
        scores["nll"] = -prediction.log_prob(truth).double()
    with suppress(NoDensityError):
        if prediction.recalibration is not None:
            scores["nll_raw"] = -prediction.raw.log_prob(truth).double()
    for level, percent in zip(LEVELS, _PERCENT, strict=True):
        low, high = (end.double() for end in prediction.interval(level))
        inside = (truth >= low) & (truth <= high)
        scores[f"coverage_{percent}"] = 100 * inside.double()
        scores[f"width_{percent}"] = high - low
        missed = (low - truth).clamp(min=0) + (truth - high).clamp(min=0)
        scores[f"interval_{percent}"] = high - low + 2 / (1 - level) * missed
    return scores


def _joint_scores(answer: Answer, draws: int, seed: int) -> dict[str, Estimate | None]:
    if answer.truth[0].numel() == 1:
        return {}
    p = answer.prediction.predictive
    paths = p.location if p.draws is None else p.draws
    count = min(draws, len(paths)) if len(paths) > 1 else draws
    try:
        sample = answer.prediction.sample(count, seed=seed)
    except NoJointSamplesError:
        return {}
    known = answer.mask.flatten(1).any(1).double()
    energy = energy_scores(sample, answer)
    sums = group_sums(torch.stack([energy * known, known], 1), answer.cluster)
    pairs = group_sums(variogram_scores(sample, answer).T, answer.cluster)
    return {"energy": estimate(sums, _ratio), "variogram": estimate(pairs, _ratio)}


def _columns(answer: Answer, *entrywise: Tensor) -> Tensor:
    """Sums of entrywise scores over the known entries of every group, their number last."""
    parts = [torch.where(answer.mask, e, 0.0).flatten(1).sum(1) for e in entrywise]
    parts.append(answer.mask.flatten(1).sum(1).double())
    return group_sums(torch.stack(parts, 1), answer.cluster)


def _mean(entrywise: Tensor, answer: Answer) -> Estimate | None:
    return estimate(_columns(answer, entrywise.to(answer.truth)), _ratio)


def _ratio(sums: Tensor) -> Tensor:
    return sums[..., 0] / sums[..., 1]


def _r2_columns(answer: Answer, squares: Tensor) -> Tensor:
    """Per group and channel: number, Σy, Σy² about the channel's mean, and Σ(y − ŷ)²."""
    mask = answer.mask
    rows = tuple(range(mask.ndim - 1))
    truth = torch.where(mask, answer.truth, 0.0)
    centre = truth.sum(rows) / mask.sum(rows).clamp(min=1)
    y = torch.where(mask, answer.truth - centre, 0.0)
    tiny = 1e-10 * truth.abs().amax(rows)
    y = torch.where(y.abs() > tiny, y, 0.0)
    parts = torch.stack([mask.double(), y, y.square(), torch.where(mask, squares, 0.0)], -1)
    return group_sums(parts if mask.ndim == 2 else parts.sum(1), answer.cluster)


def _mean_r2(channels: int) -> Callable[[Tensor], Tensor]:
    def statistic(sums: Tensor) -> Tensor:
        return _r2(sums.unflatten(-1, (channels, 4))).nanmean(-1)

    return statistic


def _r2(sums: Tensor) -> Tensor:
    """1 − Σ(y − ŷ)² / Σ(y − ȳ)²; NaN where the truth does not vary."""
    count, total, squares, errors = sums.unbind(-1)
    variation = squares - total.square() / count.clamp(min=1)
    return torch.where(squares > 0, 1 - errors / variation, torch.nan)


def _by_channel(answer: Answer, entrywise: dict[str, Tensor]) -> tuple[dict[str, Any], ...]:
    rows = tuple(range(answer.mask.ndim - 1))
    counts = answer.mask.sum(rows)

    def mean(entries: Tensor) -> Tensor:
        return torch.where(answer.mask, entries.to(answer.truth), 0.0).sum(rows) / counts

    columns = {
        "rmse": mean(entrywise["mse"]).sqrt(),
        "r2": _r2(_r2_columns(answer, entrywise["mse"]).sum(0)),
    }
    if "coverage_90" in entrywise:
        columns["coverage_90"] = mean(entrywise["coverage_90"])
    prediction = answer.prediction
    return tuple(
        {"name": name, "unit": prediction.units[i]}
        | {k: _finite(float(column[i])) for k, column in columns.items()}
        for i, name in enumerate(prediction.names)
    )


def _finite(value: float | None) -> float | None:
    """JSON has no infinities: they are null."""
    return value if value is not None and math.isfinite(value) else None


def _percent(share: Estimate) -> Estimate:
    return Estimate(100 * share.value, None if share.error is None else 100 * share.error)


def _unit(units: tuple[str, ...]) -> str:
    return units[0] if len(set(units)) == 1 else "mixed units"
