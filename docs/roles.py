"""Docstrings of this house as Markdown: roles, formulas and examples, for mkdocstrings."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

from zoo.cards import as_markdown

__all__ = ["House"]


class House(Extension):
    """Every docstring as Markdown in which formulas stay what they are and examples are code."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite the docstring of a loaded object."""
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(docstring: str) -> str:
    """A docstring as Markdown.

    >>> print(markdown("Of :class:`~zoo.run.Run`.\\n\\n>>> 1 + 1\\n2"))
    Of ``Run``.
    <BLANKLINE>
    ```pycon
    >>> 1 + 1
    2
    ```
    """
    paragraphs = re.split(r"\n\s*\n", docstring)
    return "\n\n".join(
        f"```pycon\n{p}\n```" if p.lstrip().startswith(">>>") else as_markdown(p)
        for p in paragraphs
    )
