"""Tables of figures that pages include, from results of commands."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from zoo.catalogue import CATALOGUE

RESULTS = Path(__file__).resolve().parents[1] / "results"


def write_tables(home: Path) -> None:
    """The tables of figures that hand-written pages include."""
    home.mkdir(parents=True, exist_ok=True)
    chooser = stored(RESULTS / "chooser.json")
    walks = stored(RESULTS / "leaderboard_walk-setup-2.json")
    few = stored(RESULTS / "calibration.json")
    made = {
        "takes": _takes(chooser),
        "costs": _costs(chooser, walks),
        "regressors": _regressors(stored(RESULTS / "uci.json")),
        "bands_walk": _bands(walks),
        "few_groups": _few(few),
        "bands_people": _people(stored(RESULTS / "coverage.json")),
    }
    for name, text in made.items():
        (home / f"{name}.md").write_text(text + "\n", "utf-8")


def _takes(chooser: Any) -> str:
    """What every entry of sequences takes: yes, or no."""
    asked = ("unequal lengths", "missing entries", "a single movement", "beyond the last frame")
    rows = [
        (
            link(r["model"]),
            *("–" if a not in r["refused"] else _word(r["refused"][a]) for a in asked),
        )
        for r in chooser["rows"]
        if len(r["refused"]) > 1
    ]
    return table(("model", *asked), rows) + _from(chooser["command"])


def _costs(chooser: Any, walks: Any) -> str:
    """Training on walks and its error, processor time of one forecast."""
    seconds = {row[0]: float(row[-1]) / 4 for row in walks["rows"]}
    error = {row[0]: str(row[1]) for row in walks["rows"]}
    rows = []
    for found in chooser["rows"]:
        name, time = found["model"], found["milliseconds"].get("forecast")
        if time is not None:
            trained = f"{seconds[name]:.3g}" if name in seconds else ""
            bands = "yes" if found["bands"]["forecast"] else "no"
            rows.append((link(name), trained, error.get(name, ""), f"{time:.0f}", bands))
    titles = ("model", "training / s", "MSE / deg²", "one forecast / ms", "bands")
    return table(titles, rows) + _from(
        f"{walks['command']}`, a quarter of its four folds, and `{chooser['command']}"
    )


def _regressors(uci: Any) -> str:
    """Errors and times of the regressors on public tables."""
    rows = [
        (data, f"`{name}`", *(f"{_mean(found[key]):.3g}" for key in ("rmse", "nll")),
         f"{100 * _mean(found['coverage_90']):.0f} %", f"{found['seconds_a_fit']:.2g}")
        for data, models in uci["measured"].items()
        for name, found in models.items()
    ]  # fmt: skip
    titles = ("data", "entry", "RMSE", "NLL / nats", "90 % band holds", "one fit / s")
    return table(titles, rows) + _from("python -m benchmarks.uci")


def _bands(walks: Any) -> str:
    """Coverage and width of the 90 % bands on walks held out."""
    part = walks["sections"][0]
    wanted = [0, 3, 4, 5, 7, 8]
    rows = [[cell(row[i]) for i in wanted] for row in part["rows"]]
    return table([part["columns"][i] for i in wanted], rows) + _from(walks["command"])


def _few(few: Any) -> str:
    """What calibrated bands hold, by the number of walks to calibrate on."""
    rows = [
        (r["walks"], *(f"{r[k]['mean']:.1f} ± {r[k]['sd']:.1f} %" for k in ("50 %", "90 %")),
         f"{r['width of 90 %']['mean']:.2f} ± {r['width of 90 %']['sd']:.2f}")
        for r in few["rows"]
        if r["recalibration"] == "conformal" and r["by"] != "one factor"
    ]  # fmt: skip
    titles = ("walks to calibrate on", "50 % band holds", "90 % band holds", "width ÷ raw")
    said = "; ± is the standard deviation over repetitions"
    return table(titles, rows) + _from("python -m benchmarks.calibration", said)


def _people(coverage: Any) -> str:
    """What 90 % bands of forecasts of walks hold, for the same people and for another."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in coverage["summary"]:
        if row["data"] == "walks":
            found.setdefault((row["model"], row["who"]), {})[row["bands"]] = row
    rows = []
    for (model, who), kinds in found.items():
        held = (f"{k['mean']:.0f} ({k['least']:.0f}–{k['most']:.0f})" for k in kinds.values())
        wider = kinds["adapted"]["width"] / kinds["raw"]["width"]
        rows.append((link(model), who, *held, f"× {wider:.1f}"))
    titles = ("model", "people", "raw / %", "calibrated / %", "adapted / %", "adapted ÷ raw width")
    said = "; means over three folds and three observed lengths, in brackets the extremes"
    return table(titles, rows) + _from(coverage["command"], said)


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; bars inside of cells stay what they are.

    >>> print(table(("a", "b"), [("|x|", 1)]))
    | a | b |
    |---|---|
    | &#124;x&#124; | 1 |
    """
    head, *body = (
        " | ".join(str(cell).replace("|", "&#124;") for cell in line) for line in (titles, *rows)
    )
    return "\n".join([f"| {head} |", "|" + "---|" * len(titles), *(f"| {line} |" for line in body)])


def _from(command: str, said: str = "") -> str:
    return f"\n\n*From `{command}`{said}.*"


def _word(refusal: str) -> str:
    return "no" if refusal else "yes"


def link(name: str) -> str:
    return f"[`{name}`](models/{name}.md)" if name in CATALOGUE.names() else f"`{name}`"


def cell(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _mean(value: Any) -> float:
    return float(value["mean"])


def stored(file: Path) -> Any:
    return json.loads(file.read_text("utf-8"))
