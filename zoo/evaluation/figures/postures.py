"""Postures in figures: a strip over time (Fig. 38, 51), a map of a latent plane (Fig. 46, 50)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.bodies import Body, body_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["COLOURS", "posture_map", "posture_strip", "posture_strips"]

COLOURS = {"left": "#D55E00", "right": "#0072B2", "middle": "#444444"}
AZIMUTH, ELEVATION = math.radians(55.0), math.radians(12.0)


def posture_strip(
    axes: Axes,
    values: Float[Tensor, "time channel"],
    names: Sequence[str],
    *,
    body: Body | None = None,
    every: int = 6,
    alpha: float = 1.0,
) -> None:
    """A movement as a row of bodies, one ``every`` so many frames, from left to right."""
    body = body_for(names, body)
    flat = _projected(body.place(values[::every], names))
    _row(axes, body, flat, _step(flat), every, alpha)


def posture_strips(
    panels: Sequence[Axes],
    movements: Mapping[str, Float[Tensor, "time channel"]],
    names: Sequence[str],
    *,
    body: Body | None = None,
    every: int = 6,
) -> None:
    """Movements by name, a row of bodies each, to one scale, so that frames stand in columns."""
    body = body_for(names, body)
    flat = [_projected(body.place(values[::every], names)) for values in movements.values()]
    step, most = max(map(_step, flat)), max(map(len, flat))
    heights = np.concatenate([f[..., 1].ravel() for f in flat])
    for axes, name, rows in zip(panels, movements, flat, strict=True):
        _row(axes, body, rows, step, every, 1.0)
        axes.set(xlim=(-step, most * step), ylim=(heights.min() - 0.05, heights.max() + 0.05))
        axes.set_title(name, fontsize=10, loc="left")


def posture_map(
    axes: Axes,
    values: Float[Tensor, "row column channel"],
    names: Sequence[str],
    x: Sequence[float],
    y: Sequence[float],
    *,
    body: Body | None = None,
) -> None:
    """Bodies drawn where their latent points lie: ``x`` of the columns and ``y`` of the rows."""
    body = body_for(names, body)
    flat = _projected(body.place(values, names))
    size = float(np.ptp(flat.reshape(-1, 2), axis=0).max())
    across, up = abs(x[-1] - x[0]) / (len(x) - 1), abs(y[-1] - y[0]) / (len(y) - 1)
    scale = 0.95 / size * np.array([across, up])
    for row, height in zip(flat, y, strict=True):
        for figure, place in zip(row, x, strict=True):
            centre = (figure.min(0) + figure.max(0)) / 2
            _drawn(axes, body, (figure - centre) * scale + np.array([place, height]), 0.8, 1.0)
    axes.set_aspect(across / up)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _projected(places: Float[Tensor, "*frame joint 3"]) -> NDArray[np.float64]:
    """Seen from the side and a little from above and ahead, without perspective."""
    x, y, z = places.double().unbind(-1)
    across = x * math.cos(AZIMUTH) - z * math.sin(AZIMUTH)
    deep = x * math.sin(AZIMUTH) + z * math.cos(AZIMUTH)
    up = y * math.cos(ELEVATION) - deep * math.sin(ELEVATION)
    flat: NDArray[np.float64] = torch.stack([across, up], -1).detach().numpy()
    return flat


def _step(flat: NDArray[np.float64]) -> float:
    """Room for the widest body."""
    return 1.05 * float(np.ptp(flat[..., 0], axis=1).max())


def _row(
    axes: Axes, body: Body, flat: NDArray[np.float64], step: float, every: int, alpha: float
) -> None:
    for k, figure in enumerate(flat):
        _drawn(axes, body, figure + np.array([k * step, 0.0]), 1.2, alpha)
    _bare(axes)
    ticks = range(len(flat))
    axes.set_xticks([k * step for k in ticks], [str(k * every) for k in ticks], fontsize=7)
    axes.tick_params(length=0)


def _drawn(axes: Axes, body: Body, flat: NDArray[np.float64], width: float, alpha: float) -> None:
    for (i, j), side in zip(body.edges, body.sides, strict=True):
        axes.plot(*flat[[i, j]].T, color=COLOURS[side], lw=width, alpha=alpha)


def _bare(axes: Axes) -> None:
    axes.set_aspect("equal")
    axes.set_yticks([])
    for side in ("top", "right", "left", "bottom"):
        axes.spines[side].set_visible(False)
