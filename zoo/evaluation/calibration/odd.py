"""Groups unlike the others, where the groups are too few to tell how common such ones are."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.evaluation.answers import Answer, group_sums
from zoo.evaluation.calibration.promise import LEVEL, promised

__all__ = ["MOST", "tempered"]

MOST = 1.5


def tempered(z: Float[Tensor, "sequence *rest"], answer: Answer) -> Float[Tensor, "sequence *rest"]:
    r"""Standardised residuals of which no group is more than 1.5 times as large as the median one.

    Of three groups a single one that is three times as far off sets every 90 % band: it is a third
    of the weight. Whether such groups are a third of all, so few cannot tell. Its residuals are
    shrunk until the mean of \|z\| is 1.5 times that of the median group, as an outlying estimate is
    winsorised. From nine groups on, which can promise 90 %, nothing is shrunk: a promise counts
    every group as it is.
    """
    if promised(LEVEL, answer.groups) >= LEVEL:
        return z
    sizes = torch.where(answer.mask, z.abs(), 0.0).flatten(1).sum(1)
    counts = group_sums(answer.mask.flatten(1).sum(1), answer.cluster)
    means = group_sums(sizes, answer.cluster) / counts.clamp(min=1)
    median = means[counts > 0].quantile(0.5).clamp(min=torch.finfo(means.dtype).tiny)
    excess = (means / (MOST * median)).clamp(min=1)[answer.cluster]
    return z / excess.to(z).view(-1, *[1] * (z.ndim - 1))
