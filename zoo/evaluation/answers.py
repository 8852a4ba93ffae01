"""A prediction beside its truth, and estimates whose standard errors count whole groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from zoo.prediction.prediction import Prediction

__all__ = ["Answer", "Estimate", "Groups", "clusters", "estimate", "group_sums"]

Groups = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error over groups; None where one group is all there is."""

    value: float
    error: float | None = None


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A prediction and the truth: ``mask`` is True where the truth is known and inside.

    ``cluster`` numbers the group of each sequence or item: entries of one group are dependent.
    """

    prediction: Prediction
    truth: Tensor
    mask: Tensor
    cluster: Int[Tensor, " sequence"]

    @classmethod
    def of(
        cls,
        prediction: Prediction,
        truth: Tensor,
        mask: Tensor | None = None,
        groups: Groups | None = None,
        by: str | None = None,
    ) -> Self:
        """Check the shapes; what is NaN, masked out or beyond a sequence's length is unknown."""
        for what, tensor in (("truth", truth), ("mask", mask)):
            if tensor is not None and tuple(tensor.shape) != prediction.shape:
                raise ValueError(
                    f"{what} has shape {tuple(tensor.shape)}; "
                    f"the {prediction.task} prediction has {prediction.shape}"
                )
        like = prediction.predictive.location
        known = ~truth.isnan() if mask is None else mask.bool() & ~truth.isnan()
        if prediction.lengths is not None:
            known = known & _inside(prediction).to(known.device)
        if not bool(known.any()):
            raise ValueError(f"no entry of the {prediction.task} prediction has a known truth")
        return cls(
            prediction=prediction,
            truth=torch.where(known, truth, 0).double().to(like.device),
            mask=known.to(like.device),
            cluster=clusters(groups, prediction.shape[0], by).to(like.device),
        )

    @property
    def groups(self) -> int:
        """Number of groups with a known entry."""
        return len(self.cluster[self.mask.flatten(1).any(1)].unique())


def _inside(prediction: Prediction) -> Bool[Tensor, "sequence time 1"]:
    lengths = prediction.lengths
    if lengths is None or "time" not in prediction.axes:
        raise ValueError("only predictions in time have lengths")
    inside = torch.arange(prediction.shape[1], device=lengths.device) < lengths[:, None]
    return inside[..., None]


def clusters(groups: Groups | None, count: int, by: str | None = None) -> Int[Tensor, " sequence"]:
    """Number of the group that each sequence or item belongs to, from 0.

    Rows that agree in every column but ``start`` (windows of one movement) are one group; ``by``
    names a single, coarser column instead. Without groups every row is its own.

    >>> clusters({"trial": ("a", "a", "b"), "start": ("0", "5", "0")}, 3).tolist()
    [0, 0, 1]
    """
    if not groups:
        return torch.arange(count)
    if by is not None and by not in groups:
        raise ValueError(f"no group column {by!r}; there are {', '.join(groups)}")
    names = [by] if by is not None else [k for k in groups if k != "start"] or list(groups)
    for name in names:
        if len(groups[name]) != count:
            raise ValueError(f"group column {name!r} has {len(groups[name])} rows for {count}")
    numbers: dict[tuple[str, ...], int] = {}
    rows = zip(*(groups[name] for name in names), strict=True)
    return torch.tensor([numbers.setdefault(row, len(numbers)) for row in rows])


def group_sums(
    values: Shaped[Tensor, "sequence *rest"], cluster: Int[Tensor, " sequence"]
) -> Float[Tensor, "group *rest"]:
    """Sums of the rows of every group, in float64."""
    rows = values.double()
    out = rows.new_zeros(int(cluster.max()) + 1, *rows.shape[1:])
    return out.index_add_(0, cluster, rows)


def estimate(
    sums: Float[Tensor, "group column"], statistic: Callable[[Tensor], Tensor]
) -> Estimate | None:
    """A statistic of summed columns with its jackknife standard error over the groups.

    ``statistic`` maps (..., column) to (...); None where it is not defined on all the data.

    >>> estimate(torch.tensor([[1.0, 1.0], [3.0, 1.0]]), lambda s: s[..., 0] / s[..., 1])
    Estimate(value=2.0, error=1.0)
    """
    total = sums.sum(0)
    value = float(statistic(total))
    if math.isnan(value):
        return None
    left_out = statistic(total - sums)
    left_out = left_out[left_out.isfinite()]
    if len(left_out) < 2:
        return Estimate(value)
    spread = left_out.var(unbiased=False) * (len(left_out) - 1)
    return Estimate(value, float(spread.sqrt()))
