"""The table of a leaderboard from its cells: means over trials, intervals, tests, a figure."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zoo.catalogue import list_models
from zoo.datasets.records import Sequences
from zoo.experiments.result import Result, write_result
from zoo.leaderboard.cells import Cell, Found, compute_all
from zoo.leaderboard.judge import Column, Interval, holm, interval, judged, paired
from zoo.leaderboard.protocols import Protocol, check_models, protocol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["run_leaderboard"]

REFERENCE = "nearest-neighbour"
LEVEL = 0.05
Table = dict[str, Mapping[str, Column]]


def run_leaderboard(
    name: str,
    output: Path,
    *,
    models: Sequence[str] = (),
    seeds: int = 1,
    folds: int | None = None,
    jobs: int = 1,
    root: Path = Path("runs") / "leaderboard",
    note: Callable[[str], None] = lambda line: None,
) -> Result:
    """Train, predict, calibrate and compare; cells found before are taken from ``root``."""
    asked, began = protocol(name), time.monotonic()
    chosen = tuple(models) or asked.models
    check_models([m for c in chosen for m in c.split("+")], list_models(can=asked.need), asked.need)
    if seeds < 1 or jobs < 1:
        raise ValueError(f"seeds and jobs must be at least 1; got {seeds} and {jobs}")
    data = asked.load()
    cells = _cells(name, asked, data, chosen, seeds, folds)
    count = iter(range(1, len(cells) + 1))

    def told(found: Found) -> None:
        before = f", {found.reused} reused" if found.reused else ""
        cell, said = found.cell, found.error or f"{found.seconds:.1f} s{before}"
        note(f"{next(count)}/{len(cells)} {cell.model} seed {cell.seed} fold {cell.fold}: {said}")

    found = compute_all(cells, root, jobs, told)
    options = {"models": ",".join(models), "seeds": seeds if seeds > 1 else "", "folds": folds}
    told_so = "".join(f" --{k} {v}" for k, v in options.items() if v)
    command = f"zoo leaderboard {name}{told_so}"
    result = replace(_result(name, asked, data, found, chosen), command=command)
    return write_result(result, f"leaderboard_{name}", output, time.monotonic() - began)


def _cells(
    name: str,
    asked: Protocol,
    data: Sequences,
    models: Sequence[str],
    seeds: int,
    folds: int | None,
) -> list[Cell]:
    return [
        Cell(
            protocol=name,
            model=model,
            settings=tuple(tuple(sorted(each.items())) for each in _settings(asked, model)),
            seed=seed,
            fold=k,
            rows=tuple(rows),
        )
        for model in models
        for seed in range(seeds)
        for k, rows in enumerate(asked.folds(data, folds))
    ]


def _settings(asked: Protocol, model: str) -> list[Mapping[str, Any]]:
    """What every member of an ensemble, or the one model, is given."""
    return [asked.settings.get(member, {}) for member in model.split("+")]


def _table(
    asked: Protocol, data: Sequences, found: Sequence[Found]
) -> tuple[Table, dict[str, str]]:
    """Scores of every model and trial, seeds averaged within a trial; models that failed."""
    truth, mask = asked.truth(data)
    table: Table = {}
    failed: dict[str, str] = {}
    for model in dict.fromkeys(f.cell.model for f in found):
        mine = [f for f in found if f.cell.model == model]
        wrong = next((f.error for f in mine if f.error), None)
        if wrong is not None:
            failed[model] = wrong
            continue
        each = []
        for seed in dict.fromkeys(f.cell.seed for f in mine):
            parts = [(f.cell.rows, f.prediction) for f in mine if f.cell.seed == seed]
            known = [(rows, p) for rows, p in parts if p is not None]
            each.append(judged(known, truth, mask, data.groups[asked.by]))
        shared = [k for k in each[0] if all(k in scores for scores in each)]
        table[model] = {k: np.mean([scores[k] for scores in each], axis=0) for k in shared}
    return table, failed


def _result(
    name: str, asked: Protocol, data: Sequences, found: Sequence[Found], models: Sequence[str]
) -> Result:
    table, failed = _table(asked, data, found)
    order = sorted(table, key=lambda m: float(table[m]["mse"].mean()))
    if not order:
        raise ValueError(f"no model could answer {name}: {'; '.join(failed.values())}")
    tests = _tests(table, order)
    seconds = {m: sum(f.seconds for f in found if f.cell.model == m) for m in models}
    rows = [_row(m, table, tests, seconds[m]) for m in order]
    return Result(
        title=asked.summary,
        source=asked.source,
        columns=(
            "model",
            "MSE",
            "± 95 %",
            f"÷ {REFERENCE}",
            "CRPS",
            "90 % band holds",
            "calibrated",
            "± 95 %",
            "p against the best",
            f"p against {REFERENCE}",
            "seconds of training",
        ),
        rows=tuple(rows),
        findings=(
            _leader(table, order, tests),
            _covered(table, order),
            f"{len(dict.fromkeys(data.groups[asked.by]))} groups ({asked.by}), "
            f"{len({f.cell.fold for f in found})} folds, {len({f.cell.seed for f in found})} "
            "seeds, averaged within a group. Intervals are Student's over groups; p are "
            "Wilcoxon's signed-rank tests on the groups' MSE, adjusted after Holm. Groups share "
            "training movements, so that both are approximate. Bands are calibrated for each "
            "group on the others' held-out predictions.",
            *(f"{model} failed: {error}" for model, error in failed.items()),
        ),
        seed=0,
        details={
            "settings": {m: [dict(s) for s in _settings(asked, m)] for m in models},
            "groups": [str(g) for g in dict.fromkeys(data.groups[asked.by])],
            "scores": {m: {k: v.tolist() for k, v in table[m].items()} for m in order},
        },
        cards=tuple(_sentence(name, asked, m, table) for m in order),
        figure=_figure(asked, table, order),
    )


def _tests(table: Table, order: Sequence[str]) -> dict[str, dict[str, float]]:
    """Adjusted p of every model's MSE against the best and against the reference."""
    tests: dict[str, dict[str, float]] = {}
    for rival in {order[0], REFERENCE} & set(order):
        others = [m for m in order if m != rival]
        p = holm([paired(table[m]["mse"], table[rival]["mse"]) for m in others])
        tests[rival] = dict(zip(others, p, strict=True))
    return tests


def _row(
    model: str, table: Table, tests: dict[str, dict[str, float]], seconds: float
) -> tuple[Any, ...]:
    scores, reference = table[model], table.get(REFERENCE)
    error = interval(scores["mse"])
    ratio = "" if reference is None else float(error.mean / reference["mse"].mean())
    band, mended = _interval(scores, "coverage_90"), _interval(scores, "calibrated_coverage_90")
    best = next(iter(sorted(table, key=lambda m: float(table[m]["mse"].mean()))))
    return (
        model,
        error.mean,
        error.half,
        ratio,
        float(scores["crps"].mean()) if "crps" in scores else "",
        "" if band is None else f"{band.mean:.1f} %",
        "" if mended is None else f"{mended.mean:.1f} %",
        "" if mended is None else f"{mended.half:.1f} %",
        tests[best].get(model, ""),
        tests.get(REFERENCE, {}).get(model, ""),
        round(seconds, 1),
    )


def _interval(scores: Mapping[str, Column], name: str) -> Interval | None:
    return interval(scores[name]) if name in scores else None


def _leader(table: Table, order: Sequence[str], tests: dict[str, dict[str, float]]) -> str:
    best, error = order[0], float(table[order[0]]["mse"].mean())
    ratios = [
        f"{error / float(table[m]['mse'].mean()):.2f} × {m}"
        for m in ("nearest-neighbour", "ar", "kernel-ridge")
        if m in table and m != best
    ]
    apart = [m for m in order[1:] if tests[best][m] < LEVEL]
    same = [m for m in order[1:] if m not in apart]
    told = f" It cannot be told from {', '.join(same)} at 5 %." if same else ""
    return f"{best} has the least MSE, {error:.5f}: {', '.join(ratios)}.{told}"


def _covered(table: Table, order: Sequence[str]) -> str:
    inside = {
        m: float(table[m]["calibrated_coverage_90"].mean())
        for m in order
        if "calibrated_coverage_90" in table[m]
    }
    off = [f"{m} {v:.1f} %" for m, v in inside.items() if abs(v - 90) > 3]
    said = f"outside: {', '.join(off)}" if off else "none is outside"
    return (
        f"Calibrated 90 % bands within 90 ± 3 %: {len(inside) - len(off)} of {len(inside)}; {said}."
    )


def _sentence(name: str, asked: Protocol, model: str, table: Table) -> dict[str, str]:
    error = interval(table[model]["mse"])
    mended = _interval(table[model], "calibrated_coverage_90")
    held = "" if mended is None else f", calibrated 90 % band holds {mended.mean:.0f} %"
    return {
        "model": model,
        "what": asked.summary,
        "value": f"MSE {error.mean:.5f} ± {error.half:.5f} rad²{held}",
        "command": f"zoo leaderboard {name}",
    }


def _figure(asked: Protocol, table: Table, order: Sequence[str]) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(10, 0.36 * len(order) + 2), layout="constrained")
    error, band = figure.subplots(1, 2, sharey=True)
    for place, model in enumerate(order):
        values = table[model]["mse"]
        found = interval(values)
        error.scatter(values, np.full(len(values), place), s=9, color="0.7", zorder=1)
        error.errorbar(found.mean, place, xerr=found.half, fmt="o", color="C0", capsize=3, zorder=2)
        for kind, colour in (("coverage_90", "C1"), ("calibrated_coverage_90", "C2")):
            inside = _interval(table[model], kind)
            if inside is not None:
                band.errorbar(
                    inside.mean, place, xerr=inside.half, fmt="o", color=colour, capsize=3
                )
    error.set_yticks(range(len(order)), order)
    error.invert_yaxis()
    error.set(xscale="log", xlabel="MSE / rad², groups in grey", title="Error, mean ± 95 %")
    error.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    error.xaxis.set_major_formatter("{x:g}")
    error.xaxis.set_minor_formatter(NullFormatter())
    error.tick_params(axis="x", labelsize=8)
    band.axvspan(87, 93, color="0.92", zorder=0)
    band.axvline(90, color="0.6", lw=1)
    band.set(xlabel="truth inside the 90 % band / %", title="orange: raw, green: calibrated")
    figure.suptitle(asked.summary, fontsize=10)
    for axes in (error, band):
        axes.spines[["top", "right"]].set_visible(False)
    return figure
