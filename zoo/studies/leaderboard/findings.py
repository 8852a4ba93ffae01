"""What a leaderboard shows, in sentences: who leads, whose bands hold, and where we lose."""

from __future__ import annotations

from collections.abc import Sequence

from zoo.evaluation.calibration.promise import promised
from zoo.studies.leaderboard.cells import Found
from zoo.studies.leaderboard.judge import LEVEL
from zoo.studies.leaderboard.protocols import BASELINES
from zoo.studies.leaderboard.statistics import interval
from zoo.studies.leaderboard.tables import DEG2, REFERENCE, Board

__all__ = ["findings", "sentence"]

SIGNIFICANT = 0.05
TOLERANCE = 3.0


def findings(board: Board, found: Sequence[Found], groups: Sequence[object]) -> tuple[str, ...]:
    """Every sentence below the tables."""
    return (
        _leader(board),
        _losses(board),
        *_published(board),
        *_covered(board),
        _design(board, found, groups),
    )


def sentence(board: Board, model: str) -> dict[str, str]:
    """What the card of a model quotes."""
    mended, raw = (board.interval(model, f"{kind}coverage_90") for kind in ("calibrated_", ""))
    held = mended or raw
    kind = "calibrated" if mended else "raw"
    bands = f", {kind} 90 % band holds {held.mean:.0f} ± {held.half:.0f} %" if held else ""
    return {
        "model": model,
        "what": f"{board.protocol.summary}; {board.protocol.protocol.partition(':')[0]}",
        "value": f"MSE {_error(board, model, sure=True)}{bands}",
        "command": board.protocol.command or f"zoo leaderboard {board.protocol.name}",
    }


def _leader(board: Board) -> str:
    best, error = board.best, float(board.mse(board.best).mean())
    ratios = [
        f"{error / float(board.mse(m).mean()):.2f} × {m}"
        for m in (REFERENCE, "ar", "kernel-ridge")
        if m in board.models and m != best
    ]
    tests = board.tests[best]
    same = [m for m in board.models if m != best and tests[m] >= SIGNIFICANT]
    beside = f", {', '.join(ratios)}" if ratios else ""
    told = f" It cannot be told from {', '.join(same)} at 5 %." if same else ""
    return f"{best} has the least error, {_error(board, best)}{beside}.{told}"


def _losses(board: Board) -> str:
    """Every baseline that has a smaller error than a model of the thesis or a rival to it."""
    ours = [m for m in board.models if set(m.split("+")) - set(BASELINES)]
    order = list(board.models)
    lost = []
    for baseline in (m for m in board.models if m not in ours):
        beaten = [m for m in ours if order.index(m) > order.index(baseline)]
        if beaten:
            lost.append(f"{baseline} ({_error(board, baseline)}) beats {', '.join(beaten)}")
    return f"Where we lose: {'; '.join(lost) or 'no baseline beats any other model here'}."


def _published(board: Board) -> tuple[str, ...]:
    if not board.protocol.published:
        return ()
    ours = float(board.mse(board.best).mean()) * DEG2
    better = [f"{p.name} {p.mse:.2f}" for p in board.protocol.published if p.mse < ours]
    behind = "; ".join(better) or "none"
    return (
        f"Published figures that are better than our best, {board.best} with {ours:.2f} deg²: "
        f"{behind}. They were judged on walks 35_31–34 after training on 35_01–16; ours are "
        "cross-validated on 35_01–16 with fewer walks to train on. It is not the same test set.",
    )


def _covered(board: Board) -> tuple[str, ...]:
    """Whose calibrated 90 % bands hold what they say, and whose do not."""
    inside = {m: board.interval(m, "calibrated_coverage_90") for m in board.models}
    known = {m: found.mean for m, found in inside.items() if found is not None}
    if not known:
        return ("No band was calibrated: a fold's calibration part has fewer than 2 groups.",)
    target = 100 * LEVEL
    held = [m for m, v in known.items() if abs(v - target) <= TOLERANCE]
    off = [f"{m} {v:.1f} %" for m, v in known.items() if m not in held]
    return (
        f"Calibrated 90 % bands hold {target:.0f} ± {TOLERANCE:.0f} % for {len(held)} of "
        f"{len(known)} entries ({', '.join(held) or 'none'}); outside: {', '.join(off) or 'none'}.",
    )


def _design(board: Board, found: Sequence[Found], groups: Sequence[object]) -> str:
    folds = {f.cell.fold for f in found}
    parts = [{groups[row] for row in fold.calibration} for fold in folds]
    fewest, trained = min(map(len, parts)), min(len(fold.train) for fold in folds)
    seeds = len({f.cell.seed for f in found})
    most = promised(LEVEL, fewest)
    few = (
        f" So few exchangeable groups can promise a new one at most {100 * most:.0f} %; what 90 % "
        "bands hold is measured here."
    )
    return (
        f"{len(set(groups))} groups ({board.protocol.by}) in {len(folds)} folds: models train on "
        f"at least {trained} movements, the bands' conformal correction is fitted on the next "
        f"fold (at least {fewest} groups), the judged fold is in neither."
        f"{few if most < LEVEL else ''} {seeds} seed(s), averaged within a group. ± is Student's "
        "95 % interval over groups, SD their standard deviation; p are Wilcoxon's signed-rank "
        "tests on the groups' MSE, adjusted after Holm. Groups share training movements, so that "
        "both are approximate."
    )


def _error(board: Board, model: str, sure: bool = False) -> str:
    found = interval(board.mse(model))
    factor, unit = board.squared
    half = f" ± {factor * found.half:.2g}" if sure else ""
    return f"{factor * found.mean:.3g}{half} {unit}"
