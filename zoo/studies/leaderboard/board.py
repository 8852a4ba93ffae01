"""Train, predict, judge and compare: from the cells of a leaderboard to its stored result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zoo.catalogue import list_models
from zoo.datasets.records import Sequences
from zoo.studies.leaderboard.cells import FAILURES, Cell, Found, compute_all
from zoo.studies.leaderboard.figure import draw
from zoo.studies.leaderboard.findings import findings, sentence
from zoo.studies.leaderboard.judge import Judged, judged
from zoo.studies.leaderboard.protocol import Protocol, check_models
from zoo.studies.leaderboard.protocols import protocol
from zoo.studies.leaderboard.tables import Board, band_table, error_columns, error_rows
from zoo.studies.result import Result, write_result

__all__ = ["run_leaderboard"]


def run_leaderboard(
    asked: str | Protocol,
    output: Path,
    *,
    models: Sequence[str] = (),
    seeds: int = 1,
    folds: int = 4,
    jobs: int = 1,
    root: Path = Path("runs") / "leaderboard",
    note: Callable[[str], None] = lambda line: None,
) -> Result:
    """Compare models by a protocol that ships, by its name, or by one of your own.

    Of each of the ``folds`` the models train on all groups but those of two folds; conformal
    corrections of their bands are fitted on one of the two, the other is judged. Cells found
    before are taken from ``root``. Table, JSON and figure go to ``output``.

    >>> import numpy as np, tempfile, zoo
    >>> from zoo.studies.leaderboard import own_protocol
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(6, 20, 3)), rate=30.)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     found = run_leaderboard(own_protocol(data, seen=12, horizon=8), Path(folder), folds=3,
    ...         models=["mean", "last-value"], root=Path(folder) / "cells")
    >>> sorted(row[0] for row in found.rows)
    ['last-value', 'mean']
    """
    question, began = protocol(asked) if isinstance(asked, str) else asked, time.monotonic()
    chosen = tuple(models) or question.models
    able = list_models(can=question.need)
    check_models([m for c in chosen for m in c.split("+")], able, question.need)
    if seeds < 1 or jobs < 1:
        raise ValueError(f"seeds and jobs must be at least 1; got {seeds} and {jobs}")
    data = question.movements()
    cells = _cells(question, data, chosen, seeds, folds)
    found = compute_all(cells, root, question, jobs, _told(note, len(cells)))
    options = {"models": ",".join(models), "seeds": seeds if seeds > 1 else "", "folds": folds}
    words = "".join(f" --{k} {v}" for k, v in options.items() if v)
    command = f"{question.command or f'zoo leaderboard {question.name}'}{words}"
    result = replace(_result(question, data, found, chosen), command=command)
    return write_result(result, f"leaderboard_{question.name}", output, time.monotonic() - began)


def _told(note: Callable[[str], None], total: int) -> Callable[[Found], None]:
    count = iter(range(1, total + 1))

    def told(found: Found) -> None:
        before = f", {found.reused} reused" if found.reused else ""
        cell, said = found.cell, found.error or f"{found.seconds:.1f} s{before}"
        note(f"{next(count)}/{total} {cell.model} seed {cell.seed} fold {cell.number}: {said}")

    return told


def _cells(
    asked: Protocol, data: Sequences, models: Sequence[str], seeds: int, folds: int
) -> list[Cell]:
    return [
        Cell(
            protocol=asked.name,
            model=model,
            settings=tuple(tuple(sorted(each.items())) for each in _settings(asked, model)),
            seed=seed,
            number=k,
            fold=fold,
        )
        for model in models
        for seed in range(seeds)
        for k, fold in enumerate(asked.folds(data, folds))
    ]


def _settings(asked: Protocol, model: str) -> list[Mapping[str, Any]]:
    """What every member of an ensemble, or the one model, is given."""
    return [asked.settings.get(member, {}) for member in model.split("+")]


def _board(
    asked: Protocol, data: Sequences, found: Sequence[Found]
) -> tuple[Board, dict[str, str]]:
    """Every model's scores, best first, and the errors of models that failed."""
    table: dict[str, Judged] = {}
    failed: dict[str, str] = {}
    for model in dict.fromkeys(f.cell.model for f in found):
        mine = [f for f in found if f.cell.model == model]
        wrong = next((f.error for f in mine if f.error), "")
        try:
            if not wrong:
                table[model] = _judged(asked, data, mine)
        except FAILURES as stop:
            wrong = f"{type(stop).__name__}: {stop}"
        if wrong:
            failed[model] = wrong
    if not table:
        raise ValueError(f"no model could answer {asked.name}: {'; '.join(failed.values())}")
    order = sorted(table, key=lambda m: float(table[m].scores["mse"].mean()))
    seconds = {m: sum(f.seconds for f in found if f.cell.model == m) for m in order}
    mask = asked.question(data).mask
    channels = tuple(np.asarray(data.channels)[mask.any(0).any(0).numpy()].tolist())
    return (
        Board(
            protocol=asked,
            models={m: table[m] for m in order},
            units=tuple(data.units),
            asked=channels,
            channels=data.channels,
            frames=mask.shape[1],
            seconds=seconds,
        ),
        failed,
    )


def _judged(asked: Protocol, data: Sequences, found: Sequence[Found]) -> Judged:
    question = asked.question(data)
    seeds = []
    for seed in dict.fromkeys(f.cell.seed for f in found):
        mine = [f for f in found if f.cell.seed == seed]
        parts = [(f.cell.fold, f.prediction) for f in mine if f.prediction is not None]
        seeds.append(judged(parts, question.truth, question.mask, data.groups[asked.by]))
    return Judged.mean(seeds)


def _result(
    asked: Protocol, data: Sequences, found: Sequence[Found], models: Sequence[str]
) -> Result:
    board, failed = _board(asked, data, found)
    return Result(
        title=f"{asked.summary}; {asked.protocol}",
        source=asked.source,
        columns=error_columns(board),
        rows=error_rows(board),
        sections=(band_table(board),),
        findings=(
            *findings(board, found, data.groups[asked.by]),
            *(f"{model} failed: {error}" for model, error in failed.items()),
        ),
        seed=0,
        details=_details(board, data, models),
        cards=tuple(sentence(board, m) for m in board.models),
        figure=draw(board),
    )


def _details(board: Board, data: Sequences, models: Sequence[str]) -> dict[str, Any]:
    """What a reader may want to compute with; coverage in per cent."""
    asked = board.protocol
    return {
        "protocol": asked.protocol,
        "settings": {m: [dict(s) for s in _settings(asked, m)] for m in models},
        "groups": [str(g) for g in dict.fromkeys(data.groups[asked.by])],
        "channels": list(board.asked),
        "blocks": [[board.first + a, board.first + b] for a, b in board.blocks],
        "published": {p.name: p.mse for p in asked.published},
        "scores": {
            m: {k: v.tolist() for k, v in found.scores.items()} for m, found in board.models.items()
        },
        "coverage_90": {m: board.coverage(m) for m in board.models},
    }
