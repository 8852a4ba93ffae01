"""What the command line prints: tables for people, JSON for machines."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from zoo.contract.registry import Entry
    from zoo.datasets.records import Pairs, Sequences
    from zoo.runs.run import Run

__all__ = [
    "data_table",
    "describe",
    "models_markdown",
    "models_table",
    "print_json",
    "report_table",
]


def print_json(value: Any) -> None:
    """One JSON document on standard output."""
    print(json.dumps(value, indent=1, allow_nan=False))


def models_table(entries: Iterable[Entry]) -> Table:
    """Entries with their tasks, a line each."""
    table = Table(box=None, pad_edge=False)
    table.add_column("model", no_wrap=True, overflow="fold")
    table.add_column("what it is")
    table.add_column("can", overflow="fold")
    for entry in entries:
        table.add_row(
            f"[bold]{entry.name}[/]",
            f"{entry.summary} [dim]({entry.thesis}; guide: {entry.posterior})[/]",
            " ".join(entry.capabilities),
        )
    return table


def models_markdown(entries: Iterable[Entry]) -> str:
    """Entries as a Markdown table, for the README."""
    titles = ("model", "what it is", "thesis", "guide", "inference", "can")
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    lines += [
        f"| `{e.name}` | {e.summary} | {e.thesis} | {e.posterior} | "
        f"{type(e.inference).__name__} | {', '.join(e.capabilities)} |"
        for e in entries
    ]
    return "\n".join(lines)


def data_table(rows: Mapping[str, Any] | Sequence[str]) -> Table:
    """Names and values, a line each."""
    table = Table(box=None, show_header=False)
    if isinstance(rows, Mapping):
        for key, value in rows.items():
            inner = value.items() if isinstance(value, Mapping) else ()
            text = "\n".join(f"{k}: {v}" for k, v in inner) if inner else str(value)
            table.add_row(f"[bold]{key}[/]", Text(text))
    else:
        for name in rows:
            table.add_row(name)
    return table


def report_table(run: Run) -> Table:
    """What the model learned, a line each; standard deviations in the data's units."""
    table = Table(title=f"learned by {run.name}", box=None, show_header=False, title_justify="left")
    layout = run.assembly.layout
    units = " ".join(dict.fromkeys(u for u in layout.units if u))
    for name, value in run.report().items():
        unit = units if "_std" in name else ""
        table.add_row(f"[bold]{name.replace('_', ' ')}[/]", _shortened(_numbers(value)), unit)
    return table


def describe(data: Pairs | Sequences) -> dict[str, Any]:
    """What a data set holds, in words and numbers."""
    layout = data.layout
    description: dict[str, Any] = {"name": data.name, "provenance": data.provenance}
    if layout.kind == "sequences":
        lengths = data.lengths.tolist()  # type: ignore[union-attr]
        several = len(set(lengths)) > 1
        description |= {
            "movements": len(data),
            "frames": f"{min(lengths)}–{max(lengths)}" if several else str(lengths[0]),
            "rate": _rate(data),  # type: ignore[arg-type]
        }
    else:
        description |= {"items": len(data), "features": len(layout.inputs)}
    description |= {
        "channels": f"{len(layout.channels)}: {_shortened(layout.channels)}",
        "units": _shortened(tuple(dict.fromkeys(layout.units))),
        "missing": f"{1 - _present(data):.1%}",
        "groups": {k: _shortened(tuple(dict.fromkeys(v))) for k, v in data.groups.items()},
    }
    if notes := getattr(data, "notes", ()):
        description["notes"] = "; ".join(notes)
    return description


def _numbers(value: Any) -> list[str]:
    """A value, or all of a list of lists, to four digits."""
    if isinstance(value, list):
        return [number for part in value for number in _numbers(part)]
    return [f"{value:.4g}" if isinstance(value, float) else str(value)]


def _rate(data: Sequences) -> str:
    return f"{data.rate:.4g} Hz{' on average' if data.time_normalised else ''}"


def _present(data: Pairs | Sequences) -> float:
    from zoo.datasets.records import Sequences

    if not isinstance(data, Sequences):
        return float(data.mask.double().mean())
    return float(data.mask.sum() / (data.lengths.sum() * len(data.channels)))


def _shortened(names: Sequence[str], count: int = 6) -> str:
    return ", ".join(names[:count]) + (f", … ({len(names)})" if len(names) > count else "")
