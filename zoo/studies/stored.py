"""Results that ship with the package, to be read in a notebook: table, findings and figure."""

from __future__ import annotations

import base64
import difflib
import html
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from zoo.errors import UnknownNameError

__all__ = ["Stored", "stored"]

_CELL = "padding:2px 8px;text-align:"


@dataclass(frozen=True, kw_only=True)
class Stored:
    """A stored result; ``picture`` is its figure as PNG, None where only the numbers ship."""

    payload: Mapping[str, Any]
    picture: bytes | None = field(default=None, repr=False)

    def _repr_html_(self) -> str:
        """Table, findings, how to reproduce them, and the figure."""
        findings = "".join(f"<li>{html.escape(f)}</li>" for f in self.payload["findings"])
        return (
            f"<h4>{html.escape(self.payload['id'])}: {html.escape(self.payload['title'])}</h4>"
            f"{self._table(self.payload)}{self._sections()}<ul>{findings}</ul>"
            f"<p>Reproduce: <code>{html.escape(self.payload['command'])}</code> "
            f"(data: {html.escape(self.payload['source'])}).</p>{self._image()}"
        )

    def _sections(self) -> str:
        return "".join(
            f"<h5>{html.escape(section['title'])}</h5>{self._table(section)}"
            for section in self.payload.get("sections", ())
        )

    def _table(self, part: Mapping[str, Any]) -> str:
        head = "".join(_cell("th", c, first=not i) for i, c in enumerate(part["columns"]))
        rows = (
            "".join(_cell("td", c, first=not i) for i, c in enumerate(row)) for row in part["rows"]
        )
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        return (
            '<div style="overflow-x:auto"><table style="font-size:12px;margin:0">'
            f"<thead><tr>{head}</tr></thead>{body}</table></div>"
        )

    def _image(self) -> str:
        if self.picture is None:
            return ""
        data = base64.b64encode(self.picture).decode()
        alt = f"stored figure of {html.escape(self.payload['id'])}"
        return f'<img alt="{alt}" style="width:100%" src="data:image/png;base64,{data}">'


def stored(identifier: str) -> Stored:
    """What ``zoo experiment`` or ``zoo leaderboard`` found last and this package ships.

    >>> stored("E5.1").payload["source"]
    'thesis'
    >>> stored("E5.9")
    Traceback (most recent call last):
    zoo.errors.UnknownNameError: no stored result 'E5.9'; nearest: E5.6, E5.5, E5.4
    """
    home = files("zoo.results")
    numbers, picture = home / f"{identifier}.json", home / f"{identifier}.png"
    files_there = (f.name for f in home.iterdir() if f.name.startswith(("E", "leaderboard_")))
    known = sorted(name.removesuffix(".json") for name in files_there if name.endswith(".json"))
    if identifier not in known:
        near = difflib.get_close_matches(identifier, known, n=3) or known
        raise UnknownNameError(f"no stored result {identifier!r}; nearest: {', '.join(near)}")
    return Stored(
        payload=json.loads(numbers.read_text(encoding="utf-8")),
        picture=picture.read_bytes() if picture.is_file() else None,
    )


def _cell(tag: str, value: Any, *, first: bool) -> str:
    text = f"{value:.3g}" if isinstance(value, float) else str(value)
    side = "left" if first else "right"
    return f'<{tag} style="{_CELL}{side}">{html.escape(text)}</{tag}>'
