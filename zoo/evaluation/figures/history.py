"""The picture of a training: the bound, or the log evidence, over epochs or iterations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from zoo.display import BLUE, clean, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["training"]

RED = "#D55E00"


def training(history: Sequence[Mapping[str, Any]], name: str, ax: Axes | None = None) -> Figure:
    """Un-tempered bound of training and of validation over the epochs, per movement or item.

    A marginal likelihood is drawn over its iterations. The lowest tenth of the values may lie below
    the picture: a training begins far down.

    Raises ValueError for a training without a history, such as one in closed form.
    """
    if not history:
        raise ValueError(f"{name} was trained in closed form: there is no history to draw")
    figure, (axes,) = panels(ax, 1, height=2.6)
    step = "epoch" if "epoch" in history[0] else "iteration"
    bounds = _training_values(history)
    axes.plot([row[step] for row in history], bounds, color=BLUE, lw=1.3, label="training")
    held_out = [(r[step], r["val_elbo"]) for r in history if r.get("val_elbo") is not None]
    if held_out:
        axes.plot(*zip(*held_out, strict=True), color=RED, lw=1.3, marker=".", label="validation")
        axes.legend(frameon=False, fontsize=9)
    finite = sorted(v for v in bounds if math.isfinite(v))
    if len(finite) > 20 and finite[-1] > finite[len(finite) // 10]:
        low, high = finite[len(finite) // 10], finite[-1]
        axes.set_ylim(low - 0.05 * (high - low), high + 0.08 * (high - low))
    axes.set_title(name, fontsize=10, loc="left")
    axes.set_xlabel(step)
    axes.set_ylabel("bound (nats)" if step == "epoch" else "log evidence (nats)")
    clean(axes)
    return figure


def _training_values(history: Sequence[Mapping[str, Any]]) -> list[float]:
    if "reconstruction" in history[0]:
        return [row["reconstruction"] - row["kl"] for row in history]
    return [-row["objective"] for row in history]
