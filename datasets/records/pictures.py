"""Pictures of movements: every movement over time, a panel a channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from zoo.arguments import names_of
from zoo.datasets.split import named_columns
from zoo.display import BLUE, clean, facts, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["picture", "shown"]

MOST = 4


class Movements(Protocol):
    """What is drawn: padded movements with their names, units and rate."""

    @property
    def values(self) -> Tensor: ...
    @property
    def mask(self) -> Tensor: ...
    @property
    def lengths(self) -> Tensor: ...
    @property
    def channels(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...
    @property
    def rate(self) -> float: ...
    @property
    def groups(self) -> Mapping[str, tuple[str, ...]]: ...
    @property
    def name(self) -> str: ...
    @property
    def provenance(self) -> str: ...
    @property
    def notes(self) -> tuple[str, ...]: ...


def picture(data: Movements, ax: Axes | None, channels: str | Sequence[str] | None) -> Figure:
    """Every movement over time, a line each with gaps where entries are missing."""
    indices = _chosen(data, channels, 1 if ax is not None else MOST)
    figure, axes = panels(ax, len(indices))
    shown = torch.where(data.mask, data.values.double(), torch.nan).cpu()
    lengths = data.lengths.tolist()
    for panel, index in zip(axes, indices, strict=True):
        for row, frames in zip(shown, lengths, strict=True):
            time = [t / data.rate for t in range(frames)]
            strength = max(0.15, min(0.8, 8 / len(shown)))
            panel.plot(time, row[:frames, index].tolist(), color=BLUE, lw=1.1, alpha=strength)
        panel.set_title(data.channels[index], fontsize=10, loc="left")
        panel.set_ylabel(data.units[index] or "value")
        clean(panel)
    for panel in axes[-2:] if len(axes) > 1 else axes:
        panel.set_xlabel("time (s)")
    return figure


def shown(data: Movements) -> str:
    """Sizes, names, units and groups as HTML."""
    lengths = sorted(set(data.lengths.tolist()))
    entries = int(data.lengths.sum()) * len(data.channels)
    rows: dict[str, object] = {
        "movements": len(data.values),
        "frames": f"{lengths[0]}–{lengths[-1]}" if len(lengths) > 1 else max(lengths, default=0),
        "rate": f"{data.rate:g} Hz",
        "channels": data.channels,
        "units": tuple(dict.fromkeys(u or "no unit" for u in data.units)),
        "missing": f"{1 - float(data.mask.sum()) / max(entries, 1):.1%}",
        "groups": tuple(f"{k} ({len(set(v))})" for k, v in data.groups.items()),
        "provenance": data.provenance,
    }
    notes = {"notes": "; ".join(data.notes)} if data.notes else {}
    return facts(f"Sequences {data.name!r}", rows | notes)


def _chosen(data: Movements, channels: str | Sequence[str] | None, most: int) -> list[int]:
    """The channels named, else those that move most beside their own unit."""
    if channels is not None:
        names = [channels] if isinstance(channels, str) else names_of(channels, "channels")
        if not names:
            raise ValueError(f"channels must name at least one of {', '.join(data.channels)}")
        return named_columns(data.channels, names, "channel")
    if not len(data.values):
        raise ValueError("there is no movement to draw")
    count = data.mask.sum((0, 1)).clamp(min=1)
    mean = data.values.sum((0, 1)) / count
    spread = (((data.values - mean) * data.mask).square().sum((0, 1)) / count).double()
    return sorted(spread.topk(min(most, len(spread))).indices.tolist())
