"""An increasing curve between normal scores, linear between knots and beyond them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Curve", "interpolate"]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """y(x), strictly increasing; the outermost pieces are continued.

    >>> double = Curve.through(torch.tensor([-1.0, 1.0]), torch.tensor([-2.0, 2.0]))
    >>> double(torch.tensor([0.5, 3.0])), double.inverse(torch.tensor([6.0]))
    (tensor([1., 6.]), tensor([3.]))
    """

    x: Float[Tensor, " knot"]
    y: Float[Tensor, " knot"]

    def __post_init__(self) -> None:
        """Refuse knots that make no increasing curve."""
        x, y = self.x, self.y
        if x.ndim != 1 or x.shape != y.shape or len(x) < 2:
            got = f"{tuple(x.shape)}, {tuple(y.shape)}"
            raise ValueError(f"a curve needs two knots or more; got {got}")
        if not all(t.is_floating_point() and bool(t.isfinite().all()) for t in (x, y)):
            raise ValueError("the knots of a curve must be finite")
        if not bool((x.diff() > 0).all() and (y.diff() >= 0).all()):
            raise ValueError("the knots of a curve must ascend")

    @classmethod
    def through(cls, x: Tensor, y: Tensor, *, from_zero: bool = False) -> Self:
        """The curve through points in ascending ``x``.

        Beyond them it follows the chord of all knots, or of the last one where it starts at
        (0, 0), so that one extreme observation does not set the slope of a tail.
        """
        if from_zero:
            x, y = torch.cat([x.new_zeros(1), x]), torch.cat([y.new_zeros(1), y])
        slope = (y[-1] - y[0]) / (x[-1] - x[0])
        slope = slope.clamp(min=1e-6)
        ends_x = [x[:1] - 10, x, x[-1:] + 10]
        ends_y = [y[:1] - 10 * slope, y, y[-1:] + 10 * slope]
        if from_zero:
            ends_x, ends_y = ends_x[1:], ends_y[1:]
        x, y = torch.cat(ends_x), torch.cat(ends_y)
        rise = 1e-9 * slope * torch.arange(len(y), dtype=y.dtype)
        return cls(x=x, y=y.cummax(0).values + rise)

    def __call__(self, x: Tensor) -> Tensor:
        """Height at ``x``."""
        return interpolate(x, self.x, self.y)

    def inverse(self, y: Tensor) -> Tensor:
        """Where the curve reaches ``y``."""
        return interpolate(y, self.y, self.x)

    def blend(self, other: Curve, share: float) -> Curve:
        """The curve at a share of the way to another, at every ``x``.

        >>> x = torch.tensor([0.0, 1.0])
        >>> Curve.through(x, x).blend(Curve.through(x, 3 * x), 0.5)(torch.tensor([2.0]))
        tensor([4.])
        """
        x = torch.cat([self.x, other.x]).unique()
        return Curve(x=x, y=torch.lerp(self(x), other(x), share))

    def state(self) -> dict[str, Tensor]:
        """Its tensors."""
        return {"curve_x": self.x, "curve_y": self.y}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        return cls(x=tensors["curve_x"], y=tensors["curve_y"])


def interpolate(x: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Linear between the knots (two or more); the outermost pieces are continued."""
    xs, ys = xs.to(x), ys.to(x)
    right = torch.searchsorted(xs, x.contiguous()).clamp(1, len(xs) - 1)
    share = (x - xs[right - 1]) / (xs[right] - xs[right - 1])
    return torch.lerp(ys[right - 1], ys[right], share)
