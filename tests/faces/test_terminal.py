"""What a terminal and a pipe get: nothing cut at 80 columns, a record a line, how long it takes."""

from __future__ import annotations

import sys
from io import StringIO

import pytest
from rich.console import Console

from zoo.catalogue import CATALOGUE
from zoo.display import blocks
from zoo.evaluation.answers import Estimate
from zoo.evaluation.table import readable
from zoo.faces.tables import models_table
from zoo.faces.terminal import plain, show
from zoo.inference import progress
from zoo.inference.progress import TrainingBar

TASKS = ("reconstruct", "forecast", "impute joints", "impute section", "vae-dmp-rhythmic · regress")
NUMBER = readable(Estimate(3.312e-4, 4.1e-5))


def printed(*things: object, width: int = 80) -> str:
    text = StringIO()
    Console(file=text, width=width, color_system=None).print(*things)
    return text.getvalue()


def test_no_name_and_no_exponent_is_cut_at_80_columns() -> None:
    header = ["score", "unit", *TASKS]
    text = printed(*blocks("t", header, [["energy score", "deg", *[NUMBER] * 5]], width=80, keys=2))
    assert text.count(NUMBER) == 5 and "…" not in text
    assert all(word in text for task in TASKS for word in task.replace(" ·", "").split())
    assert max(map(len, text.splitlines())) <= 80


def test_models_keep_their_names_at_80_columns() -> None:
    text = printed(models_table(CATALOGUE))
    assert all(f"\n{e.name}" in text for e in CATALOGUE) and "…" not in text


def test_a_pipe_gets_a_record_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    show(models_table(CATALOGUE))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(list(CATALOGUE))
    for entry, line in zip(CATALOGUE, lines[1:], strict=True):
        assert line.startswith(entry.name) and line.endswith(entry.capabilities[-1])


def test_rules_and_padding_stay_out_of_a_pipe() -> None:
    (table,) = blocks("title", ["a", "b"], [["x", "1"]], width=80)
    assert [line.split() for line in plain(table).splitlines()] == [
        ["title"],
        ["a", "b"],
        ["x", "1"],
    ]


def test_how_long_is_said_from_the_first_epochs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    row = {"val_elbo": None, "c": 1.0, "reconstruction": 1.0, "kl": 0.5}
    with TrainingBar(epochs=601, steps=1, shown=True) as bar:
        for epoch in range(5):
            clock[0] += 0.4
            bar.epoch(row | {"epoch": epoch})
    said = capsys.readouterr()
    assert said.err == "about 4 min: 597 epochs × 0.4 s to go\n" and not said.out


def test_a_short_training_says_no_duration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    row = {"val_elbo": None, "c": 1.0, "reconstruction": 1.0, "kl": 0.5}
    with TrainingBar(epochs=6, steps=1, shown=True) as bar:
        for epoch in range(6):
            clock[0] += 0.4
            bar.epoch(row | {"epoch": epoch})
    assert capsys.readouterr().err == "epoch 6/6  log p(x|z) 1  KL 0.5\n"


def test_nothing_is_said_where_nothing_was_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    with TrainingBar(epochs=1, steps=1, shown=False) as bar:
        bar.epoch({"epoch": 0, "val_elbo": None, "c": 1.0, "reconstruction": 1.0, "kl": 0.5})
    assert capsys.readouterr().err == "" and not sys.stdout.isatty()
