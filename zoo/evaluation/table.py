"""Scores as a table to read: in the terminal, in Markdown, in a notebook, or as JSON."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any, Self

from zoo.display import blocks
from zoo.evaluation.answers import Estimate
from zoo.evaluation.scores import SCORES, Scores

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

__all__ = ["Refusal", "Row", "Table", "readable"]

_SHOWN = tuple(
    name
    for name in SCORES
    if name not in ("interval_50", "interval_80", "interval_95", "width_50", "width_80", "width_95")
)
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_ABSENT = "—"


@dataclass(frozen=True, kw_only=True)
class Row:
    """The scores of one model on one task of one data set."""

    model: str
    data: str
    task: str
    scores: Scores


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why one model has no answer to one task of one data set."""

    model: str
    data: str
    task: str
    reason: str


@dataclass(frozen=True)
class Table:
    """Scores of models on tasks: a line a score, a column an answer.

    ``print`` and ``rich`` show it; notebooks render it; :meth:`to_markdown` and :meth:`to_json`
    keep it. JSON holds more than is shown: all levels, channels and the reliability curve.
    ``refusals`` are the tasks that a model had no answer to, with the reason.
    """

    rows: tuple[Row, ...]
    refusals: tuple[Refusal, ...] = ()

    @classmethod
    def of(
        cls,
        model: str,
        data: str,
        scores: Sequence[tuple[str, Scores]],
        refused: Mapping[str, str] | None = None,
    ) -> Self:
        """The table of one model's answers, given as (task, scores), and tasks refused with why."""
        return cls(
            tuple(Row(model=model, data=data, task=t, scores=s) for t, s in scores),
            tuple(
                Refusal(model=model, data=data, task=t, reason=r)
                for t, r in (refused or {}).items()
            ),
        )

    @classmethod
    def join(cls, tables: Sequence[Table]) -> Self:
        """Several models or data sets side by side."""
        return cls(
            tuple(row for table in tables for row in table.rows),
            tuple(refusal for table in tables for refusal in table.refusals),
        )

    def select(self, task: str) -> Self:
        """Only the answers to one task."""
        return type(self)(
            tuple(row for row in self.rows if row.task == task),
            tuple(refusal for refusal in self.refusals if refusal.task == task),
        )

    def __getitem__(self, task: str) -> Scores:
        """Scores of the first answer to ``task``."""
        for row in self.rows:
            if row.task == task:
                return row.scores
        for refusal in self.refusals:
            if refusal.task == task:
                raise KeyError(f"{refusal.model} has no answer to {task}: {refusal.reason}")
        raise KeyError(f"no task {task!r}; there are {', '.join(r.task for r in self.rows)}")

    @property
    def title(self) -> str:
        """What all answers share."""
        models, data = ({getattr(r, k) for r in self.rows} for k in ("model", "data"))
        shared = [*(models if len(models) == 1 else ()), *(data if len(data) == 1 else ())]
        return " on ".join(shared)

    @property
    def header(self) -> list[str]:
        """Titles of the columns."""
        return ["score", "unit", *(self._column(row) for row in self.rows)]

    @property
    def body(self) -> list[list[str]]:
        """A line for every score that any answer has."""
        lines = []
        for name in _SHOWN:
            found = [row.scores[name] for row in self.rows]
            if any(e is not None for e in found):
                units = [row.scores.unit_of(name) for row in self.rows]
                same = len(set(units)) == 1
                cells = [
                    readable(e) + ("" if same or e is None else f" {unit}")
                    for e, unit in zip(found, units, strict=True)
                ]
                lines.append([SCORES[name][0], units[0] if same else "", *cells])
        return lines

    @property
    def legend(self) -> str:
        """How to read the numbers, in one paragraph."""
        counts = ", ".join(
            f"{self._column(r)}: {r.scores.entries} entries in {r.scores.groups} groups"
            for r in self.rows
        )
        return (
            f"± is the standard error over groups (movements, trials). {counts}. "
            "Smaller is better for errors, NLL, CRPS, energy, variogram and interval scores; "
            "a band should hold its nominal share. — : the prediction cannot honestly give it."
            + "".join(f" No answer to {r.task} by {r.model}: {r.reason}." for r in self.refusals)
        )

    def to_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "answers": [
                {"model": r.model, "data": r.data, **r.scores.to_json(), "task": r.task}
                for r in self.rows
            ],
            "refused": [asdict(r) for r in self.refusals],
        }

    def to_markdown(self) -> str:
        """A Markdown table with its legend."""
        rule = [":---", ":---", *("---:" for _ in self.rows)]
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.header, rule, *self.body)]
        return "\n".join([f"**{self.title}**", "", *lines, "", self.legend])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """What ``rich`` prints: parts one below the other where the terminal is narrow."""
        from rich.text import Text

        yield from blocks(self.title, self.header, self.body, width=options.max_width, keys=2)
        yield Text(self.legend, style="dim italic")

    def __str__(self) -> str:
        """The table as plain text."""
        from rich.console import Console

        text = StringIO()
        Console(file=text, width=100, color_system=None).print(self)
        return text.getvalue()

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in self.header)
        lines = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
            for cells in self.body
        )
        return (
            f"<table><caption>{html.escape(self.title)}</caption><thead><tr>{head}</tr></thead>"
            f"<tbody>{lines}</tbody></table><p><small>{html.escape(self.legend)}</small></p>"
        )

    def _column(self, row: Row) -> str:
        others = self.rows
        parts = [row.model if len({r.model for r in others}) > 1 else ""]
        parts.append(row.data if len({r.data for r in others}) > 1 else "")
        parts.append(row.task if len({r.task for r in others}) > 1 or not any(parts) else "")
        return " · ".join(p for p in parts if p)


def readable(estimate: Estimate | None) -> str:
    """A number with as many digits as its error leaves it; an error of 0 is left out.

    >>> readable(Estimate(0.91234, 0.0213)), readable(Estimate(3.312e-4, 4.1e-5)), readable(None)
    ('0.91 ± 0.02', '(3.3 ± 0.4)·10⁻⁴', '—')
    """
    if estimate is None:
        return _ABSENT
    value, error = estimate.value, estimate.error
    if error is not None and error < 1e-6 * abs(value):
        error = None
    if not math.isfinite(value):
        return "∞" if value > 0 else "-∞"
    power = _power(max(abs(value), error or 0.0))
    scale = 10.0**power
    digits = _digits(None if error is None else error / scale, value / scale)
    text = f"{value / scale:.{digits}f}"
    if error is not None:
        text = f"{text} ± {error / scale:.{digits}f}"
    if power == 0:
        return text
    suffix = f"·10{str(power).translate(_SUPERSCRIPT)}"
    return f"({text}){suffix}" if error is not None else f"{text}{suffix}"


def _power(size: float) -> int:
    if size == 0 or 1e-2 <= size < 1e4:
        return 0
    return math.floor(math.log10(size))


def _digits(error: float | None, value: float) -> int:
    """Decimals that show one digit of the error, two of one that starts with 1.

    Without an error three digits of the value are shown.
    """
    size = error if error else abs(value)
    if not size or not math.isfinite(size):
        return 2
    first = math.floor(math.log10(size))
    wanted = 2 if error is None else int(size < 2 * 10.0**first)
    return min(6, max(0, wanted - first))
