"""Marginals of Gaussian mixtures, far into both tails.

Every function takes ``location`` with a leading ``component`` axis and ``scale``, the standard
deviations that broadcast to it; ``scale=None`` means a set of draws without noise. Levels are given
as standard normal scores Φ⁻¹(level), so that neither tail loses digits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

__all__ = ["cdf", "log_density", "normal_score", "quantile"]

_BLOCK = 2**18
_FARTHEST = 37.0


def cdf(location: Tensor, scale: Tensor | None, value: Tensor) -> Tensor:
    """P(Y ≤ value) of every coordinate; ``value`` may have a leading ``sample`` axis.

    >>> cdf(torch.tensor([[-1.0], [1.0]]), torch.ones(2, 1), torch.zeros(1))
    tensor([0.5000])
    """
    below: Tensor = torch.special.ndtr(normal_score(location, scale, value))
    return below


def normal_score(location: Tensor, scale: Tensor | None, value: Tensor) -> Tensor:
    """Φ⁻¹(P(Y ≤ value)), exact far out in both tails; (value − location) / scale for a Gaussian.

    >>> normal_score(torch.zeros(1, 1), torch.ones(1, 1), torch.tensor([30.0]))
    tensor([30.])
    """
    if scale is not None and location.shape[0] == 1:
        return ((value - location[0]) / _positive(scale).expand_as(location)[0]).clamp(
            -_FARTHEST, _FARTHEST
        )
    rows = value.expand(*value.shape[: max(0, value.ndim - location.ndim + 1)], *location.shape[1:])
    flat = rows.reshape(-1, location[0].numel())
    out = torch.empty_like(flat)
    for part, centre, width in _blocks(location, scale, flat.shape[0]):
        out[:, part] = _score(centre, width, flat[:, None, part].to(centre))
    return out.reshape(rows.shape)


def quantile(location: Tensor, scale: Tensor | None, score: float) -> Tensor:
    """The value below which Φ(``score``) of the probability lies, for every coordinate.

    >>> quantile(torch.zeros(1, 1), 2 * torch.ones(1, 1), 1.5)
    tensor([3.])
    """
    if scale is None:
        return _sorted_quantile(location, score)
    if location.shape[0] == 1:
        return location[0] + score * scale.expand_as(location)[0]
    if score > 0:
        return -quantile(-location, scale, -score)
    out = location.new_empty(location[0].numel())
    for part, centre, width in _blocks(location, scale, 1):
        out[part] = _solve(centre, width, score) if width is not None else 0.0
    return out.reshape(location.shape[1:])


def log_density(location: Tensor, scale: Tensor, value: Tensor) -> Tensor:
    """Log density of every coordinate's mixture at ``value``.

    >>> log_density(torch.zeros(3, 1), torch.ones(3, 1), torch.zeros(1))
    tensor([-0.9189])
    """
    width = _positive(scale)
    residual = (value - location) / width
    density = -0.5 * residual.square() - width.log() - 0.5 * math.log(2 * math.pi)
    return density.logsumexp(0) - math.log(location.shape[0])


def _blocks(
    location: Tensor, scale: Tensor | None, rows: int
) -> Iterator[tuple[slice, Tensor, Tensor | None]]:
    """Blocks of coordinates that fit the cache, as (component, coordinate)."""
    centre = location.flatten(1)
    width = None if scale is None else _positive(scale).expand_as(location).flatten(1)
    size = max(1, _BLOCK // (location.shape[0] * rows))
    for start in range(0, centre.shape[1], size):
        part = slice(start, start + size)
        yield part, centre[:, part], None if width is None else width[:, part]


def _score(centre: Tensor, width: Tensor | None, value: Tensor) -> Tensor:
    if width is None:
        half = 0.5 / centre.shape[0]
        below = (centre <= value).to(centre.dtype).mean(-2)
        return _normal_score(below.clamp(half, 1 - half))
    side = torch.where(value < centre.mean(0), -1.0, 1.0)
    reduced = (value - centre) * side / (width * math.sqrt(2))
    tail = _normal_score(torch.erfc(reduced).mean(-2) / 2).clamp(min=-_FARTHEST)
    return -side.squeeze(-2) * tail


def _solve(centre: Tensor, width: Tensor, score: float) -> Tensor:
    """Newton's method on the normal score, kept between the components' own quantiles."""
    ends = centre + score * width
    low, high = ends.amin(0), ends.amax(0)
    mean = centre.mean(0)
    spread = (width.square() + (centre - mean).square()).mean(0).sqrt()
    x = (mean + score * spread).clamp(low, high)
    tolerance = 1e3 * torch.finfo(x.dtype).eps
    for _ in range(80):
        reduced = (x - centre) / width
        reached = _normal_score(torch.erfc(-reduced / math.sqrt(2)).mean(0) / 2)
        miss = reached - score
        if bool((miss.abs().le(tolerance) | (high - low).le(tolerance * spread)).all()):
            break
        low, high = torch.where(miss < 0, x, low), torch.where(miss < 0, high, x)
        slope = ((reached.square() - reduced.square()) / 2).exp() / width
        step = x - miss / slope.mean(0)
        x = torch.where((step >= low) & (step <= high), step, (low + high) / 2)
    return x


def _sorted_quantile(draws: Tensor, score: float) -> Tensor:
    level = 0.5 * math.erfc(-score / math.sqrt(2))
    ordered = draws.sort(0).values
    place = level * (draws.shape[0] - 1)
    below = min(int(place), draws.shape[0] - 1)
    above = min(below + 1, draws.shape[0] - 1)
    return torch.lerp(ordered[below], ordered[above], place - below)


def _normal_score(level: Tensor) -> Tensor:
    score: Tensor = torch.special.ndtri(level)
    return score


def _positive(scale: Tensor) -> Tensor:
    return scale.clamp(min=torch.finfo(scale.dtype).tiny)
