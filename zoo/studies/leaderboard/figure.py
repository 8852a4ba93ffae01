"""The figure of a leaderboard: errors with every group in grey, coverage raw and calibrated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from zoo.studies.leaderboard.statistics import interval
from zoo.studies.leaderboard.tables import Board

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw"]

KINDS = (("coverage_90", "C1", -0.16), ("calibrated_coverage_90", "C2", 0.16))


def draw(board: Board) -> Figure:
    """Two panels, a row a model; published figures, of other walks, below ours."""
    from matplotlib.figure import Figure

    published = sorted(board.protocol.published, key=lambda p: p.mse)
    names = [*board.models, *(f"{p.name} (35_31–34)" for p in published)]
    figure = Figure(figsize=(11, 0.36 * len(names) + 2.2), layout="constrained")
    error, band = figure.subplots(1, 2, sharey=True)
    _errors(error, board)
    _bands(band, board)
    places = np.arange(len(published)) + len(board.models)
    error.scatter([p.mse for p in published], places, marker="D", ec="C3", fc="none", s=28)
    error.set_yticks(range(len(names)), names)
    error.invert_yaxis()
    kind, _, what = board.protocol.protocol.partition(": ")
    figure.suptitle(f"{board.protocol.summary}\n{kind}: {what}", fontsize=10)
    for axes in (error, band):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="0.94", lw=0.8)
        axes.set_axisbelow(True)
    return figure


def _errors(axes: Axes, board: Board) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    factor, unit = board.squared
    for place, model in enumerate(board.models):
        values = factor * board.mse(model)
        found = interval(values)
        axes.scatter(values, np.full(len(values), place), s=9, color="0.7", zorder=1)
        axes.errorbar(found.mean, place, xerr=found.half, fmt="o", color="C0", capsize=3, zorder=2)
    axes.set(xlabel=f"MSE / {unit}")
    axes.set_title("Error: groups in grey, mean ± 95 %", fontsize=9)
    if any((board.mse(m) <= 0).any() for m in board.models):
        return
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="x", labelsize=8)


def _bands(axes: Axes, board: Board) -> None:
    for name, colour, shift in KINDS:
        for i, model in enumerate(board.models):
            if name not in board.models[model].scores:
                continue
            values = board.models[model].scores[name]
            place = np.full(len(values), i + shift)
            axes.scatter(values, place, s=7, color=colour, alpha=0.3, lw=0, zorder=1)
            axes.errorbar(
                values.mean(),
                i + shift,
                xerr=interval(values).sd,
                fmt="o",
                ms=5,
                color=colour,
                capsize=2,
                zorder=2,
            )
    axes.axvspan(87, 93, color="0.92", zorder=0)
    axes.axvline(90, color="0.6", lw=1, zorder=0)
    axes.set(xlabel="recorded values inside the 90 % band / %")
    axes.set_title("Orange: raw, green: calibrated; groups pale, mean ± SD", fontsize=9)
