"""Scaling fitted on training data: it travels in the run and brings predictions back to units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.records import Pairs, Sequences

__all__ = ["Kind", "Scaler"]

Kind = Literal["standard", "center", "range", "none"]
_Record = TypeVar("_Record", Pairs, Sequences)
_FLAT = 1e-9


@dataclass(frozen=True, kw_only=True)
class Scaler:
    """An affine map a channel: original = scaled · scale + shift, from observed entries only.

    ``standard`` gives mean 0 and variance 1, ``center`` mean 0, ``range`` mean 0 and values within
    [−1, 1] (§5.3.1), ``none`` leaves everything. ``constant`` names channels that do not vary;
    their scale is 1. Inputs of pairs and controls of sequences have their own map.
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

        >>> import numpy as np
        >>> data = Sequences.from_arrays([np.array([[1.0, 5.0], [3.0, 5.0]])], rate=1.0)
        >>> scaler = Scaler.fit(data, "standard")
        >>> scaler.channel_shift.tolist(), scaler.channel_scale.tolist(), scaler.constant
        ([2.0, 5.0], [1.0, 1.0], ('channel_1',))
        """
        values, mask = _observed(data)
        scale, shift, flat = _moments(values, mask, kind)
        known = _inputs(data)
        input_scale, input_shift, _ = _moments(
            known, torch.ones_like(known, dtype=torch.bool), kind
        )
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
        return torch.where(mask, (values - self.channel_shift) / self.channel_scale, 0.0)


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


def _moments(values: Tensor, mask: Tensor, kind: Kind) -> tuple[Tensor, Tensor, Tensor]:
    """Scale, shift and the channels that are constant."""
    count = mask.sum(0).clamp(min=1)
    mean = torch.where(mask, values, 0.0).sum(0) / count
    centred = torch.where(mask, values - mean, 0.0)
    spread = {
        "standard": (centred.square().sum(0) / count).sqrt(),
        "range": centred.abs().amax(0) if len(values) else centred.sum(0),
    }.get(kind, torch.ones_like(mean))
    flat = spread <= _FLAT * (1 + mean.abs())
    shift = torch.zeros_like(mean) if kind == "none" else mean
    return torch.where(flat, 1.0, spread), shift, flat
