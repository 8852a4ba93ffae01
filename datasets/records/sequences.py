"""Movements of unequal length with missing entries, group columns and known inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from zoo.arguments import whole_number
from zoo.datasets.records.checks import (
    Groups,
    distinct_names,
    group_columns,
    pad,
    rows_of,
    units_of,
)
from zoo.datasets.records.controls import known_controls
from zoo.datasets.records.labelled import movements
from zoo.datasets.records.pictures import picture, shown
from zoo.datasets.records.resample import resample_movements
from zoo.datasets.records.windows import cut
from zoo.datasets.split import matching_rows, named_columns, split_rows
from zoo.types import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Sequences"]


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Movements of unequal length: values in ``units``, one row of ``groups`` for each movement.

    ``values`` is padded to the longest movement; padding and missing entries hold 0 and are False
    in ``mask``. ``controls`` are known inputs of every frame (actions), with their own names;
    they may run on past the last frame where those of a forecast are known.
    ``rate`` is in Hz; where ``time_normalised``, every movement was stretched to one length, and it
    is that of the mean duration. ``provenance`` is ``own``, ``public``, ``thesis`` or
    ``simulated``; ``notes`` say what a loader changed in the recording.
    """

    values: Float[Tensor, "sequence time channel"]
    mask: Bool[Tensor, "sequence time channel"]
    lengths: Int[Tensor, " sequence"]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate: float
    groups: Groups = field(default_factory=dict)
    controls: Float[Tensor, "sequence known control"] | None = None
    control_names: tuple[str, ...] = ()
    control_units: tuple[str, ...] = ()
    time_normalised: bool = False
    notes: tuple[str, ...] = ()
    name: str = "sequences"
    provenance: str = "own"

    def __repr__(self) -> str:
        """Sizes, channels, units, rate and groups in one line."""
        lengths = sorted(set(self.lengths.tolist()))
        frames = f"{lengths[0]}–{lengths[-1]}" if len(lengths) > 1 else f"{max(lengths, default=0)}"
        units = "/".join(dict.fromkeys(u for u in self.units if u)) or "no unit"
        return (
            f"Sequences {self.name!r} ({self.provenance}): {len(self)} movements of {frames} "
            f"frames at {self.rate:g} Hz, {len(self.channels)} channels in {units}, "
            f"groups {', '.join(self.groups) or 'none'}"
        )

    @classmethod
    def from_arrays(
        cls,
        arrays: Any,
        *,
        rate: float | None = None,
        channels: Sequence[str] | None = None,
        units: str | Sequence[str] = "",
        groups: Mapping[str, Sequence[object]] | None = None,
        controls: Any = None,
        control_names: Sequence[str] | None = None,
        control_units: str | Sequence[str] = "",
        time_normalised: bool = False,
        notes: Sequence[str] = (),
        name: str = "sequences",
        provenance: str = "own",
    ) -> Self:
        """Sequences from arrays (time, channel); NaN and masked entries are missing.

        ``arrays`` is a list of them, an array (movement, time, channel), or one movement as an
        array (time, channel). One dimension makes a movement only where it is named, by
        ``channels=["knee"]`` or as a labelled array. Frames (pandas, polars, Arrow) and xarray's
        arrays tell names, units, times and groups themselves (see
        :func:`~zoo.datasets.records.columns.parts_of_table` and
        :func:`~zoo.datasets.records.xarrays.parts_of_labelled`); columns are brought to the order
        of the first, or of ``channels``, by name. ``rate`` is in Hz; where the data have regular
        times it may be left out, and must agree. ``groups`` has a column with a row for each
        movement.

        Raises TypeError for what holds no real numbers and ValueError for what is irregular,
        infinite or contradictory, naming the movement.

        >>> import numpy as np
        >>> data = Sequences.from_arrays([np.zeros((5, 2)), np.ones((7, 2))], rate=100.0,
        ...     channels=["hip", "knee"], units="rad", groups={"subject": ["a", "b"]})
        >>> len(data), data.lengths.tolist(), data.channels
        (2, [5, 7], ('hip', 'knee'))
        """
        found = movements(arrays, channels=channels, units=units, rate=rate, groups=groups)
        names = distinct_names(found.names, found.arrays[0].shape[1], "channel")
        values, mask, lengths = pad(found.arrays, len(names), "channels")
        known = known_controls(controls, control_names, control_units, found.rate, lengths)
        return cls(
            values=values,
            mask=mask,
            lengths=lengths,
            channels=names,
            units=units_of(found.units, len(names)),
            rate=found.rate,
            groups=group_columns(found.groups, len(lengths), "sequences", "trial"),
            time_normalised=time_normalised,
            notes=tuple(notes),
            name=name,
            provenance=provenance,
            **known,
        )

    def _repr_html_(self) -> str:
        return shown(self)

    def plot(
        self, ax: Axes | None = None, *, channels: str | Sequence[str] | None = None
    ) -> Figure:
        """Every movement over time: the channels named, or the four that move most.

        With ``ax`` one channel is drawn there. The figure is returned, to show or to save.
        """
        return picture(self, ax, channels)

    def __len__(self) -> int:
        """Number of movements."""
        return int(self.values.shape[0])

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor | NDArray[Any]) -> Self:
        """A subset of the movements: by numbers, a slice, or a truth value for each."""
        rows = rows_of(index, len(self))
        lengths = self.lengths[rows]
        end = int(lengths.max()) if len(rows) else 0
        return replace(
            self,
            values=self.values[rows, :end],
            mask=self.mask[rows, :end],
            lengths=lengths,
            controls=None if self.controls is None else self.controls[rows, : end + self._ahead],
            groups={k: tuple(v[i] for i in rows) for k, v in self.groups.items()},
        )

    @property
    def _ahead(self) -> int:
        """Frames to come whose controls are known already."""
        return 0 if self.controls is None else self.controls.shape[1] - self.values.shape[1]

    @property
    def layout(self) -> Layout:
        """Names, units, rate (None after time normalisation) and the length all have, if any."""
        if not len(self):
            raise ValueError(f"{self.name!r} holds no movement")
        shortest, longest = int(self.lengths.min()), int(self.lengths.max())
        equal = shortest == longest
        return Layout(
            kind="sequences",
            channels=self.channels,
            units=self.units,
            inputs=self.control_names,
            input_units=self.control_units,
            rate=None if self.time_normalised else self.rate,
            frames=longest if equal else None,
            span=None if equal else (shortest, longest),
            windows="start" in self.groups,
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
        start, stop = whole_number(start, "start", 0), whole_number(stop, "frames", unit="frame")
        if not start < stop:
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

    def split(self, *, by: str, parts: Sequence[float], seed: int = 0) -> list[Self]:
        """Parts in the given shares that have no value of group column ``by`` in common.

        ``by="frame"`` takes the movements apart into single frames and deals these out, which
        puts neighbours on both sides: for models of single frames only. See
        :func:`zoo.datasets.split.split_rows`.

        >>> data = Sequences.from_arrays(np.zeros((10, 5, 2)), rate=1.0)
        >>> [len(part) for part in data.split(by="trial", parts=(.6, .1, .1, .2), seed=0)]
        [6, 1, 1, 2]
        """
        whole = self.windows(1) if by == "frame" and by not in self.groups else self
        rows = split_rows(whole.groups, by=by, parts=parts, seed=seed, count=len(whole))
        return [whole[part] for part in rows]

    def windows(self, length: int, stride: int = 1) -> Self:
        """Sub-sequences of ``length`` frames, one every ``stride`` frames, as a record of its own.

        They keep the groups of their movement and add the column ``start``, the frame of the
        movement that they start at. Frames after the last whole window are left out.

        >>> data = Sequences.from_arrays([np.zeros((5, 2)), np.zeros((7, 2))], rate=1.0)
        >>> cut = data.windows(4, stride=2)
        >>> len(cut), cut.groups
        (3, {'trial': ('0', '1', '1'), 'start': ('0', '0', '2')})
        """
        sequence, frame = cut(self.lengths, length, stride)
        before = [int(s) for s in self.groups.get("start", ("0",) * len(self))]
        owner, start = sequence[:, 0].tolist(), frame[:, 0].tolist()
        groups = {k: tuple(v[i] for i in owner) for k, v in self.groups.items()}
        groups["start"] = tuple(str(before[i] + s) for i, s in zip(owner, start, strict=True))
        return replace(
            self,
            values=self.values[sequence, frame],
            mask=self.mask[sequence, frame],
            lengths=torch.full((len(owner),), length),
            groups=groups,
            controls=None if self.controls is None else self.controls[sequence, frame],
        )

    def resampled(self, frames: int | None = None, *, rate: float | None = None) -> Self:
        """Every movement with ``frames`` frames from its first to its last, or at ``rate`` Hz.

        Linear on a finer grid, low-pass filtered on a coarser one, see
        :mod:`zoo.datasets.records.resample`. ``frames`` normalises time: ``rate`` is then that of
        the mean duration, and the layout has none.

        >>> data = Sequences.from_arrays([np.arange(9.)[:, None], np.arange(5.)[:, None]], rate=4.)
        >>> half = data.resampled(rate=2.0)
        >>> half.lengths.tolist(), half.values[0, :, 0].tolist()
        ([5, 3], [0.0, 2.0, 4.0, 6.0, 8.0])
        >>> data.resampled(3).lengths.tolist(), data.resampled(3).layout.rate
        ([3, 3], None)
        """
        grid = resample_movements(self, frames, rate)
        normalised = self.time_normalised or frames is not None
        return replace(
            self,
            values=grid.values,
            mask=grid.mask,
            lengths=grid.lengths,
            controls=grid.controls,
            rate=grid.rate,
            time_normalised=normalised,
        )

    def select(self, channels: Sequence[str]) -> Self:
        """The named channels, in the order named.

        >>> data = Sequences.from_arrays(np.zeros((1, 5, 2)), rate=1.0, channels=["hip", "knee"])
        >>> data.select(channels=["knee"]).values.shape
        torch.Size([1, 5, 1])
        """
        columns = named_columns(self.channels, channels, "channel")
        return replace(
            self,
            values=self.values[..., columns],
            mask=self.mask[..., columns],
            channels=tuple(self.channels[c] for c in columns),
            units=tuple(self.units[c] for c in columns),
        )

    def where(self, **columns: object) -> Self:
        """The movements whose group columns have the given values (a list: any of them).

        >>> data = Sequences.from_arrays(np.zeros((3, 5, 2)), rate=1.0, groups={"subject": "aab"})
        >>> len(data.where(subject="a"))
        2
        """
        return self[matching_rows(self.groups, columns, len(self))]

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
