"""Typed records of movement data: ragged sequences with missing entries, and regression pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from zoo.types import Layout

__all__ = ["Groups", "Pairs", "Sequences"]

Groups = dict[str, tuple[str, ...]]


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Movements of unequal length: values in ``units``, one row of ``groups`` for each movement.

    ``values`` is padded to the longest movement; padding and missing entries hold 0 and are False
    in ``mask``. ``controls`` are known inputs of every frame (actions), with their own names.
    ``rate`` is in Hz. ``provenance`` is ``public``, ``thesis`` or ``simulated``.
    """

    values: Float[Tensor, "sequence time channel"]
    mask: Bool[Tensor, "sequence time channel"]
    lengths: Int[Tensor, " sequence"]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate: float
    groups: Groups = field(default_factory=dict)
    controls: Float[Tensor, "sequence time control"] | None = None
    control_names: tuple[str, ...] = ()
    control_units: tuple[str, ...] = ()
    name: str = "sequences"
    provenance: str = "public"

    @classmethod
    def from_arrays(
        cls,
        arrays: Sequence[ArrayLike] | NDArray[np.floating],
        *,
        rate: float,
        channels: Sequence[str] | None = None,
        units: str | Sequence[str] = "",
        groups: Mapping[str, Sequence[object]] | None = None,
        controls: Sequence[ArrayLike] | None = None,
        control_names: Sequence[str] | None = None,
        control_units: str | Sequence[str] = "",
        name: str = "sequences",
        provenance: str = "public",
    ) -> Self:
        """Sequences from a list of arrays (time, channel); NaN marks a missing entry.

        >>> import numpy as np
        >>> data = Sequences.from_arrays([np.zeros((5, 2)), np.ones((7, 2))], rate=100.0,
        ...     channels=["hip", "knee"], units="rad", groups={"subject": ["a", "b"]})
        >>> len(data), data.lengths.tolist(), data.channels
        (2, [5, 7], ('hip', 'knee'))
        """
        parts = [_matrix(a, f"sequence {i}") for i, a in enumerate(arrays)]
        if not parts:
            raise ValueError("arrays is empty; at least one sequence is needed")
        if not rate > 0:
            raise ValueError(f"rate must be positive, in Hz; got {rate}")
        names = _names(channels, parts[0].shape[1], "channel")
        values, mask, lengths = _pad(parts, len(names), "channels")
        known = None if controls is None else _pad_controls(controls, lengths)
        width = 0 if known is None else known.shape[2]
        return cls(
            values=values,
            mask=mask,
            lengths=lengths,
            channels=names,
            units=_units(units, len(names)),
            rate=float(rate),
            groups=_groups(groups, len(parts), "sequences", "trial"),
            controls=known,
            control_names=_names(control_names, width, "control"),
            control_units=_units(control_units, width),
            name=name,
            provenance=provenance,
        )

    def __len__(self) -> int:
        """Number of movements."""
        return int(self.values.shape[0])

    def __getitem__(self, index: int | slice | Sequence[int]) -> Self:
        """A subset of the movements."""
        rows = _rows(index, len(self))
        lengths = self.lengths[rows]
        end = int(lengths.max()) if len(rows) else 0
        return replace(
            self,
            values=self.values[rows, :end],
            mask=self.mask[rows, :end],
            lengths=lengths,
            controls=None if self.controls is None else self.controls[rows, :end],
            groups={k: tuple(v[i] for i in rows) for k, v in self.groups.items()},
        )

    @property
    def layout(self) -> Layout:
        """Names, units, rate and (where all are equal) the length of the movements."""
        equal = bool((self.lengths == self.lengths[0]).all())
        return Layout(
            kind="sequences",
            channels=self.channels,
            units=self.units,
            inputs=self.control_names,
            input_units=self.control_units,
            rate=self.rate,
            frames=int(self.lengths[0]) if equal else None,
        )

    @property
    def arrays(self) -> list[NDArray[np.float64]]:
        """The movements as numpy arrays (time, channel) with NaN where an entry is missing."""
        full = torch.where(self.mask, self.values, torch.nan).double().numpy()
        return [full[i, : int(n)] for i, n in enumerate(self.lengths)]

    def first(self, frames: int) -> Self:
        """The first ``frames`` frames of every movement."""
        return self.frames(0, frames)

    def frames(self, start: int, stop: int) -> Self:
        """Frames ``start`` to ``stop`` (exclusive) of every movement; all must be long enough."""
        if not 0 <= start < stop:
            raise ValueError(f"frames needs 0 <= start < stop; got {start}, {stop}")
        short = int(self.lengths.min())
        if stop > short:
            raise ValueError(
                f"frames up to {stop} were asked for; the shortest movement has {short}"
            )
        return replace(
            self,
            values=self.values[:, start:stop],
            mask=self.mask[:, start:stop],
            lengths=torch.full_like(self.lengths, stop - start),
            controls=None if self.controls is None else self.controls[:, start:stop],
        )

    def to(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """The record with its values in another type or on another device."""
        return replace(
            self,
            values=self.values.to(device=device, dtype=dtype),
            mask=self.mask.to(device=device),
            lengths=self.lengths.to(device=device),
            controls=None
            if self.controls is None
            else self.controls.to(device=device, dtype=dtype),
        )


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Regression data: ``inputs`` and ``targets`` of every item, with group columns.

    Missing targets hold 0 and are False in ``mask``; inputs must be complete.
    """

    inputs: Float[Tensor, "item feature"]
    targets: Float[Tensor, "item target"]
    mask: Bool[Tensor, "item target"]
    features: tuple[str, ...]
    feature_units: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    groups: Groups = field(default_factory=dict)
    name: str = "pairs"
    provenance: str = "public"

    @classmethod
    def from_arrays(
        cls,
        inputs: ArrayLike,
        targets: ArrayLike,
        *,
        features: Sequence[str] | None = None,
        feature_units: str | Sequence[str] = "",
        channels: Sequence[str] | None = None,
        units: str | Sequence[str] = "",
        groups: Mapping[str, Sequence[object]] | None = None,
        name: str = "pairs",
        provenance: str = "public",
    ) -> Self:
        """Pairs from arrays (item, feature) and (item, target); NaN marks a missing target.

        >>> import numpy as np
        >>> pairs = Pairs.from_arrays(np.zeros((4, 3)), np.ones(4), channels=["f_z"], units="N")
        >>> pairs.inputs.shape, pairs.targets.shape, pairs.units
        (torch.Size([4, 3]), torch.Size([4, 1]), ('N',))
        """
        x = _matrix(inputs, "inputs")
        t = np.asarray(targets, dtype=np.float64)
        y = _matrix(t[:, None] if t.ndim == 1 else t, "targets")
        if len(x) != len(y):
            raise ValueError(f"inputs have {len(x)} items, targets {len(y)}")
        if np.isnan(x).any():
            row, column = np.argwhere(np.isnan(x))[0]
            raise ValueError(f"inputs must be complete; item {row}, feature {column} is NaN")
        names = _names(features, x.shape[1], "feature")
        targets_ = _names(channels, y.shape[1], "target")
        return cls(
            inputs=torch.from_numpy(x.copy()),
            targets=torch.from_numpy(np.nan_to_num(y, copy=True)),
            mask=torch.from_numpy(~np.isnan(y)),
            features=names,
            feature_units=_units(feature_units, len(names)),
            channels=targets_,
            units=_units(units, len(targets_)),
            groups=_groups(groups, len(x), "items", "item"),
            name=name,
            provenance=provenance,
        )

    def __len__(self) -> int:
        """Number of items."""
        return int(self.inputs.shape[0])

    def __getitem__(self, index: int | slice | Sequence[int]) -> Self:
        """A subset of the items."""
        rows = _rows(index, len(self))
        return replace(
            self,
            inputs=self.inputs[rows],
            targets=self.targets[rows],
            mask=self.mask[rows],
            groups={k: tuple(v[i] for i in rows) for k, v in self.groups.items()},
        )

    @property
    def layout(self) -> Layout:
        """Names and units of features and targets."""
        return Layout(
            kind="pairs",
            channels=self.channels,
            units=self.units,
            inputs=self.features,
            input_units=self.feature_units,
        )

    def to(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """The record with its values in another type or on another device."""
        return replace(
            self,
            inputs=self.inputs.to(device=device, dtype=dtype),
            targets=self.targets.to(device=device, dtype=dtype),
            mask=self.mask.to(device=device),
        )


def _matrix(array: ArrayLike, what: str) -> NDArray[np.float64]:
    matrix = np.asarray(array, dtype=np.float64)
    if matrix.ndim != 2 or 0 in matrix.shape:
        raise ValueError(f"{what} must be a non-empty matrix; got shape {matrix.shape}")
    if np.isinf(matrix).any():
        row, column = np.argwhere(np.isinf(matrix))[0]
        raise ValueError(f"{what} is infinite at row {row}, column {column}")
    return matrix


def _pad(parts: list[NDArray[np.float64]], width: int, what: str) -> tuple[Tensor, Tensor, Tensor]:
    lengths = torch.tensor([len(p) for p in parts])
    full = np.full((len(parts), int(lengths.max()), width), np.nan)
    for i, part in enumerate(parts):
        if part.shape[1] != width:
            raise ValueError(f"sequence {i} has {part.shape[1]} {what}; the first has {width}")
        full[i, : len(part)] = part
    values = torch.from_numpy(full)
    return torch.nan_to_num(values), ~torch.isnan(values), lengths


def _pad_controls(controls: Sequence[ArrayLike], lengths: Tensor) -> Tensor:
    parts = [_matrix(c, f"controls of sequence {i}") for i, c in enumerate(controls)]
    if [len(p) for p in parts] != lengths.tolist():
        raise ValueError("controls and arrays must have the same lengths, sequence by sequence")
    if any(np.isnan(p).any() for p in parts):
        raise ValueError("controls must be complete; found NaN")
    return _pad(parts, parts[0].shape[1], "controls")[0]


def _names(names: Sequence[str] | None, count: int, what: str) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{what}_{i}" for i in range(count))
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{count} distinct {what} names are needed; got {list(names)}")
    return tuple(names)


def _units(units: str | Sequence[str], count: int) -> tuple[str, ...]:
    if isinstance(units, str):
        return (units,) * count
    if len(units) != count:
        raise ValueError(f"{count} units are needed; got {list(units)}")
    return tuple(units)


def _groups(
    groups: Mapping[str, Sequence[object]] | None, count: int, what: str, default: str
) -> Groups:
    if groups is None:
        return {default: tuple(str(i) for i in range(count))}
    for key, column in groups.items():
        if len(column) != count:
            raise ValueError(f"group column {key!r} has {len(column)} rows for {count} {what}")
    return {key: tuple(str(v) for v in column) for key, column in groups.items()}


def _rows(index: int | slice | Sequence[int], count: int) -> list[int]:
    if isinstance(index, slice):
        return list(range(count))[index]
    rows = [index] if isinstance(index, int) else [int(i) for i in index]
    if any(not -count <= r < count for r in rows):
        raise IndexError(f"row {max(rows, key=abs)} of {count}")
    return [r % count for r in rows]
