"""Cards as a terminal of 80 columns shows them: no formula may lose a sign."""

from __future__ import annotations

import inspect
import io
import re

import pytest
from rich.console import Console

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.registry import load
from zoo.runs.assembly import options

every = pytest.mark.parametrize("name", CATALOGUE.names())


def rendered(thing: object) -> str:
    """What ``rich`` prints of it."""
    out = io.StringIO()
    Console(file=out, width=80).print(thing)
    return out.getvalue()


def signs(text: str) -> str:
    """All signs of a text but its spaces and its markup."""
    text = re.sub(r":\w+:`~?([^`]+)`", lambda m: m[1].rpartition(".")[2], text)
    text = re.sub(r"(?<!\S)\*(\w[^*]*\w)\*(?!\w)", r"\1", text)
    return re.sub(r"\s|`|:(?=:)", "", text)


@every
def test_every_sign_of_the_mathematics_is_shown(name: str) -> None:
    shown = signs(rendered(zoo.card(name)))
    for kind in (load(CATALOGUE[name].model), load(CATALOGUE[name].model).config_class):
        assert signs(inspect.getdoc(kind) or "") in shown
    assert "::" not in shown and ":class:" not in shown


@every
def test_formulas_keep_their_lines(name: str) -> None:
    text = inspect.getdoc(load(CATALOGUE[name].model)) or ""
    formulas = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    lines = {line.strip() for line in rendered(zoo.card(name)).splitlines()}
    assert set(formulas) <= lines


@every
def test_every_setting_says_what_it_takes(name: str) -> None:
    card = zoo.card(name)
    assert set(card.to_json()["settings"]) == set(options(CATALOGUE[name]))
    for setting in card.to_json()["settings"].values():
        assert re.fullmatch(r"[\w\s|,.\[\]-]+", setting["type"]), setting
        assert not re.search("typing|class|Literal", setting["type"]), setting


def test_choices_are_spelled_out() -> None:
    settings = zoo.card("dmp").to_json()["settings"]
    assert settings["kind"]["type"] == "discrete | rhythmic"
    assert settings["learning"]["type"] == "path | force | lwr"
    assert "| `kind` | model | discrete or rhythmic | 'discrete' |" in zoo.card("dmp").markdown()


def test_markdown_keeps_formulas_apart() -> None:
    text = zoo.card("vae-dmp").markdown()
    assert "```text\nw ~ N(0, I)" in text
    assert r"z\*\_t = g(z\_t)" in text
