"""Model cards: mathematics from the docstring, settings from the configs, measured results."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import Markdown
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from zoo.catalogue import CATALOGUE
from zoo.contract.registry import Entry, load
from zoo.runs.assembly import options

__all__ = ["Card", "as_markdown", "card", "measured"]


@dataclass(frozen=True, kw_only=True)
class Card:
    """Everything that one should know of an entry before choosing it."""

    entry: Entry
    text: str
    settings: Mapping[str, tuple[str, Any, Any]]
    meanings: tuple[str, ...]
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
            "guide": self.entry.posterior,
            "text": self.text,
            "settings": {
                k: {"part": p, "type": _type(t), "default": d}
                for k, (p, t, d) in self.settings.items()
            },
            "meanings": list(self.meanings),
            "results": [dict(r) for r in self.results],
        }

    def markdown(self) -> str:
        """The card as Markdown."""
        lines = [f"# {self.entry.name}", "", as_markdown(self.text), ""]
        lines += ["| setting | part | values | default |", "|---|---|---|---|"]
        for key, (part, kind, default) in self.settings.items():
            values = _type(kind).replace("|", "or")
            lines.append(f"| `{key}` | {part} | {values} | {default!r} |")
        lines += [f"\n{as_markdown(m)}" for m in self.meanings]
        lines += [""] + [f"- {_sentence(r)}" for r in self.results]
        return "\n".join(lines)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The card for a terminal."""
        yield Text(f"{self.entry.name} — {self.entry.summary}", style="bold")
        yield Text(
            f"thesis {self.entry.thesis} · {self.entry.data} · can "
            f"{', '.join(self.entry.capabilities)} · {type(self.entry.inference).__name__} · "
            f"guide: {self.entry.posterior} · default data {self.entry.dataset or 'none'}\n",
            style="dim",
        )
        yield from _shown(self.text)
        yield Text("\nSettings (zoo fit … --set KEY=VALUE)", style="bold")
        yield self._settings()
        for meaning in self.meanings:
            yield Text()
            yield from _shown(meaning)
        if self.results:
            yield Text("\nMeasured", style="bold")
        for result in self.results:
            yield Text(f"• {_sentence(result)}")

    def _settings(self) -> Table:
        table = Table("setting", "of", "values", "default", box=None, pad_edge=False)
        for key, (part, kind, default) in self.settings.items():
            table.add_row(key, part, Text(_type(kind)), Text(repr(default)))
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
        meanings=tuple(_meanings(entry)),
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


def _meanings(entry: Entry) -> Iterator[str]:
    """What the settings mean, part by part, where a part has any."""
    kinds = [load(path).config_class for path in (entry.model, entry.guide) if path is not None]
    for kind in (*kinds, type(entry.inference)):
        if dataclasses.fields(kind):
            yield inspect.getdoc(kind) or ""


def _type(kind: Any) -> str:
    """A type in words: choices by their values, alternatives between bars, no bounds."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _type(parts[0])
    if origin is Literal:
        return " | ".join(str(choice) for choice in parts)
    if origin in (Union, UnionType):
        return " | ".join(_type(part) for part in parts)
    if parts:
        inside = ", ".join("..." if part is ... else _type(part) for part in parts)
        return f"{getattr(origin, '__name__', origin)}[{inside}]"
    return "None" if kind is type(None) else str(getattr(kind, "__name__", kind))


def _blocks(text: str) -> Iterator[tuple[bool, str]]:
    """Prose and literal blocks of a docstring by turns, each with whether it is literal."""
    text = re.sub(r":\w+:`~?([^`]+)`", lambda m: f"``{m[1].rpartition('.')[2]}``", text)
    paragraphs = re.split(r"\n\s*\n", text)
    for literal, group in groupby(paragraphs, key=lambda p: p.startswith("    ")):
        yield literal, textwrap.dedent("\n\n".join(group)).replace("::", ":")


def _prose(text: str) -> str:
    """Markdown in which stars and underscores of formulas stay what they are."""
    parts = re.split(r"(``[^`]*``|(?<!\S)\*\w[^*]*\w\*(?!\w))", text)
    return "".join(p if i % 2 else re.sub(r"([*_])", r"\\\1", p) for i, p in enumerate(parts))


def as_markdown(text: str) -> str:
    """A docstring as Markdown: literal blocks as code, signs of formulas as they are."""
    parts = (f"```text\n{b}\n```" if literal else _prose(b) for literal, b in _blocks(text))
    return "\n\n".join(parts)


def _shown(text: str) -> Iterator[Markdown | Padding]:
    for literal, block in _blocks(text):
        yield Padding(Text(block), (1, 0, 1, 2)) if literal else Markdown(_prose(block))


def _sentence(result: Mapping[str, Any]) -> str:
    reference = f" (thesis: {result['thesis']})" if "thesis" in result else ""
    return (
        f"{result['what']}: {result['value']}{reference} [{result['source']}, {result['command']}]"
    )
