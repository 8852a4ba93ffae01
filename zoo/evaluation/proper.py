"""Proper scores: CRPS of every entry, energy and variogram score of joint draws."""

from __future__ import annotations

import math
from collections.abc import Callable

import scoringrules
import torch
from jaxtyping import Float
from torch import Tensor

from zoo.evaluation.answers import Answer
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

__all__ = ["crps", "energy_scores", "variogram_scores"]

_LEVELS = tuple((i + 0.5) / 40 for i in range(40))
_SHIFTS = 12
_LAGS = (1, 2, 4, 8, 16, 32)
_BLOCK = 2**22


def crps(prediction: Prediction, truth: Tensor) -> Tensor:
    """E|Y − y| − ½ E|Y − Y'| of every entry, in the data's unit.

    Closed form for a Gaussian and, up to 25 components, for a mixture; for larger mixtures the
    second mean runs over 12 cyclic shifts of the components, which is unbiased for draws.
    Recalibrations without a density are scored at 40 quantiles.
    """
    p = prediction.effective
    if p is None:
        quantiles = torch.stack([prediction.quantile(level) for level in _LEVELS], -1)
        return _tensor(scoringrules.crps_quantile(*_arrays(truth, quantiles), _LEVELS))
    if p.spread is None:
        return _tensor(scoringrules.crps_ensemble(*_arrays(truth, p.location), m_axis=0))
    if p.location.shape[0] == 1:
        return _normal_crps(p.location[0], p.spread.expand_as(p.location)[0], truth)
    return _mixture_crps(p, p.spread, truth)


def energy_scores(draws: Tensor, answer: Answer) -> Float[Tensor, " sequence"]:
    """Energy score of every sequence's or item's whole vector of known entries.

    E‖X − y‖ − ½ E‖X − X'‖ with the unbiased mean over distinct pairs of draws (Gneiting & Raftery
    2007, eq. 22).
    """
    known = answer.mask.flatten(1)
    truth = answer.truth.flatten(1) * known
    paths = draws.flatten(2).movedim(0, 1)
    count = draws.shape[0]
    step = max(1, _BLOCK // (count * max(count, paths.shape[2])))
    scores = []
    for start in range(0, len(truth), step):
        rows = slice(start, start + step)
        miss = (paths[rows].double() - truth[rows, None]) * known[rows, None]
        apart = torch.cdist(miss, miss, compute_mode="use_mm_for_euclid_dist")
        apart.diagonal(dim1=-2, dim2=-1).zero_()
        error = miss.norm(dim=-1).mean(-1)
        scores.append(error - apart.sum((-1, -2)) / (2 * count * (count - 1)))
    return torch.cat(scores)


def variogram_scores(draws: Tensor, answer: Answer) -> Float[Tensor, "pair sequence"]:
    """Sum over pairs of known entries of (√|y_i − y_j| − E√|X_i − X_j|)², and number of pairs.

    Pairs are all channels of one frame, and frames of one channel that are 1, 2, 4, 8, 16 or 32
    apart (Scheuerer & Hamill 2015, order ½).
    """
    y, mask = _paths(answer.truth), _paths(answer.mask)
    x = draws if draws.ndim == 4 else draws[:, :, None]
    shifts = [(2, k) for k in range(1, y.shape[2])] + [(1, k) for k in _LAGS if k < y.shape[1]]
    total, pairs = y.new_zeros(len(y)), y.new_zeros(len(y))
    for axis, k in shifts:
        both = _shifted(mask, axis, k, torch.logical_and)
        expected = _shifted(x, axis + 1, k, _root_distance).mean(0)
        miss = (_shifted(y, axis, k, _root_distance) - expected).square()
        total += torch.where(both, miss, 0.0).sum((1, 2))
        pairs += both.sum((1, 2))
    return torch.stack([total, pairs])


def _normal_crps(mean: Tensor, std: Tensor, truth: Tensor) -> Tensor:
    """Without a standard deviation, as in frames beyond a movement's end, it is the distance."""
    parts = _arrays(truth, mean, torch.where(std > 0, std, 1.0))
    distance = (truth.double() - mean.double()).abs()
    return torch.where(std > 0, _tensor(scoringrules.crps_normal(*parts)).to(distance), distance)


def _mixture_crps(p: Predictive, scale: Tensor, truth: Tensor) -> Tensor:
    count = p.location.shape[0]
    shifts = torch.arange(1, count)
    if len(shifts) > 2 * _SHIFTS:
        shifts = torch.linspace(1, count // 2, _SHIFTS).round().long()
    centre = p.location.flatten(1)
    width = scale.expand_as(p.location).flatten(1)
    y = truth.to(centre).flatten()
    out = torch.empty_like(y)
    for part in torch.arange(len(y)).split(max(1, _BLOCK // (8 * count))):
        m, s = centre[:, part], width[:, part]
        error = _mean_distance(y[part] - m, s).mean(0)
        itself = _mean_distance(torch.zeros_like(m), s * math.sqrt(2)).mean(0)
        others = torch.zeros_like(itself)
        for k in shifts.tolist():
            both = (s.square() + s.roll(k, 0).square()).sqrt()
            others += _mean_distance(m - m.roll(k, 0), both).mean(0) / len(shifts)
        out[part] = error - (itself + (count - 1) * others) / (2 * count)
    return out.reshape(truth.shape).double()


def _mean_distance(mean: Tensor, std: Tensor) -> Tensor:
    """E|X| of X ~ N(mean, std²)."""
    std = std.clamp(min=torch.finfo(std.dtype).tiny)
    ratio = mean / std
    density = (-0.5 * ratio.square()).exp() * math.sqrt(2 / math.pi)
    return mean * torch.erf(ratio / math.sqrt(2)) + std * density


def _root_distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).abs().sqrt()


def _shifted(x: Tensor, axis: int, k: int, pair: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    size = x.shape[axis]
    return pair(x.narrow(axis, k, size - k), x.narrow(axis, 0, size - k))


def _paths(values: Tensor) -> Tensor:
    """(sequence, time, channel), also for items."""
    return values if values.ndim == 3 else values[:, None]


def _arrays(*tensors: Tensor) -> list[object]:
    return [t.double().cpu().numpy() for t in tensors]


def _tensor(array: object) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float64)
