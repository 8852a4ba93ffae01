"""Scaling fitted on training data: it travels in the run and brings predictions back to units."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.datasets.records import Pairs, Sequences
from zoo.errors import UnlikeUnitsWarning

__all__ = ["Kind", "Scaler", "suited"]

Kind = Literal["standard", "center", "range", "none"]
_Record = TypeVar("_Record", Pairs, Sequences)
_FLAT = 1e-9
POOLED = 0.2
APART = 30.0


@dataclass(frozen=True, kw_only=True)
class Scaler:
    """An affine map a channel: original = scaled · scale + shift, from observed entries only.

    ``standard`` gives mean 0 and variance 1; ``center`` gives mean 0 and divides all channels by
    one number, so that their root mean square is 0.2 whatever their unit: walking has 0.11 rad, a
    robot arm 0.24 rad, the movements of the thesis 0.28 rad, and priors, learning rates and floors
    were chosen there. ``range`` gives mean 0 and values within [−1, 1] (§5.3.1), ``none`` leaves
    everything. ``constant`` names channels that do not vary, as measured by those of their unit;
    ``standard`` and ``range`` give them a scale of 1. Inputs of pairs and controls of sequences
    have their own map.
    """

    kind: Kind
    channel_scale: Float[Tensor, " channel"]
    channel_shift: Float[Tensor, " channel"]
    input_scale: Float[Tensor, " input"]
    input_shift: Float[Tensor, " input"]
    constant: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a map that could not be undone."""
        if self.kind not in get_args(Kind):
            raise ValueError(f"scaling is one of {', '.join(get_args(Kind))}; got {self.kind!r}")
        for what in ("channel", "input"):
            scale, shift = getattr(self, f"{what}_scale"), getattr(self, f"{what}_shift")
            if scale.ndim != 1 or scale.shape != shift.shape:
                got = f"{tuple(scale.shape)} and {tuple(shift.shape)}"
                raise ValueError(f"{what} scale and shift must be two equal vectors; got {got}")
            if not bool((scale > 0).all() and scale.isfinite().all() and shift.isfinite().all()):
                raise ValueError(f"{what} scale must be positive and finite, shift finite")

    @classmethod
    def fit(cls, data: Pairs | Sequences, kind: Kind = "standard") -> Scaler:
        """The map of the training data.

        Warns of ``center`` where channels, or inputs, have several units
        (:class:`~zoo.errors.UnlikeUnitsWarning`).

        >>> import numpy as np
        >>> data = Sequences.from_arrays([np.array([[1.0, 5.0], [3.0, 5.0]])], rate=1.0)
        >>> scaler = Scaler.fit(data, "standard")
        >>> scaler.channel_shift.tolist(), scaler.channel_scale.tolist(), scaler.constant
        ([2.0, 5.0], [1.0, 1.0], ('channel_1',))
        """
        layout = data.layout
        values, mask = _observed(data)
        scale, shift, flat = _moments(values, mask, layout.units, kind)
        known = _inputs(data)
        seen = torch.ones_like(known, dtype=torch.bool)
        input_scale, input_shift, _ = _moments(known, seen, layout.input_units, kind)
        return cls(
            kind=kind,
            channel_scale=scale,
            channel_shift=shift,
            input_scale=input_scale,
            input_shift=input_shift,
            constant=tuple(n for n, f in zip(data.channels, flat.tolist(), strict=True) if f),
        )

    def apply(self, data: _Record) -> _Record:
        """The data in scaled numbers; missing entries stay 0."""
        if isinstance(data, Pairs):
            inputs = (data.inputs - self.input_shift) / self.input_scale
            return replace(data, inputs=inputs, targets=self._scaled(data.targets, data.mask))
        known = data.controls
        if known is not None:
            known = (known - self.input_shift) / self.input_scale
        return replace(data, values=self._scaled(data.values, data.mask), controls=known)

    def to_json(self) -> dict[str, Any]:
        """The map as plain numbers."""
        names = ("channel_scale", "channel_shift", "input_scale", "input_shift")
        tensors = {n: getattr(self, n).tolist() for n in names}
        return {"kind": self.kind, "constant": list(self.constant), **tensors}

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> Scaler:
        """What :meth:`to_json` gave."""
        tensors = {
            k: torch.tensor(v, dtype=torch.float64)
            for k, v in saved.items()
            if k not in ("kind", "constant")
        }
        return cls(kind=saved["kind"], constant=tuple(saved["constant"]), **tensors)

    def _scaled(self, values: Tensor, mask: Tensor) -> Tensor:
        scaled = (values - self.channel_shift).div_(self.channel_scale)
        return scaled if bool(mask.all()) else scaled.masked_fill_(~mask, 0.0)


def suited(data: Pairs | Sequences, kind: Kind) -> Kind:
    """``kind``, or ``standard`` where ``center`` would divide by one number what has none.

    Channels of several units have none, and channels without a unit whose standard deviations
    differ by more than a factor of 30. An :class:`~zoo.errors.UnlikeUnitsWarning` says so.
    """
    if kind != "center":
        return kind
    values, mask = _observed(data)
    std = _moments(values, mask, data.units, "standard")[0]
    kinds = list(dict.fromkeys(data.units))
    apart = float(std.max() / std.min())
    if len(kinds) > 1:
        told = f"channels are in {', '.join(u or 'no unit' for u in kinds)}"
    elif kinds == [""] and apart > APART:
        told = (
            f"channels have no unit and standard deviations that differ by a factor of {apart:.3g}"
        )
    else:
        return kind
    warnings.warn(
        f"{told}: scaling='standard' is used, where this model takes 'center'; scaling='center' "
        "says that one scale suits all",
        UnlikeUnitsWarning,
        stacklevel=5,
    )
    return "standard"


def _observed(data: Pairs | Sequences) -> tuple[Tensor, Tensor]:
    values = data.targets if isinstance(data, Pairs) else data.values
    width = values.shape[-1]
    return values.double().reshape(-1, width), data.mask.reshape(-1, width)


def _inputs(data: Pairs | Sequences) -> Tensor:
    if isinstance(data, Pairs):
        return data.inputs.double()
    if data.controls is None:
        return torch.empty(0, 0, dtype=torch.float64)
    inside = torch.arange(data.controls.shape[1]) < data.lengths[:, None]
    return data.controls[inside].double()


def _moments(
    values: Float[Tensor, "row channel"],
    mask: Bool[Tensor, "row channel"],
    units: Sequence[str],
    kind: Kind,
) -> tuple[Tensor, Tensor, Tensor]:
    """Scale, shift and the channels that are constant."""
    count = mask.sum(0).clamp(min=1)
    mean = torch.where(mask, values, 0.0).sum(0) / count
    centred = torch.where(mask, values - mean, 0.0)
    std = (centred.square().sum(0) / count).sqrt()
    flat = std <= _FLAT * _sizes((std.square() + mean.square()).sqrt(), units)
    scale = _SCALES[kind](centred, std, units)
    shift = torch.zeros_like(mean) if kind == "none" else mean
    idle = flat.all() if kind == "center" else flat
    return torch.where(idle, 1.0, scale), shift, flat


def _sizes(size: Float[Tensor, " channel"], units: Sequence[str]) -> Float[Tensor, " channel"]:
    """The largest of the channels that have the same unit."""
    same = torch.tensor([[a == b for b in units] for a in units]).view(len(units), len(units))
    largest: Tensor = (same * size).amax(1) if len(units) else size
    return largest


def _own(centred: Tensor, std: Tensor, units: Sequence[str]) -> Float[Tensor, " channel"]:
    return std


def _widest(centred: Tensor, std: Tensor, units: Sequence[str]) -> Float[Tensor, " channel"]:
    """The largest distance from the mean."""
    return centred.abs().amax(0) if len(centred) else std


def _one(centred: Tensor, std: Tensor, units: Sequence[str]) -> Float[Tensor, " channel"]:
    return torch.ones_like(std)


def _pooled(centred: Tensor, std: Tensor, units: Sequence[str]) -> Float[Tensor, " channel"]:
    """One scale for all channels, under which their root mean square is 0.2."""
    kinds = list(dict.fromkeys(units))
    if len(kinds) > 1:
        warnings.warn(
            f"scaling='center' divides channels in {', '.join(u or 'no unit' for u in kinds)} by "
            "one number, which depends on these units: take scaling='standard'",
            UnlikeUnitsWarning,
            stacklevel=5,
        )
    return (std.square().mean().sqrt() / POOLED).expand_as(std)


_SCALES: dict[Kind, Callable[[Tensor, Tensor, Sequence[str]], Tensor]] = {
    "standard": _own,
    "center": _pooled,
    "range": _widest,
    "none": _one,
}
