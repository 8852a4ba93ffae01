"""Pages that are made when the site is built: models, results, notebooks, and tables of figures.

``python docs/pages.py`` writes ``docs/models``, ``docs/results`` and ``docs/notebooks`` and the
tables under ``build/docs`` that pages include. Every figure comes from a file in ``results/``.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from zoo.catalogue import CATALOGUE  # noqa: E402
from zoo.contract.registry import Entry  # noqa: E402
from zoo.faces.cards import as_markdown, card  # noqa: E402

__all__ = ["main", "model_page", "write_models", "write_results", "write_tables"]

DOCS, RESULTS, TABLES = ROOT / "docs", ROOT / "results", ROOT / "build" / "docs"
KIND = {
    "Exact": "closed form",
    "Svi": "stochastic variational inference",
    "MarginalLikelihood": "marginal likelihood",
}
SOURCES = {
    "thesis": "the data of the thesis",
    "public": "public data",
    "simulated": "simulated data",
    "own": "data of one's own",
}


def main() -> None:
    """Write all pages; notebooks are executed unless only their source is asked for."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--notebooks", choices=("executed", "source"), default="executed")
    execute = words.parse_args().notebooks == "executed"
    write_tables(TABLES)
    shutil.copy(ROOT / "CONTRIBUTING.md", DOCS / "contributing.md")
    write_models(_fresh(DOCS / "models"))
    write_results(_fresh(DOCS / "results"))
    write_notebooks(_fresh(DOCS / "notebooks"), execute=execute)


def write_models(home: Path) -> None:
    """A page for every entry, an index, and the list for the navigation."""
    titles = ("model", "what it is", "can", "inference")
    rows = [
        (f"[`{e.name}`]({e.name}.md)", e.summary, ", ".join(e.capabilities), _kind(e))
        for e in CATALOGUE
    ]
    lead = (
        "Every entry of the catalogue: a generative model, a guide and a way of inference. "
        "[Choose a model](../choose.md) says which to begin with."
    )
    (home / "index.md").write_text(f"# Models\n\n{lead}\n\n{table(titles, rows)}\n", "utf-8")
    for entry in CATALOGUE:
        (home / f"{entry.name}.md").write_text(model_page(entry, home), "utf-8")
    _navigation(home, "Models", {e.name: e.name for e in CATALOGUE})


def model_page(entry: Entry, home: Path) -> str:
    """A model's card as a page, with its figure where a stored result has one."""
    found = card(entry.name)
    facts = (
        ("thesis", entry.thesis),
        ("can", ", ".join(entry.capabilities)),
        ("takes", entry.data),
        ("inference", _kind(entry)),
        ("guide", entry.posterior),
        ("default data set", f"`{entry.dataset}`"),
    )
    settings = [
        (f"`{key}`", s["part"], s["type"].replace(" | ", " or "), f"`{s['default']!r}`")
        for key, s in found.to_json()["settings"].items()
    ]
    parts = [
        f"# {entry.name}\n\n**{entry.summary}.**",
        table(("in short", entry.name), facts),
        f'```py\nmodel = zoo.create("{entry.name}", train)\n```',
        f"## The model\n\n{as_markdown(found.text)}",
        _figure(entry.name, home),
        f"## Measured\n\n{_measured(found.results)}",
        "## Settings\n\nKeywords of `zoo.create`, or `--set KEY=VALUE` on the command line.\n\n"
        + table(("setting", "part", "values", "default"), settings),
        *(as_markdown(meaning) for meaning in found.meanings),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _measured(results: Sequence[Any]) -> str:
    if not results:
        return "No command has stored a result of this entry yet."
    rows = [
        (r["what"], r["value"], r.get("thesis", ""), r["source"], r["command"]) for r in results
    ]
    titles = ("what", "value", "thesis", "data", "command")
    return table(titles, [(*r[:4], f"`{r[4]}`") for r in rows])


def _figure(name: str, home: Path) -> str:
    """The figure of the result that is about this model and the fewest others."""
    about = []
    for file in sorted(RESULTS.glob("*.json")):
        models = {c.get("model") for c in _stored(file).get("cards", ())}
        if name in models and file.with_suffix(".png").is_file():
            about.append((len(models), file))
    if not about:
        return ""
    file = min(about)[1]
    shutil.copy(file.with_suffix(".png"), home)
    result = _stored(file)
    link = f"[{result['id']}](../results/{file.stem}.md)"
    return (
        f"![{result['title']}]({file.stem}.png)\n\n*{link}: {result['title']} "
        f"({SOURCES[result['source']]}). Made by `{result['command']}`.*"
    )


def write_results(home: Path) -> None:
    """A page for every result that has a table, with its figure, and an index."""
    rows, short = [], {}
    for page in sorted(RESULTS.glob("*.md"), key=lambda p: ("leaderboard" not in p.stem, p.stem)):
        result, text = (
            _stored(page.with_suffix(".json")),
            page.read_text("utf-8").replace(" ± ", " ±\u00a0"),
        )
        picture = page.with_suffix(".png")
        if picture.is_file():
            shutil.copy(picture, home)
            text += f"\n![{result['title']}]({picture.name})\n"
        (home / page.name).write_text(f"{text}\n{_origin(result)}\n", "utf-8")
        rows.append((f"[{page.stem}]({page.name})", result["title"], result["source"]))
        short[page.stem] = _short(page.stem, result["title"])
    _navigation(home, "Results", short)
    lead = (
        "Every figure comes from a command of this project, which wrote it to `results/` with "
        "seed, versions and duration. *Data* says whether it is the thesis' data, public data "
        "with a published protocol, simulated, or one's own. Repeat one with `zoo experiment "
        "ID` or `zoo leaderboard PROTOCOL`. Results without a commit are older."
    )
    listed = table(("result", "what", "data"), rows)
    (home / "index.md").write_text(f"# Results\n\n{lead}\n\n{listed}\n", "utf-8")


def _origin(result: Any) -> str:
    """Who made a result, with what, and how long it took."""
    versions = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    commit = result.get("commit")
    made = f" at commit `{commit}`" if commit else ""
    training = result.get("training_seconds")
    trained = "" if training is None else f", of which {training:.0f} s were its trainings"
    return (
        f"Made by `{result['command']}`{made}, seed {result['seed']}, in {result['seconds']:.0f} s"
        f"{trained}, with {versions}."
    )


def write_notebooks(home: Path, *, execute: bool) -> None:
    """The notebooks as pages."""
    from docs.executed import page

    scripts = sorted((ROOT / "notebooks").glob("*.py"))
    for script in scripts:
        (home / f"{script.stem}.md").write_text(page(script, home, execute=execute), "utf-8")
    listed = "\n".join(f"- [{_title(home / f'{s.stem}.md')}]({s.stem}.md)" for s in scripts)
    lead = "Executed when the site was built, unless a page says otherwise."
    (home / "index.md").write_text(f"# Notebooks\n\n{lead}\n\n{listed}\n", "utf-8")
    names = [(_title(home / f"{s.stem}.md"), s.stem) for s in scripts]
    lines = ["- [Notebooks](index.md)", *(f"- [{title}]({name}.md)" for title, name in names)]
    (home / "SUMMARY.md").write_text("\n".join(lines) + "\n", "utf-8")


def write_tables(home: Path) -> None:
    """The tables of figures that hand-written pages include."""
    home.mkdir(parents=True, exist_ok=True)
    chooser = _stored(RESULTS / "chooser.json")
    walks = _stored(RESULTS / "leaderboard_walk-setup-2.json")
    few = _stored(RESULTS / "calibration.json")
    made = {
        "takes": _takes(chooser),
        "costs": _costs(chooser, walks),
        "regressors": _regressors(_stored(RESULTS / "uci.json")),
        "bands_walk": _bands(walks),
        "few_groups": _few(few),
    }
    for name, text in made.items():
        (home / f"{name}.md").write_text(text + "\n", "utf-8")


def _takes(chooser: Any) -> str:
    """What every entry of sequences takes: yes, or no."""
    asked = ("unequal lengths", "missing entries", "a single movement", "beyond the last frame")
    rows = [
        (
            _link(r["model"]),
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
            rows.append((_link(name), trained, error.get(name, ""), f"{time:.0f}", bands))
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
    rows = [[_cell(row[i]) for i in wanted] for row in part["rows"]]
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


def _link(name: str) -> str:
    return f"[`{name}`](models/{name}.md)" if name in CATALOGUE.names() else f"`{name}`"


def _cell(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _mean(value: Any) -> float:
    return float(value["mean"])


def _kind(entry: Entry) -> str:
    return KIND[type(entry.inference).__name__]


def _title(page: Path) -> str:
    return page.read_text("utf-8").splitlines()[0].removeprefix("# ")


def _stored(file: Path) -> Any:
    return json.loads(file.read_text("utf-8"))


def _short(name: str, title: str) -> str:
    """A result in a few words, for the navigation."""
    if name.startswith("leaderboard_"):
        return f"Leaderboard {name.removeprefix('leaderboard_')}"
    words = re.split("[:,]", title)[0]
    return f"{name} {words}" if name.startswith("E") else words


def _navigation(home: Path, title: str, names: Mapping[str, str]) -> None:
    lines = [f"- [{title}](index.md)", *(f"- [{words}]({n}.md)" for n, words in names.items())]
    (home / "SUMMARY.md").write_text("\n".join(lines) + "\n", "utf-8")


def _fresh(home: Path) -> Path:
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    return home


if __name__ == "__main__":
    main()
