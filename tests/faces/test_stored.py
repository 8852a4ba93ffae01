"""Stored results in a notebook: all numbers, nothing that escapes, the figure where it is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zoo.errors import UnknownNameError
from zoo.studies import EXPERIMENTS, stored


@pytest.mark.parametrize("identifier", [e for e in EXPERIMENTS if e[1] in "56"])
def test_every_experiment_of_the_notebooks_can_be_shown(identifier: str) -> None:
    """A cell for every number, a point for every finding, and the command."""
    found = stored(identifier)
    page = found._repr_html_()
    tables = [found.payload, *found.payload.get("sections", ())]
    assert page.count("<td ") == sum(len(row) for table in tables for row in table["rows"])
    assert page.count("<li>") == len(found.payload["findings"])
    assert f"zoo experiment {identifier}" in page


def test_the_figure_is_shown_where_it_is_at_hand() -> None:
    """The wheel ships numbers only."""
    found = replace(stored("E5.1"), picture=b"PNG")
    assert "data:image/png;base64,UE5H" in found._repr_html_()
    assert "<img" not in replace(found, picture=None)._repr_html_()


def test_names_stay_text_and_unknown_ones_are_refused() -> None:
    """Mark-up in a title or a cell is shown, not obeyed."""
    found = stored("E5.1")
    payload = {**found.payload, "title": "<b>", "rows": [["<script>", 1.0]]}
    page = replace(found, payload=payload)._repr_html_()
    assert "<b>" not in page
    assert "<script>" not in page
    with pytest.raises(UnknownNameError, match="no stored result 'E9"):
        stored("E9.9")
