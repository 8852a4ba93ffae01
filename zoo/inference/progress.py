"""Progress of a training: how long it will take, a bar in a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from zoo.inference.resume.history import Row

__all__ = ["TrainingBar", "spoken"]

_REFRESH = 0.1
_LONG, _SURE, _PAUSE = 10.0, 1.0, 30.0


def spoken(seconds: float) -> str:
    """A duration as one says it.

    >>> spoken(42.0), spoken(250.0), spoken(8000.0)
    ('about 42 s', 'about 4 min', 'about 2.2 h')
    """
    if seconds < 90:
        return f"about {seconds:.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


class TrainingBar:
    """Counts steps and shows the last epoch's figures on stderr; silent unless ``shown``.

    After the first second it says how long the training will take, if that is long. Where stderr
    is no terminal a line now and then stands in for the bar.
    """

    def __init__(self, *, epochs: int, steps: int, shown: bool) -> None:
        """A bar over ``epochs`` of ``steps`` batches."""
        self._steps, self._epochs, self._shown = steps, epochs, shown
        self._began: float | None = None
        self._first = 0
        self._told, self._next_line = False, 0.0
        console = Console(stderr=True)
        self._lines = shown and not console.is_terminal
        self._next = 0.0 if shown else float("inf")
        self._bar = Progress(
            TextColumn("epoch"),
            MofNCompleteColumn(),
            BarColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not shown or self._lines,
        )
        self._task = self._bar.add_task("training", total=epochs, figures="")

    def step(self, epoch: int, batch: int) -> None:
        """Move to a place in training; cheap enough for every step."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _REFRESH
            self._bar.update(self._task, completed=epoch + batch / self._steps)

    def epoch(self, row: Row) -> None:
        """Show the figures of an epoch that has ended."""
        if not self._shown:
            return
        self._say_how_long(row["epoch"] + 1)
        held = "" if row["val_elbo"] is None else f"  validation ELBO {row['val_elbo']:.4g}"
        tempered = "" if row["c"] == 1.0 else f"  c {row['c']:.2f}"
        figures = f"log p(x|z) {row['reconstruction']:.4g}  KL {row['kl']:.4g}{tempered}{held}"
        if self._lines:
            self._say(row["epoch"] + 1, figures)
        self._bar.update(self._task, completed=row["epoch"] + 1, figures=figures)

    def _say_how_long(self, done: int) -> None:
        """Once a second of epochs has been measured, the rest of them at that pace."""
        now = time.monotonic()
        if self._began is None:
            self._began, self._first = now, done
            return
        measured = done - self._first
        if self._told or now - self._began < _SURE:
            return
        self._told, pace = True, (now - self._began) / measured
        left = self._epochs - done
        if left * pace >= _LONG:
            at = f"{left} epochs × {pace:.2g} s" + ("" if done == measured else " to go")
            self._bar.console.print(f"{spoken(left * pace)}: {at}", highlight=False)

    def _say(self, done: int, figures: str) -> None:
        """A line at the end, and one every half minute before."""
        now = time.monotonic()
        self._next_line = self._next_line or now + _PAUSE
        if now >= self._next_line or done == self._epochs:
            self._next_line = now + _PAUSE
            print(f"epoch {done}/{self._epochs}  {figures}", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
