"""Gaussian mixtures: the record that models return, and its marginals far into both tails.

Every function takes ``location`` with a leading ``component`` axis and ``scale``, the standard
deviations that broadcast to it; ``scale=None`` means a set of draws without noise. Levels are given
as standard normal scores Φ⁻¹(level), so that neither tail loses digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zoo.streams import seeded

__all__ = ["Deferred", "Predictive", "cdf", "log_density", "normal_score", "pooled", "quantile"]

_BLOCK = 2**18
_FARTHEST = 37.0


class Deferred:
    """Joint draws that are made when they are first asked for, of a random stream set beforehand.

    ``make`` draws from torch's default generator, whose seed is drawn from it at once: the draws
    depend on when they were promised, not on when they are made.

    >>> promised = Deferred((3, 2), lambda: torch.randn(3, 2))
    >>> bool((promised.tensor() == promised.tensor()).all())
    True
    """

    def __init__(
        self, shape: Sequence[int], make: Callable[[], Tensor], seed: int | None = None
    ) -> None:
        """Promise draws of this shape."""
        self.shape = torch.Size(shape)
        self._make = make
        self._made: Tensor | None = None
        self._seed = int(torch.randint(2**62, ())) if seed is None else seed

    def tensor(self) -> Tensor:
        """The draws; the caller's random stream stays untouched."""
        with seeded(self._seed):
            self._made = self._make() if self._made is None else self._made
        return self._made

    def __reduce__(self) -> tuple[Callable[[Tensor], Tensor], tuple[Tensor]]:
        """Another process gets the draws themselves."""
        return torch.as_tensor, (self.tensor(),)

    def map(self, change: Callable[[Tensor], Tensor], shape: Sequence[int]) -> Deferred:
        """The same draws, changed once they are made."""
        make = self._make
        return Deferred(shape, lambda: change(make()), self._seed)


class _Draws:
    """Draws of a predictive: a tensor to all who read them, promised or not."""

    @overload
    def __get__(self, owner: None, kind: type) -> None: ...
    @overload
    def __get__(self, owner: Predictive, kind: type) -> Tensor | None: ...
    def __get__(self, owner: Predictive | None, kind: type) -> Tensor | None:
        held = None if owner is None else owner.__dict__["_draws"]
        return held.tensor() if isinstance(held, Deferred) else held

    def __set__(self, owner: Predictive, value: Tensor | Deferred | None) -> None:
        owner.__dict__["_draws"] = None if value is None or value.shape[:1] == (0,) else value


@dataclass(frozen=True, kw_only=True)
class Predictive:
    r"""What a model returns: p(y) = 1/K Σ_k N(y; location_k, noise² + epistemic²).

    ``location`` has a leading ``component`` axis (1 for a Gaussian or a deterministic model).
    ``noise`` is the aleatoric standard deviation, broadcastable to ``location``; None says that
    the model has none to give. ``epistemic`` is a further standard deviation of the mean where a
    model knows it in closed form; the spread of the components counts as epistemic too.
    ``joint`` says that each component is one joint trajectory; ``draws`` are joint draws of the
    noise-free path where the moments themselves are exact, or :class:`Deferred` ones.
    """

    location: Float[Tensor, "component *shape"]
    noise: Tensor | None = None
    epistemic: Tensor | None = None
    joint: bool = False
    draws: _Draws = _Draws()

    def __post_init__(self) -> None:
        """Refuse parts that do not fit ``location``."""
        shape = self.location.shape
        if not shape or shape[0] < 1:
            raise ValueError(f"location needs a component axis; it has shape {tuple(shape)}")
        _check_broadcast("noise", self.noise, shape)
        _check_broadcast("epistemic", self.epistemic, shape)
        got = None if self._held is None else tuple(self._held.shape)
        if got is not None and (not got[0] or got[1:] != tuple(shape[1:])):
            raise ValueError(f"draws have shape {got}; (sample, *{tuple(shape[1:])}) is needed")

    @property
    def spread(self) -> Tensor | None:
        """Standard deviation of every component; None for draws without noise."""
        parts = [part.square() for part in (self.noise, self.epistemic) if part is not None]
        return sum(parts[1:], parts[0]).sqrt() if parts else None

    def affine(self, scale: Tensor, shift: Tensor) -> Predictive:
        """The same distribution of ``scale * y + shift`` (both broadcast over the last axis)."""
        return Predictive(
            location=torch.addcmul(shift, self.location, scale),
            noise=None if self.noise is None else _widened(self.noise, scale.abs()),
            epistemic=None if self.epistemic is None else _widened(self.epistemic, scale.abs()),
            joint=self.joint,
            draws=self.redrawn(lambda draws: draws * scale + shift),
        )

    def map(self, change: Callable[[Tensor], Tensor]) -> Predictive:
        """The same ``change`` of location, noise, epistemic and draws: which entries, and where.

        >>> p = Predictive(location=torch.arange(6.0).view(1, 2, 3), noise=torch.ones(3))
        >>> p.map(lambda part: part[..., :1]).noise.shape
        torch.Size([1, 2, 1])
        """

        def whole(part: Tensor | None) -> Tensor | None:
            return None if part is None else change(part.expand_as(self.location))

        return Predictive(
            location=change(self.location),
            noise=whole(self.noise),
            epistemic=whole(self.epistemic),
            joint=self.joint,
            draws=self.redrawn(change),
        )

    def rows(self, index: slice | Int[Tensor, " some"]) -> Predictive:
        """The distribution of some sequences or items, in the order of ``index``."""
        return self.map(lambda part: part[:, index])

    @classmethod
    def concat(cls, parts: Sequence[Predictive]) -> Predictive:
        """The distributions of several sets of sequences or items, one after the other.

        Raises ValueError where one has noise, epistemic or draws and another has not.

        >>> one = Predictive(location=torch.zeros(1, 2, 3), noise=torch.ones(3))
        >>> Predictive.concat([one, one]).location.shape
        torch.Size([1, 4, 3])
        """
        wide = [part.map(lambda tensor: tensor) for part in parts]
        return cls(
            location=torch.cat([p.location for p in wide], 1),
            noise=_joined("noise", [p.noise for p in wide]),
            epistemic=_joined("epistemic", [p.epistemic for p in wide]),
            joint=all(p.joint for p in wide),
            draws=_joined_draws([p._held for p in wide]),
        )

    def redrawn(self, change: Callable[[Tensor], Tensor]) -> Deferred | Tensor | None:
        """The draws after ``change``, each by itself, deferred where they are."""
        if not isinstance(self._held, Deferred):
            return None if self._held is None else change(self._held)
        count, *rest = self._held.shape
        one = change(self.location.new_zeros(1, *rest))
        return self._held.map(change, (count, *one.shape[1:]))

    @property
    def _held(self) -> Deferred | Tensor | None:
        held: Deferred | Tensor | None = self.__dict__["_draws"]
        return held


def _joined(what: str, parts: Sequence[Tensor | None]) -> Tensor | None:
    known = [part for part in parts if part is not None]
    if known and len(known) < len(parts):
        raise ValueError(f"{len(known)} of {len(parts)} distributions to be joined have {what}")
    return torch.cat(known, 1) if known else None


def _joined_draws(parts: Sequence[Deferred | Tensor | None]) -> Deferred | Tensor | None:
    """Draws side by side, deferred where any are."""
    if not any(isinstance(part, Deferred) for part in parts):
        return _joined("draws", [part for part in parts if not isinstance(part, Deferred)])
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        raise ValueError(f"{len(known)} of {len(parts)} distributions to be joined have draws")
    count, _, *rest = known[0].shape
    shape = (count, sum(part.shape[1] for part in known), *rest)

    def make() -> Tensor:
        return torch.cat([p.tensor() if isinstance(p, Deferred) else p for p in known], 1)

    return Deferred(shape, make, seed=0)


def _widened(spread: Tensor, scale: Tensor) -> Tensor:
    """Spread times scale; what is the same along an axis is multiplied once."""
    once = spread[tuple(slice(0, 1 if step == 0 else None) for step in spread.stride())]
    return (once * scale).expand(torch.broadcast_shapes(spread.shape, scale.shape))


def pooled(parts: Sequence[Predictive]) -> Predictive:
    """The equal mixture 1/M Σ_m p_m of several distributions of the same quantity.

    >>> two = [Predictive(location=torch.full((k, 1), float(k))) for k in (1, 3)]
    >>> pooled(two).location.flatten()
    tensor([1., 1., 1., 3., 3., 3.])
    """
    shapes = {tuple(p.location.shape[1:]) for p in parts}
    if len(shapes) != 1:
        raise ValueError(f"distributions to be mixed have shapes {sorted(shapes)}; one is needed")
    count = math.lcm(*(p.location.shape[0] for p in parts))
    location = torch.cat([_repeated(p.location, count) for p in parts])
    return Predictive(
        location=location,
        noise=_pooled_spread([p.noise for p in parts], parts, count),
        epistemic=_pooled_spread([p.epistemic for p in parts], parts, count),
        joint=all(_is_joint(p) for p in parts),
        draws=_pooled_draws(parts),
    )


def _repeated(tensor: Tensor, count: int) -> Tensor:
    return tensor.repeat_interleave(count // tensor.shape[0], 0)


def _pooled_spread(
    spreads: Sequence[Tensor | None], parts: Sequence[Predictive], count: int
) -> Tensor | None:
    """Spreads of all components, 0 where a distribution has none and another has."""
    if all(s is None for s in spreads):
        return None
    full = [
        torch.zeros_like(p.location) if s is None else s.expand_as(p.location)
        for s, p in zip(spreads, parts, strict=True)
    ]
    return torch.cat([_repeated(s, count) for s in full])


def _is_joint(p: Predictive) -> bool:
    """Whether components are whole trajectories; a deterministic one is."""
    return p.joint or (len(p.location) == 1 and p.noise is None and p.epistemic is None)


def _pooled_draws(parts: Sequence[Predictive]) -> Tensor | None:
    """As many joint draws of every distribution, where one has to be drawn from."""
    if all(p.draws is None for p in parts):
        return None
    paths = [p.location if p.draws is None and _is_joint(p) else p.draws for p in parts]
    known = [path for path in paths if path is not None]
    if len(known) < len(parts):
        return None
    count = math.lcm(*(len(path) for path in known))
    return torch.cat([_repeated(path, count) for path in known])


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


def _check_broadcast(what: str, tensor: Tensor | None, shape: torch.Size) -> None:
    if tensor is None:
        return
    padded = (1,) * (len(shape) - tensor.ndim) + tuple(tensor.shape)
    if len(padded) != len(shape) or any(
        a not in (1, b) for a, b in zip(padded, shape, strict=True)
    ):
        raise ValueError(f"{what} has shape {tuple(tensor.shape)}; location has {tuple(shape)}")
