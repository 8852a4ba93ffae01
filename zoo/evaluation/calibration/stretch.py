"""Factors that correct a standard deviation, per channel and lead time, shrunk by the groups."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.evaluation.answers import Answer, group_sums
from zoo.evaluation.calibration.curve import interpolate
from zoo.prediction.prediction import Prediction

__all__ = ["By", "Stretch", "crossed", "standardised"]

By = Literal["channel", "time"]
_FOLDS = 20


@dataclass(frozen=True, kw_only=True)
class Stretch:
    r"""σ̃_{t,c} = σ_{t,c} · a · b_c · d_t.

    b and d come from group means of the standardised residuals and are shrunk to 1 by empirical
    Bayes: log b̂_c = τ² / (τ² + s_c²) · log b_c, where s_c is the standard error over groups of
    log b_c and τ² the variance between channels that s_c does not explain. Lead times share bins
    that widen with the lead; between bin centres log d is linear, beyond the last constant.
    """

    level: Float[Tensor, ""]
    channel: Float[Tensor, " channel"]
    time: Float[Tensor, " time"]

    def __post_init__(self) -> None:
        """Refuse what are no factors: one level, and some of channels and of lead times."""
        for what, axes in (("level", 0), ("channel", 1), ("time", 1)):
            factor = getattr(self, what)
            if factor.ndim != axes or not factor.numel():
                raise ValueError(f"factor {what!r} has shape {tuple(factor.shape)}")
            real = factor.is_floating_point() and bool(factor.isfinite().all())
            if not (real and bool((factor >= 0).all())):
                raise ValueError(f"factor {what!r} must be finite and not negative")

    @classmethod
    def fit(
        cls, sizes: Tensor, answer: Answer, by: tuple[By, ...], power: float, common: bool = True
    ) -> Self:
        """Factors that make the group-wise mean of ``sizes``, |z|^power, equal to 1.

        With ``common=False`` a stays 1: only the ratios of channels and lead times are fitted.
        """
        size, mask = _three_axes(sizes), _three_axes(answer.mask)
        channel = size.new_ones(size.shape[2])
        time = size.new_ones(size.shape[1])
        if "channel" in by:
            channel = _shrunk(_by_group(size, mask, answer, (1,)))
        if "time" in by and size.shape[1] > 1:
            time = _over_time(size / channel, mask, answer)
        level = size.new_ones(())
        if common:
            level = _pooled(_by_group(size / channel / time[:, None], mask, answer, (1, 2)))
        return cls(
            level=level ** (1 / power), channel=channel ** (1 / power), time=time ** (1 / power)
        )

    def of(self, raw: Prediction) -> Tensor:
        """Factors of a prediction, (time, channel) or (target,); later frames take the last."""
        if raw.shape[-1] != len(self.channel):
            raise ValueError(
                f"prediction has {raw.shape[-1]} {raw.axes[-1]}s; "
                f"this recalibration was fitted on {len(self.channel)}"
            )
        factor = self.level * self.channel
        if len(raw.shape) == 3:
            lead = torch.arange(raw.shape[1]).clamp(max=len(self.time) - 1)
            factor = factor * self.time[lead, None]
        return factor.to(raw.predictive.location)

    def blend(self, other: Stretch, share: float) -> Stretch:
        """Geometric means with another's; the shorter one's last lead time goes on."""
        frames = max(len(self.time), len(other.time))
        times = [f.time[torch.arange(frames).clamp(max=len(f.time) - 1)] for f in (self, other)]
        pairs = {"level": (self.level, other.level), "channel": (self.channel, other.channel)}
        found = {k: a ** (1 - share) * b**share for k, (a, b) in pairs.items()}
        return Stretch(**found, time=times[0] ** (1 - share) * times[1] ** share)

    def state(self) -> dict[str, Tensor]:
        """Its tensors."""
        return {"level": self.level, "channel": self.channel, "time": self.time}

    @classmethod
    def from_state(cls, tensors: dict[str, Any]) -> Self:
        """What :meth:`state` gave."""
        return cls(level=tensors["level"], channel=tensors["channel"], time=tensors["time"])


def standardised(answer: Answer) -> Float[Tensor, "sequence *rest"]:
    """Residuals over the model's own standard deviation in float64; 0 where unknown."""
    raw = answer.prediction
    std = raw.std.double()
    if bool((std[answer.mask] <= 0).any()):
        count = int((std[answer.mask] <= 0).sum())
        raise ValueError(f"{count} known entries are predicted with a standard deviation of 0")
    z = (answer.truth.double() - raw.mean.double()) / std
    return torch.where(answer.mask, z, 0.0)


def crossed(
    sizes: Tensor, answer: Answer, by: tuple[By, ...], power: float, common: bool = True
) -> Tensor:
    """Factors of every sequence, fitted without the fold of groups that it belongs to."""
    folds = min(_FOLDS, int(answer.cluster.max()) + 1)
    out = torch.ones_like(sizes)
    for fold in range(folds):
        held = answer.cluster % folds == fold
        rest = Answer(
            prediction=answer.prediction,
            truth=answer.truth,
            mask=answer.mask & ~held.view(-1, *[1] * (sizes.ndim - 1)),
            cluster=answer.cluster,
        )
        if bool(held.any()) and bool(rest.mask.any()):
            out[held] = Stretch.fit(sizes, rest, by, power, common).of(answer.prediction).to(out)
    return out


def _three_axes(values: Tensor) -> Tensor:
    return values if values.ndim == 3 else values[:, None, :]


def _by_group(
    size: Tensor, mask: Tensor, answer: Answer, over: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Means of every group over some axes, and where a group has any entry, (group, rest)."""
    known = torch.where(mask, size, 0.0).sum(over)
    sums, counts = group_sums(known, answer.cluster), group_sums(mask.sum(over), answer.cluster)
    return sums / counts.clamp(min=1), counts > 0


def _pooled(group_means: tuple[Tensor, Tensor]) -> Tensor:
    """Mean over the groups that have any entry; all groups weigh the same."""
    means, present = group_means
    return (means * present).sum(0) / present.sum(0).clamp(min=1)


def _shrunk(group_means: tuple[Tensor, Tensor]) -> Float[Tensor, " column"]:
    """Multipliers of geometric mean 1, shrunk to 1 by the noise that the groups show."""
    means, present = group_means
    count, centre = present.sum(0), _pooled(group_means)
    known = (count > 1) & (centre > 0)
    out = torch.ones_like(centre)
    if int(known.sum()) < 2:
        return out
    share = present[:, known].double()
    deviation = (means[:, known] / centre[known] - 1) * share
    shared = deviation.sum(1, keepdim=True) / share.sum(1, keepdim=True).clamp(min=1)
    own = (deviation - shared * share).square().sum(0)
    noise = own / (count[known] * (count[known] - 1))
    ratio = centre[known].log() - centre[known].log().mean()
    between = (ratio.var() - noise.mean()).clamp(min=0)
    weight = torch.where(between > 0, between / (between + noise), 0.0)
    out[known] = (weight * ratio).exp()
    return out


def _over_time(size: Tensor, mask: Tensor, answer: Answer) -> Float[Tensor, " time"]:
    frames = size.shape[1]
    edges = torch.logspace(0, torch.log10(torch.tensor(frames + 1.0)).item(), 10).round()
    edges = edges.unique()
    place = torch.arange(frames, dtype=edges.dtype) + 1
    bins = torch.bucketize(place, edges, right=True) - 1
    bins = bins.clamp(max=len(edges) - 2).to(size.device)
    one_hot = torch.nn.functional.one_hot(bins, int(bins.max()) + 1).to(size)
    known = torch.where(mask, size, 0.0).sum(2) @ one_hot
    counts = group_sums(mask.sum(2).to(size) @ one_hot, answer.cluster)
    sums = group_sums(known, answer.cluster)
    shrunk = _shrunk((sums / counts.clamp(min=1), counts > 0)).log()
    centres = (one_hot.T @ place.to(size)) / one_hot.sum(0)
    inside = place.to(size).clamp(centres[0], centres[-1])
    return interpolate(inside, centres, shrunk).exp()
