"""The record that models return: a Gaussian mixture with its joint draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zoo.streams import seeded

__all__ = ["Deferred", "Predictive", "pooled"]


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
    model knows it in closed form; the variance between components counts as epistemic too.
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
            draws=self.redrawn(lambda draws: draws * scale + shift, self.location.shape[1:]),
        )

    def stretched(self, factor: Float[Tensor, "..."]) -> Predictive:
        """The distribution stretched about its mean; ``factor`` is broadcast over its entries.

        >>> p = Predictive(location=torch.tensor([[0.0], [2.0]]), noise=torch.ones(1))
        >>> p.stretched(torch.tensor(2.0)).location.flatten().tolist()
        [-1.0, 3.0]
        """
        mean = self.location.mean(0)

        def widened(part: Tensor) -> Tensor:
            moved: Tensor = mean + factor * (part - mean)
            return moved

        return Predictive(
            location=widened(self.location),
            noise=None if self.noise is None else self.noise * factor,
            epistemic=None if self.epistemic is None else self.epistemic * factor,
            joint=self.joint,
            draws=self.redrawn(widened, mean.shape),
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

        A single component stands for as many equal ones as others have. Raises ValueError where one
        has noise, epistemic or draws and another has not.

        >>> one = Predictive(location=torch.zeros(1, 2, 3), noise=torch.ones(3))
        >>> Predictive.concat([one, one]).location.shape
        torch.Size([1, 4, 3])
        """
        count = max(len(part.location) for part in parts)
        wide = [_components(part, count).map(lambda tensor: tensor) for part in parts]
        return cls(
            location=torch.cat([p.location for p in wide], 1),
            noise=_joined("noise", [p.noise for p in wide]),
            epistemic=_joined("epistemic", [p.epistemic for p in wide]),
            joint=all(p.joint for p in wide),
            draws=_joined_draws([p._held for p in wide]),
        )

    def redrawn(
        self, change: Callable[[Tensor], Tensor], shape: Sequence[int] | None = None
    ) -> Deferred | Tensor | None:
        """The draws after ``change``, each by itself, deferred where they are.

        ``shape`` is that of a draw after it, where known.
        """
        if not isinstance(self._held, Deferred):
            return None if self._held is None else change(self._held)
        count, *rest = self._held.shape
        if shape is None:
            shape = change(self.location.new_zeros(()).expand(1, *rest)).shape[1:]
        return self._held.map(change, (count, *shape))

    @property
    def _held(self) -> Deferred | Tensor | None:
        held: Deferred | Tensor | None = self.__dict__["_draws"]
        return held


def _components(part: Predictive, count: int) -> Predictive:
    """The same distribution by ``count`` components, where it has one."""
    if len(part.location) in (1, count) and count > 1:
        location = part.location.expand(count, *part.location.shape[1:])
        return replace(part, location=location, draws=part._held)
    return part


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


def _check_broadcast(what: str, tensor: Tensor | None, shape: torch.Size) -> None:
    if tensor is None:
        return
    padded = (1,) * (len(shape) - tensor.ndim) + tuple(tensor.shape)
    if len(padded) != len(shape) or any(
        a not in (1, b) for a, b in zip(padded, shape, strict=True)
    ):
        raise ValueError(f"{what} has shape {tuple(tensor.shape)}; location has {tuple(shape)}")
