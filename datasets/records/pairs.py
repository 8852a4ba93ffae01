"""Regression data with missing targets and group columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.records.agreement import labels_of
from zoo.datasets.records.checks import Groups, distinct_names, group_columns, rows_of, units_of
from zoo.datasets.records.labelled import check_same_items, items
from zoo.datasets.split import matching_rows, named_columns, split_rows
from zoo.display import facts
from zoo.types import Layout

__all__ = ["Pairs"]


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
    provenance: str = "own"

    def __repr__(self) -> str:
        """Sizes, targets, units and groups in one line."""
        units = "/".join(dict.fromkeys(u for u in self.units if u)) or "no unit"
        return (
            f"Pairs {self.name!r} ({self.provenance}): {len(self)} items of {len(self.features)} "
            f"features, {len(self.channels)} targets in {units}, "
            f"groups {', '.join(self.groups) or 'none'}"
        )

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "items": len(self),
            "features": self.features,
            "targets": self.channels,
            "units": tuple(dict.fromkeys(u or "no unit" for u in self.units)),
            "groups": tuple(f"{k} ({len(set(v))})" for k, v in self.groups.items()),
            "provenance": self.provenance,
        }
        return facts(f"Pairs {self.name!r}", rows)

    @classmethod
    def from_arrays(
        cls,
        inputs: Any,
        targets: Any,
        *,
        features: Sequence[str] | None = None,
        feature_units: str | Sequence[str] = "",
        channels: Sequence[str] | None = None,
        units: str | Sequence[str] = "",
        groups: Mapping[str, Sequence[object]] | None = None,
        name: str = "pairs",
        provenance: str = "own",
    ) -> Self:
        """Pairs from arrays (item, feature) and (item, target); NaN marks a missing target.

        Masked entries are missing too. Frames (pandas, polars, Arrow) and xarray's arrays tell
        names and units themselves; the index of both, where they have one, must be the same.

        >>> import numpy as np
        >>> pairs = Pairs.from_arrays(np.zeros((4, 3)), np.ones(4), channels=["f_z"], units="N")
        >>> pairs.inputs.shape, pairs.targets.shape, pairs.units
        (torch.Size([4, 3]), torch.Size([4, 1]), ('N',))
        """
        given, asked = items(inputs, features, "inputs"), items(targets, channels, "targets")
        check_same_items(given, asked)
        x, y = given.part.values, asked.part.values
        if len(x) != len(y):
            raise ValueError(f"inputs have {len(x)} items, targets {len(y)}")
        if np.isnan(x).any():
            row, column = np.argwhere(np.isnan(x))[0]
            raise ValueError(f"inputs must be complete; item {row}, feature {column} is missing")
        x, names, known_units = labels_of(given.part, features, feature_units)
        y, asked_names, asked_units = labels_of(asked.part, channels, units)
        names = distinct_names(names, x.shape[1], "feature")
        targets_ = distinct_names(asked_names, y.shape[1], "target")
        return cls(
            inputs=torch.from_numpy(x.copy()),
            targets=torch.from_numpy(np.nan_to_num(y, copy=True)),
            mask=torch.from_numpy(~np.isnan(y)),
            features=names,
            feature_units=units_of(known_units, len(names)),
            channels=targets_,
            units=units_of(asked_units, len(targets_)),
            groups=group_columns(groups, len(x), "items", "item"),
            name=name,
            provenance=provenance,
        )

    def __len__(self) -> int:
        """Number of items."""
        return int(self.inputs.shape[0])

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor | NDArray[Any]) -> Self:
        """A subset of the items: by numbers, a slice, or a truth value for each."""
        rows = rows_of(index, len(self))
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

    def split(self, *, by: str, parts: Sequence[float], seed: int = 0) -> list[Self]:
        """Parts in the given shares that have no value of group column ``by`` in common.

        ``by="frame"`` deals single items. See :func:`zoo.datasets.split.split_rows`.

        >>> pairs = Pairs.from_arrays(np.zeros((6, 3)), np.ones(6), groups={"series": "aabbcc"})
        >>> [len(part) for part in pairs.split(by="series", parts=(2, 1))]
        [4, 2]
        """
        rows = split_rows(self.groups, by=by, parts=parts, seed=seed, count=len(self))
        return [self[part] for part in rows]

    def select(
        self, channels: Sequence[str] | None = None, *, features: Sequence[str] | None = None
    ) -> Self:
        """The named targets and features, in the order named; None keeps all.

        >>> pairs = Pairs.from_arrays(np.zeros((6, 3)), np.ones(6))
        >>> pairs.select(features=["feature_2"]).inputs.shape
        torch.Size([6, 1])
        """
        t = named_columns(self.channels, self.channels if channels is None else channels, "target")
        x = named_columns(self.features, self.features if features is None else features, "feature")
        return replace(
            self,
            inputs=self.inputs[:, x],
            targets=self.targets[:, t],
            mask=self.mask[:, t],
            features=tuple(self.features[i] for i in x),
            feature_units=tuple(self.feature_units[i] for i in x),
            channels=tuple(self.channels[i] for i in t),
            units=tuple(self.units[i] for i in t),
        )

    def where(self, **columns: object) -> Self:
        """The items whose group columns have the given values (a list: any of them)."""
        return self[matching_rows(self.groups, columns, len(self))]

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
