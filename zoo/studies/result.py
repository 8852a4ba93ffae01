"""What an experiment is and what it leaves behind: Markdown, JSON and a figure."""

from __future__ import annotations

import difflib
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import Markdown

from zoo.display import blocks
from zoo.errors import UnknownNameError
from zoo.studies.kept import timed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "EXPERIMENTS",
    "Experiment",
    "Result",
    "Section",
    "commit",
    "run_experiment",
    "write_result",
]

CODE = ("zoo", "guides", "datasets", "benchmarks")
Source = Literal["thesis", "public", "simulated", "own"]


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """An experiment by id; ``module`` has ``run(*, quick, progress) -> Result``."""

    summary: str
    module: str


@dataclass(frozen=True, kw_only=True)
class Section:
    """A further table of a result under a title of its own."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Result:
    """Rows of numbers with their reference, prose that says what they show, and a figure.

    ``cards`` are the sentences that model cards quote; ``source`` says what the data are.
    ``seconds`` are those of the command, ``training_seconds`` those of its trainings, whenever
    they were.
    """

    title: str
    source: Source
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    findings: tuple[str, ...]
    seed: int
    sections: tuple[Section, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    cards: Sequence[Mapping[str, Any]] = ()
    figure: Figure | None = None
    identifier: str = ""
    command: str = ""
    seconds: float = 0.0
    training_seconds: float | None = None

    def markdown(self) -> str:
        """The table and the findings."""
        head = f"# {self.identifier}: {self.title}\n\nData: {self.source}.\n"
        parts = [_table(self.columns, self.rows)]
        parts += [f"## {s.title}\n\n{_table(s.columns, s.rows)}" for s in self.sections]
        findings = "\n".join(f"- {f}" for f in self.findings)
        return f"{head}\n" + "\n\n".join(parts) + f"\n\n{findings}\n"

    def to_json(self) -> dict[str, Any]:
        """Everything but the figure as plain data, with versions and duration."""
        return {
            "id": self.identifier,
            "title": self.title,
            "source": self.source,
            "command": self.command or f"zoo experiment {self.identifier}",
            "seed": self.seed,
            "seconds": round(self.seconds, 1),
            **self._training(),
            "columns": list(self.columns),
            "rows": [list(r) for r in self.rows],
            "sections": [
                {"title": s.title, "columns": list(s.columns), "rows": [list(r) for r in s.rows]}
                for s in self.sections
            ],
            "findings": list(self.findings),
            "details": dict(self.details),
            "cards": [
                {"source": self.source, "command": f"zoo experiment {self.identifier}", **c}
                for c in self.cards
            ],
            "versions": {n: version(n) for n in ("movezoo", "torch", "pyro-ppl", "numpy")},
            "commit": commit(),
            "machine": {"cores": os.cpu_count(), "python": platform.python_version()},
        }

    def _training(self) -> dict[str, float]:
        known = self.training_seconds
        return {} if known is None else {"training_seconds": round(known, 1)}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The tables for a terminal, in parts where it is narrow, and the findings."""
        yield Markdown(f"# {self.identifier}: {self.title}\n\nData: {self.source}.")
        parts: list[Result | Section] = [self, *self.sections]
        for part in parts:
            yield from blocks(
                part.title if part is not self else "",
                part.columns,
                [[_cell(value) for value in row] for row in part.rows],
                width=options.max_width,
            )
        yield Markdown("\n".join(f"- {f}" for f in self.findings))


EXPERIMENTS: dict[str, Experiment] = {
    "E5.1": Experiment(
        summary="five movements by AE-DMP, its parts apart, DMP and PCA-DMP, against Table 2",
        module="zoo.studies.chapter5.e5_1",
    ),
    "E5.2": Experiment(
        summary="the f_target term, smoothness of latent paths, R² of joints, Fig. 34-36",
        module="zoo.studies.chapter5.e5_2",
    ),
    "E5.3": Experiment(
        summary="sparse AE-DMP of walking and jogging: kinds of units, a slow jog, Fig. 37 and 38",
        module="zoo.studies.chapter5.e5_3",
    ),
    "E5.4": Experiment(
        summary="missing joints of walking by the denoising chain and by conditioning, Table 3",
        module="zoo.studies.chapter5.e5_4",
    ),
    "E5.5": Experiment(
        summary="a missing section of walking: 10 frames seen, 60 filled in, Fig. 40",
        module="zoo.studies.chapter5.e5_5",
    ),
    "E5.6": Experiment(
        summary="punching to other goal attractors, Fig. 41",
        module="zoo.studies.chapter5.e5_6",
    ),
    "E6.1": Experiment(
        summary="five movements in one VAE-DMP and each in its own, against Table 2 and Fig. 45",
        module="zoo.studies.chapter6.e6_1",
    ),
    "E6.2": Experiment(
        summary="nine movements in 3-D: whether walks lie together, VAE-DMP and VAE, Fig. 47, 48",
        module="zoo.studies.chapter6.e6_2",
    ),
    "E6.3": Experiment(
        summary="smoothness of a 2-D latent space on a 120 × 120 grid, postures, Fig. 49 and 50",
        module="zoo.studies.chapter6.e6_3",
    ),
    "E6.4": Experiment(
        summary="jogging switched to walking from frame 20 to 38, (89), Fig. 51",
        module="zoo.studies.chapter6.e6_4",
    ),
    "E6.5": Experiment(
        summary="a robot arm sent to goals it was never shown, against DMP, Fig. 53",
        module="zoo.studies.chapter6.e6_5",
    ),
    "readme_forecast": Experiment(
        summary="the README's figure: a walk forecast with its bands, on a trial held out",
        module="zoo.studies.readme_forecast",
    ),
}


def commit() -> str:
    """The commit of the checkout that this package is in, changes of its code named; "" if none.

    >>> isinstance(commit(), str)
    True
    """
    here = Path(__file__).resolve().parents[2]
    try:
        if not (here / ".git").exists():
            return ""
        head = _git(here, "rev-parse", "--short=12", "HEAD")
        changed = _git(here, "status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f"{head}, with changes that are not committed" if changed else head


def _git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def run_experiment(
    identifier: str, output: Path, *, quick: bool = False, progress: bool = False
) -> Result:
    """Run an experiment and write ``ID.md``, ``ID.json`` and ``ID.png`` into ``output``."""
    if identifier not in EXPERIMENTS:
        near = difflib.get_close_matches(identifier, EXPERIMENTS, n=3) or list(EXPERIMENTS)
        raise UnknownNameError(f"no experiment {identifier!r}; nearest: {', '.join(near)}")
    run: Callable[..., Result] = import_module(EXPERIMENTS[identifier].module).run
    began = time.monotonic()
    with timed() as times:
        found = replace(run(quick=quick, progress=progress), training_seconds=sum(times))
    return write_result(found, identifier, output, time.monotonic() - began)


def write_result(found: Result, identifier: str, output: Path, seconds: float) -> Result:
    """The result under its name, written as ``ID.md``, ``ID.json`` and ``ID.png``."""
    result = replace(found, identifier=identifier, seconds=seconds)
    _write(result, output)
    return result


def _write(result: Result, output: Path) -> None:
    output.mkdir(parents=True, exist_ok=True)
    stem = output / result.identifier
    stem.with_name(f"{result.identifier}.md").write_text(result.markdown(), encoding="utf-8")
    text = _indented(result.to_json())
    stem.with_name(f"{result.identifier}.json").write_text(text + "\n", encoding="utf-8")
    if result.figure is not None:
        result.figure.savefig(stem.with_name(f"{result.identifier}.png"), dpi=150)


def _table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *("| " + " | ".join(_cell(c) for c in r) + " |" for r in rows)])


def _indented(value: Any, indent: str = "") -> str:
    """JSON, a line an item; lists of plain values take one line."""
    deeper = indent + " "
    if isinstance(value, dict) and value:
        items = (f"{deeper}{json.dumps(str(k))}: {_indented(v, deeper)}" for k, v in value.items())
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(v, (dict, list)) for v in value):
        return "[\n" + ",\n".join(deeper + _indented(v, deeper) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


def _cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
