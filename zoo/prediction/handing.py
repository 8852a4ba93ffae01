"""Predictions handed on: as a frame of pandas, as a data set of xarray, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from zoo.arguments import level_of, names_of, whole_number
from zoo.display import BLUE, clean, panels, partner

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["as_frame", "as_xarray", "band_panel", "picture", "told"]

ALPHAS = (0.22, 0.38)
MOST = 4


class Told(Protocol):
    """What is asked of a prediction here."""

    @property
    def axes(self) -> tuple[str, ...]: ...
    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...
    @property
    def task(self) -> str: ...
    @property
    def rate(self) -> float | None: ...
    @property
    def offset(self) -> int: ...
    @property
    def lengths(self) -> Tensor | None: ...
    @property
    def seconds(self) -> Tensor | None: ...
    @property
    def has_spread(self) -> bool: ...
    @property
    def mean(self) -> Tensor: ...
    @property
    def std(self) -> Tensor: ...
    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Central interval of that probability."""
        ...

    def channel(self, name: str) -> int:
        """Index of a channel or target by name."""
        ...


def told(prediction: Told, *, calibrated: bool) -> dict[str, object]:
    """What a notebook shows of a prediction, by name."""
    rows: dict[str, object] = dict(zip(prediction.axes, prediction.shape, strict=True))
    rows[f"{prediction.axes[-1]}s"] = prediction.names
    rows["units"] = tuple(dict.fromkeys(prediction.units))
    if not prediction.has_spread:
        return {**rows, "bands": "none: the answer is deterministic"}
    return {**rows, "bands": "calibrated" if calibrated else "as the model gave them"}


def as_xarray(prediction: Told, level: float = 0.9) -> xarray.Dataset:
    """Mean, standard deviation and band over named axes, with units; NaN after a movement's end."""
    library = partner("xarray", "Prediction.to_xarray")
    inside = _inside(prediction)
    values = {n: v.double().where(inside, torch.nan) for n, v in _columns(prediction, level)}
    coordinates: dict[str, Any] = {prediction.axes[-1]: list(prediction.names)}
    coordinates["unit"] = (prediction.axes[-1], list(prediction.units))
    if "time" in prediction.axes:
        coordinates["time"] = ("time", _clock(prediction), {"units": _time_unit(prediction)})
    found: xarray.Dataset = library.Dataset(
        {n: (prediction.axes, v.cpu().numpy()) for n, v in values.items()},
        coords=coordinates,
        attrs={"task": prediction.task, "level": level_of(level)},
    )
    return found


def as_frame(prediction: Told, level: float = 0.9) -> pandas.DataFrame:
    """A row for every sequence, time and channel; without those after a movement's end."""
    pandas = partner("pandas", "Prediction.to_pandas")
    inside = _inside(prediction).flatten()
    index = torch.cartesian_prod(*(torch.arange(n) for n in prediction.shape))[inside]
    columns: dict[str, Any] = {}
    for axis, number in zip(prediction.axes, index.T.tolist(), strict=True):
        if axis == "time":
            clock = _clock(prediction)
            columns["time"] = [clock[i] for i in number]
        elif axis == prediction.axes[-1]:
            columns[axis] = [prediction.names[i] for i in number]
            columns["unit"] = [prediction.units[i] for i in number]
        else:
            columns[axis] = number
    found = {n: v.flatten()[inside].double().tolist() for n, v in _columns(prediction, level)}
    return pandas.DataFrame(columns | found)


def picture(
    prediction: Told,
    ax: Axes | None,
    sequence: int,
    channels: str | Sequence[str] | None,
) -> Figure:
    """Mean with 50 % and 90 % bands of one movement, a panel a channel; of items over their row."""
    named = [channels] if isinstance(channels, str) else channels
    named = None if named is None else names_of(named, "channels")
    indices = _chosen(prediction, named, sequence, 1 if ax is not None else MOST)
    figure, axes = panels(ax, len(indices))
    for panel, index in zip(axes, indices, strict=True):
        band_panel(panel, prediction, sequence, index)
        panel.set_title(prediction.names[index], fontsize=10, loc="left")
        panel.set_ylabel(prediction.units[index] or "value")
        clean(panel)
    for panel in axes[-2:] if len(axes) > 1 else axes:
        panel.set_xlabel(_label(prediction))
    axes[0].legend(frameon=False, fontsize=9)
    return figure


def band_panel(
    axes: Axes, prediction: Told, sequence: int, index: int, time: list[float] | None = None
) -> None:
    """Bands and mean of one channel of one movement, or of one target of all items.

    ``time`` of its frames stands in for the prediction's own.
    """
    if "time" not in prediction.axes:
        _bars(axes, prediction, index)
        return
    length = _length(prediction, sequence)
    at = (sequence, slice(0, length), index)
    along = _clock(prediction)[:length] if time is None else time
    if prediction.has_spread:
        for level, alpha in zip((0.9, 0.5), ALPHAS, strict=True):
            low, high = (end[at].tolist() for end in prediction.interval(level))
            label = f"{round(100 * level)} % band"
            axes.fill_between(along, low, high, color=BLUE, alpha=alpha, lw=0, label=label)
    axes.plot(along, prediction.mean[at].tolist(), color=BLUE, linewidth=1.6, label="mean")


def _bars(axes: Axes, prediction: Told, index: int) -> None:
    """A point with its bands for every item: items have no order."""
    items, mean = list(range(prediction.shape[0])), prediction.mean[:, index].tolist()
    if prediction.has_spread:
        for level, width in ((0.9, 1.0), (0.5, 3.0)):
            low, high = (end[:, index].tolist() for end in prediction.interval(level))
            label = f"{round(100 * level)} % band"
            axes.vlines(items, low, high, color=BLUE, lw=width, alpha=0.6, label=label)
    axes.plot(items, mean, color=BLUE, marker="o", markersize=3, linestyle="none", label="mean")


def _columns(prediction: Told, level: float) -> list[tuple[str, Tensor]]:
    """What is told of every coordinate, by name; a deterministic answer has a mean alone."""
    level = level_of(level)
    if not prediction.has_spread:
        return [("mean", prediction.mean)]
    low, high = prediction.interval(level)
    return [("mean", prediction.mean), ("std", prediction.std), ("low", low), ("high", high)]


def _inside(prediction: Told) -> Tensor:
    """Entries that are none of the padding after a movement's end."""
    inside = torch.ones(prediction.shape, dtype=torch.bool)
    if prediction.lengths is not None:
        frame = torch.arange(prediction.shape[1])
        inside &= (frame < prediction.lengths.cpu()[:, None])[..., None]
    return inside


def _chosen(prediction: Told, names: Sequence[str] | None, sequence: int, most: int) -> list[int]:
    if "time" in prediction.axes:
        count = prediction.shape[0]
        whole_number(sequence, "sequence", 0)
        if sequence >= count:
            raise ValueError(f"sequence must be below {count}, the number of movements")
    if names is not None:
        if not len(names):
            raise ValueError(f"channels must name at least one of {', '.join(prediction.names)}")
        return [prediction.channel(name) for name in names]
    path = prediction.mean[sequence] if "time" in prediction.axes else prediction.mean
    moves = path.nan_to_num().double().var(0, correction=0)
    return sorted(moves.topk(min(most, len(moves))).indices.tolist())


def _clock(prediction: Told) -> list[float]:
    """Times in s, or numbers of frames where the data have no rate."""
    seconds = prediction.seconds
    if seconds is not None:
        return seconds.tolist()
    return [float(prediction.offset + t) for t in range(prediction.shape[1])]


def _length(prediction: Told, sequence: int) -> int:
    return prediction.shape[1] if prediction.lengths is None else int(prediction.lengths[sequence])


def _time_unit(prediction: Told) -> str:
    return "s" if prediction.rate else "frame"


def _label(prediction: Told) -> str:
    if "time" not in prediction.axes:
        return "item"
    return "time (s)" if prediction.rate else "frame"
