"""The tables of a leaderboard: errors with tests, bands before and after their correction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zoo.studies.leaderboard.judge import LEVEL, Cube, Judged, blocks
from zoo.studies.leaderboard.protocol import Protocol
from zoo.studies.leaderboard.statistics import Column, Interval, holm, interval, paired
from zoo.studies.result import Section

__all__ = ["REFERENCE", "Board", "band_table", "error_columns", "error_rows"]

REFERENCE = "nearest-neighbour"
DEG2 = math.degrees(1) ** 2
Rows = tuple[tuple[Any, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Board:
    """What is shown: models in ascending order of their error, each with its scores by group.

    ``asked`` are the channels that were scored, of all ``channels``; ``frames`` those predicted.
    """

    protocol: Protocol
    models: Mapping[str, Judged]
    units: tuple[str, ...]
    channels: tuple[str, ...]
    asked: tuple[str, ...]
    frames: int
    seconds: Mapping[str, float]

    @cached_property
    def tests(self) -> Mapping[str, Mapping[str, float]]:
        """Adjusted p of every model's MSE against the best and against the reference."""
        found = {}
        for rival in dict.fromkeys((next(iter(self.models)), REFERENCE)):
            if rival in self.models:
                others = [m for m in self.models if m != rival]
                p = holm([paired(self.mse(m), self.mse(rival)) for m in others])
                found[rival] = dict(zip(others, p, strict=True))
        return found

    @property
    def best(self) -> str:
        """The model of the least error."""
        return next(iter(self.models))

    @property
    def unit(self) -> str:
        """Unit of all channels, or that they differ."""
        return self.units[0] if len(set(self.units)) == 1 else "mixed units"

    @property
    def squared(self) -> tuple[float, str]:
        """Factor and unit that errors are told in: deg² where the data are in rad."""
        if self.unit == "rad":
            return DEG2, "deg²"
        return 1.0, f"{self.unit}²" if self.unit else "(no unit)"

    @property
    def first(self) -> int:
        """Frame of the movement at which what is predicted begins."""
        return self.protocol.seen

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """Blocks of predicted frames, from 0."""
        return blocks(self.frames)

    def mse(self, model: str) -> Column:
        """Mean squared error of every group in the data's unit."""
        return self.models[model].scores["mse"]

    def interval(self, model: str, name: str) -> Interval | None:
        """A score's mean over groups and how sure it is; None where there is none."""
        scores = self.models[model].scores if model in self.models else {}
        return interval(scores[name]) if name in scores else None

    def cube(self, model: str) -> Cube | None:
        """Coverage by group, asked channel and block: calibrated where it is, else raw."""
        kinds = self.models[model].coverage
        found = kinds.get("calibrated", kinds.get("raw"))
        return None if found is None else found[:, np.isin(self.channels, self.asked)]

    def coverage(self, model: str) -> dict[str, Any]:
        """Coverage in per cent by kind: of every group's asked channels, and of its blocks.

        None where nothing was asked.
        """
        inside = np.isin(self.channels, self.asked)
        cubes = self.models[model].coverage.items()
        asked = {kind: np.ma.masked_invalid(cube[:, inside]) for kind, cube in cubes}
        return {
            kind: {
                "by group and channel": cube.mean(2).round(1).tolist(),
                "by group and block": cube.mean(1).round(1).tolist(),
            }
            for kind, cube in asked.items()
        }


def error_columns(board: Board) -> tuple[str, ...]:
    """Heads of the table of errors."""
    degrees = ("MSE / deg² ± 95 %",) if board.unit == "rad" else ()
    return (
        "model",
        *(("judged on",) if board.protocol.published else ()),
        *degrees,
        f"MSE / {_squared(board.unit)} ± 95 %",
        f"÷ {REFERENCE}",
        f"CRPS / {board.unit or '1'}",
        "NLL / nats",
        "p against the best",
        f"p against {REFERENCE}",
        "seconds of training",
    )


def error_rows(board: Board) -> Rows:
    """A row a model and, below, a row a published figure; wherever it was judged, it says so."""
    ours = (_error_row(board, model) for model in board.models)
    width = len(error_columns(board))
    theirs = (
        (f"{p.name} (published)", "35_31–34", p.mse, p.mse / DEG2)
        for p in sorted(board.protocol.published, key=lambda p: p.mse)
    )
    return (*ours, *((*row, *[""] * (width - len(row))) for row in theirs))


def band_table(board: Board) -> Section:
    """Coverage and width of the bands, before and after calibration."""
    first, last = board.first, board.first + board.frames
    return Section(
        title="Bands, raw and calibrated on groups of their own",
        columns=(
            "model",
            "50 % band holds, raw",
            "50 %, calibrated",
            "90 % band holds, raw",
            "90 %, calibrated",
            "worst channel",
            f"worst sixth of frames {first}–{last}",
            f"width of 90 % / {board.unit or '1'}, raw",
            "width, calibrated",
        ),
        rows=tuple(_band_row(board, model) for model in board.models),
    )


def _error_row(board: Board, model: str) -> tuple[Any, ...]:
    error, reference = interval(board.mse(model)), board.interval(REFERENCE, "mse")
    factors = (DEG2, 1.0) if board.unit == "rad" else (1.0,)
    crps, nll = (board.interval(model, name) for name in ("crps", "nll"))
    return (
        model,
        *(("35_01–16, held out",) if board.protocol.published else ()),
        *(f"{_short(f * error.mean)} ± {_short(f * error.half)}" for f in factors),
        "" if reference is None else error.mean / reference.mean,
        "" if crps is None else crps.mean,
        "" if nll is None else nll.mean,
        board.tests[board.best].get(model, ""),
        board.tests.get(REFERENCE, {}).get(model, ""),
        round(board.seconds[model], 1),
    )


def _band_row(board: Board, model: str) -> tuple[Any, ...]:
    names = [f"{kind}coverage_{p}" for p in (50, 90) for kind in ("", "calibrated_")]
    widths = [board.interval(model, f"{kind}width_90") for kind in ("", "calibrated_")]
    return (
        model,
        *(_share(board.interval(model, name)) for name in names),
        *_worst(board, model),
        *("" if w is None else w.mean for w in widths),
    )


def _worst(board: Board, model: str) -> tuple[str, str]:
    """The channel and the block whose coverage is farthest from the band's level."""
    cube = board.cube(model)
    if cube is None:
        return "", ""
    by_channel, by_block = np.nanmean(cube, (0, 2)), np.nanmean(cube, (0, 1))
    channel = int(np.abs(by_channel - 100 * LEVEL).argmax())
    block = int(np.abs(by_block - 100 * LEVEL).argmax())
    first, last = (board.first + frame for frame in board.blocks[block])
    return (
        f"{board.asked[channel]} {by_channel[channel]:.0f} %",
        f"{first}–{last} {by_block[block]:.0f} %",
    )


def _share(found: Interval | None) -> str:
    if found is None:
        return ""
    return f"{found.mean:.1f} ± {found.half:.1f} % (SD {found.sd:.1f})"


def _squared(unit: str) -> str:
    return f"{unit}²" if unit else "1"


def _short(value: float) -> str:
    return f"{value:.3g}"
