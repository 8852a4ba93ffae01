"""A progress bar for training that shows reconstruction and KL apart."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from zoo.inference.resume.history import Row

__all__ = ["TrainingBar"]

_REFRESH = 0.1


class TrainingBar:
    """Counts steps and shows the last epoch's figures; silent unless ``shown``."""

    def __init__(self, *, epochs: int, steps: int, shown: bool) -> None:
        """A bar over ``epochs`` of ``steps`` batches."""
        self._steps = steps
        self._next = 0.0 if shown else float("inf")
        self._bar = Progress(
            TextColumn("epoch"),
            MofNCompleteColumn(),
            BarColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(),
            disable=not shown,
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
        if self._bar.disable:
            return
        held = "" if row["val_elbo"] is None else f"  validation ELBO {row['val_elbo']:.4g}"
        tempered = "" if row["c"] == 1.0 else f"  c {row['c']:.2f}"
        figures = f"log p(x|z) {row['reconstruction']:.4g}  KL {row['kl']:.4g}{tempered}{held}"
        self._bar.update(self._task, completed=row["epoch"] + 1, figures=figures)

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
