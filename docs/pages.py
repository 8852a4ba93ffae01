"""Pages that are made when the site is built: models, results, notebooks, and tables of figures.

``python docs/pages.py`` writes ``docs/models``, ``docs/results`` and ``docs/notebooks`` and the
tables under ``build/docs`` that pages include. Every figure comes from a file in ``results/``.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from docs.tables import RESULTS, stored, table, write_tables  # noqa: E402
from zoo.catalogue import CATALOGUE  # noqa: E402
from zoo.contract.registry import Entry  # noqa: E402
from zoo.faces.cards import as_markdown, card  # noqa: E402

__all__ = ["main", "model_page", "write_models", "write_results", "write_tables"]

DOCS, TABLES = ROOT / "docs", ROOT / "build" / "docs"
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
        models = {c.get("model") for c in stored(file).get("cards", ())}
        if name in models and file.with_suffix(".png").is_file():
            about.append((len(models), file))
    if not about:
        return ""
    file = min(about)[1]
    shutil.copy(file.with_suffix(".png"), home)
    result = stored(file)
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
            stored(page.with_suffix(".json")),
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


def _kind(entry: Entry) -> str:
    return KIND[type(entry.inference).__name__]


def _title(page: Path) -> str:
    return page.read_text("utf-8").splitlines()[0].removeprefix("# ")


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
