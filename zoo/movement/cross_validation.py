"""Settings chosen by held-out movements: folds, errors, and one setting after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["chosen_in_turn", "folds_of", "held_out_errors", "splits"]

FOLDS = 4
Settings = TypeVar("Settings")


def folds_of(group: Int[Tensor, " sequence"], count: int = FOLDS) -> Int[Tensor, " sequence"]:
    """At most ``count`` folds, whole groups in turn.

    >>> folds_of(torch.tensor([7, 7, 2, 5, 9, 1])).tolist()
    [0, 0, 1, 2, 3, 0]
    """
    order = list(dict.fromkeys(group.tolist()))
    return group.new_tensor([order.index(g) % count for g in group.tolist()])


def splits(fold: Int[Tensor, " sequence"]) -> Iterator[tuple[int, Bool[Tensor, " sequence"]]]:
    """Every fold with the movements that it holds out."""
    for f in range(int(fold.max()) + 1):
        yield f, fold == f


def chosen_in_turn(
    start: Settings,
    grids: Sequence[tuple[str, Sequence[Any]]],
    score: Callable[[Settings], float],
) -> Settings:
    """Settings, a dataclass, of which one field after the other takes its best value.

    ``score`` is the higher the better held-out movements are predicted; the first of equal values
    wins.

    >>> from zoo.movement.timing import Timing
    >>> grids = [("unit", (1.0, 2.0)), ("offset", (0.0, 3.0))]
    >>> chosen_in_turn(Timing(1.0), grids, lambda t: -abs(t.unit + t.offset - 4))
    Timing(unit=2.0, offset=3.0)
    """
    best = start
    for name, values in grids:
        change: list[Mapping[str, Any]] = [{name: value} for value in values]
        best = max((replace(best, **each) for each in change), key=score)  # type: ignore[type-var]
    return best


def held_out_errors(
    residual_maker: Float[Tensor, "place place"],
    outputs: Float[Tensor, "place target"],
    group: Int[Tensor, " place"],
) -> Float[Tensor, "place target"]:
    """Errors at every place of a linear regression fitted without its group.

    With the residuals e = M y of the fit to all, that of group g is M_gg⁻¹ e_g: no regression is
    repeated. Any multiple of M gives the same.

    >>> mean = torch.full((3, 3), 1 / 3)
    >>> held_out_errors(torch.eye(3) - mean, torch.tensor([[1.0], [2.0], [6.0]]), torch.arange(3)).T
    tensor([[-3.0000, -1.5000,  4.5000]])
    """
    residuals, names = residual_maker @ outputs, group.unique()
    if len(names) == len(group):
        return residuals / residual_maker.diagonal()[:, None]
    errors = torch.empty_like(outputs)
    for g in names:
        here = (group == g).nonzero()[:, 0]
        errors[here] = torch.linalg.solve(residual_maker[here][:, here], residuals[here])
    return errors
