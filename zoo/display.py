"""How an object shows itself in a notebook, and what it needs to be drawn or handed on."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.box import Box
    from rich.table import Table

__all__ = ["BLUE", "blocks", "clean", "facts", "figure_of", "panels", "partner"]

BLUE = "#0072B2"
_GRID = "#dddddd"
_SHOWN = 6
PADDING = 3


def facts(title: str, rows: Mapping[str, object]) -> str:
    """A title and a table of names with values, as HTML; lists are cut after six.

    >>> facts("Run of <dmp>", {"channels": ["hip", "knee"], "rate": "30 Hz"})[:44]
    '<table><caption>Run of &lt;dmp&gt;</caption>'
    """
    lines = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(_text(value))}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption><tbody>{lines}</tbody></table>"


def partner(module: str, purpose: str) -> Any:
    """Another library's module, imported when it is first needed.

    Raises ModuleNotFoundError, which says what needs it and how to get it.
    """
    name = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            f"{purpose} needs {name}, which is not installed: pip install {name}"
        ) from None


def panels(ax: object, count: int, *, height: float = 2.1) -> tuple[Figure, list[Axes]]:
    """``count`` panels of a new figure, two a row; or the one panel that was given.

    Raises TypeError for an ``ax`` that is no axes, and ValueError for one axes and several panels.
    """
    axes_class = partner("matplotlib.axes", "plot").Axes
    if ax is not None:
        if not isinstance(ax, axes_class):
            raise TypeError(f"ax must be matplotlib axes; got {type(ax).__name__}")
        if count != 1:
            raise ValueError(f"one ax shows one channel; got {count}: name one, or leave out ax")
        return figure_of(ax), [ax]
    rows, columns = (count + 1) // 2, min(2, count)
    figure = partner("matplotlib.figure", "plot").Figure(
        figsize=(5.2 * columns, height * rows + 1.0), layout="constrained", dpi=110
    )
    grid = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
        grid[count - 2].tick_params(labelbottom=True)
    return figure, grid[:count]


def blocks(
    title: str,
    header: Sequence[str],
    body: Sequence[Sequence[str]],
    *,
    width: int,
    keys: int = 1,
) -> list[Table]:
    """A table for a terminal of ``width`` columns, cut into several where it does not fit.

    No name and no number is cut: cells stay on one line, titles are broken between words, and the
    first ``keys`` columns are repeated in every part.

    >>> [len(t.columns) for t in blocks("", ["a", "b b", "c"], [["1" * 9] * 3], width=24)]
    [2, 2]
    """
    from rich.table import Table

    wide = [_width(name, [row[i] for row in body]) for i, name in enumerate(header)]
    shared = sum(wide[:keys])
    parts: list[list[int]] = [[]]
    for i in range(keys, len(header)):
        if parts[-1] and shared + sum(wide[j] for j in parts[-1]) + wide[i] > width:
            parts.append([])
        parts[-1].append(i)
    tables = []
    for n, part in enumerate(parts):
        table = Table(title=title if n == 0 else None, box=_ruled(), title_justify="left")
        for i in (*range(keys), *part):
            side: Literal["left", "right"] = "left" if i < keys else "right"
            words = "\n".join(_words(header[i]))
            table.add_column(words, justify=side, no_wrap=True, overflow="fold")
        for row in body:
            table.add_row(*(row[i] for i in (*range(keys), *part)))
        tables.append(table)
    return tables


def _ruled() -> Box:
    from rich import box

    return box.SIMPLE_HEAD


def _words(title: str) -> list[str]:
    """A title in lines: at its separators where it has some, else between its words."""
    return title.split(" · ") if " · " in title else title.split(" ")


def _width(title: str, cells: Sequence[str]) -> int:
    from rich.cells import cell_len

    return max(map(cell_len, (*_words(title), *cells)), default=0) + PADDING


def figure_of(ax: Any) -> Figure:
    """The figure that axes are in."""
    figure: Figure = ax.figure
    return figure


def clean(axes: Axes) -> None:
    """Axes without what distracts: no frame above and beside, a pale grid below the lines."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def _text(value: object) -> str:
    if isinstance(value, (list, tuple)):
        more = f", … ({len(value)})" if len(value) > _SHOWN else ""
        return ", ".join(map(str, value[:_SHOWN])) + more or "none"
    return str(value)
