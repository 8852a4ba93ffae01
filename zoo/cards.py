"""Model cards: mathematics from the docstring, settings from the configs, measured results."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.markdown import Markdown
from rich.table import Table
from rich.text import Text

from zoo.assembly import options
from zoo.catalogue import CATALOGUE
from zoo.registry import Entry, load

__all__ = ["Card", "card", "measured"]


@dataclass(frozen=True, kw_only=True)
class Card:
    """Everything that one should know of an entry before choosing it."""

    entry: Entry
    text: str
    settings: Mapping[str, tuple[str, Any, Any]]
    results: tuple[Mapping[str, Any], ...]

    def to_json(self) -> dict[str, Any]:
        """The card as plain data."""
        return {
            "name": self.entry.name,
            "summary": self.entry.summary,
            "thesis": self.entry.thesis,
            "can": list(self.entry.capabilities),
            "data": self.entry.data,
            "dataset": self.entry.dataset,
            "inference": type(self.entry.inference).__name__,
            "text": self.text,
            "settings": {k: {"part": p, "default": d} for k, (p, _, d) in self.settings.items()},
            "results": [dict(r) for r in self.results],
        }

    def markdown(self) -> str:
        """The card as Markdown."""
        lines = [f"# {self.entry.name}", "", self.text, "", "| setting | part | default |"]
        lines += ["|---|---|---|"]
        lines += [f"| `{k}` | {p} | {d!r} |" for k, (p, _, d) in self.settings.items()]
        lines += [""] + [f"- {_sentence(r)}" for r in self.results]
        return "\n".join(lines)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The card for a terminal."""
        yield Text(f"{self.entry.name} — {self.entry.summary}", style="bold")
        yield Text(
            f"thesis {self.entry.thesis} · {self.entry.data} · can "
            f"{', '.join(self.entry.capabilities)} · {type(self.entry.inference).__name__} · "
            f"default data {self.entry.dataset}\n",
            style="dim",
        )
        yield Markdown(self.text)
        yield Group(Text("\nSettings (zoo fit … --set KEY=VALUE)", style="bold"), self._settings())
        for result in self.results:
            yield Text(f"• {_sentence(result)}")

    def _settings(self) -> Table:
        table = Table("setting", "of", "default", box=None, pad_edge=False)
        for key, (part, _, default) in self.settings.items():
            table.add_row(key, part, repr(default))
        return table


def card(name: str) -> Card:
    """The card of a model.

    >>> card("pca").entry.name
    'pca'
    """
    entry = CATALOGUE[name]
    return Card(
        entry=entry,
        text=inspect.getdoc(load(entry.model)) or "",
        settings=options(entry),
        results=measured(name),
    )


def measured(name: str) -> tuple[Mapping[str, Any], ...]:
    """Results that commands of this project stored for a model, newest experiment ids last."""
    found = []
    for file in sorted(files("zoo.results").iterdir(), key=lambda f: f.name):
        if file.name.endswith(".json"):
            payload = json.loads(file.read_text(encoding="utf-8"))
            found += [r for r in payload.get("cards", []) if r.get("model") == name]
    return tuple(found)


def _sentence(result: Mapping[str, Any]) -> str:
    reference = f" (thesis: {result['thesis']})" if "thesis" in result else ""
    return (
        f"{result['what']}: {result['value']}{reference} [{result['source']}, {result['command']}]"
    )
