"""Minibatch stochastic variational inference: the same bits whether interrupted or not."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import pyro
from torch import nn

from zoo.contract.strategies import Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import TrainingError, TrainingWarning
from zoo.inference.collapse import warn_of_collapse
from zoo.inference.loader import Loader
from zoo.inference.progress import TrainingBar
from zoo.inference.resume import checkpoint
from zoo.inference.resume.history import History, Log, Row
from zoo.inference.resume.state import FIGURES, Best, Parts, Place, State, fingerprint
from zoo.inference.schedules import ramp
from zoo.inference.steps import NotFiniteError, Steps
from zoo.streams import seeded

__all__ = ["fit_svi"]

TRIES = 6
SETTLED = 200
SHARE = 0.05


def fit_svi(
    model: nn.Module,
    guide: nn.Module,
    train: Sequences | Pairs,
    strategy: Svi,
    *,
    val: Sequences | Pairs | None = None,
    seed: int = 0,
    device: str = "cpu",
    folder: Path | str | None = None,
    resume: Literal["never", "auto", "must"] = "never",
    progress: bool = False,
    tensorboard: bool = False,
    on_epoch: Callable[[Row], None] | None = None,
    checkpoint_seconds: float = 60.0,
) -> History:
    """Train ``model`` and ``guide`` in place on scaled data of the model's dtype.

    The noise of a step depends on the seed and the step alone, and the order of the data on the
    seed and the epoch: a training that was killed at any moment and resumed from ``folder`` ends
    in the same bits as one that was not. A checkpoint is written every
    ``strategy.checkpoint_every`` epochs, less often where that would cost more than 5 % of the
    time, and every ``checkpoint_seconds``, inside an epoch too. With ``val`` the state of the best
    un-tempered validation bound is restored; only epochs with c = β = 1 count.

    Raises TrainingError where the loss stays non-finite however small the step, DamagedRunError
    for a checkpoint that is damaged, OtherTrainingError for one of another training, and
    FileNotFoundError where ``resume="must"`` finds none.
    """
    place = None if folder is None else Path(folder)
    with ExitStack() as scope:
        log = scope.enter_context(Log(place, tensorboard=tensorboard))
        with seeded(seed, device):
            training = _Training(model, guide, train, strategy, val, seed, device)
            training.keep_in(place, log, checkpoint_seconds)
            training.begin(resume)
        bar = TrainingBar(
            epochs=training.strategy.epochs, steps=len(training.loader), shown=progress
        )
        training.run(scope.enter_context(bar), on_epoch)
    return training.state.history


class _Training:
    def __init__(
        self,
        model: nn.Module,
        guide: nn.Module,
        train: Sequences | Pairs,
        strategy: Svi,
        val: Sequences | Pairs | None,
        seed: int,
        device: str,
    ) -> None:
        self.loader = _loader(train, strategy, seed, device)
        self.strategy = strategy = strategy.budgeted(len(self.loader))
        self.val = None if val is None else _loader(val, strategy, seed, device)
        self.steps = Steps(model, guide, self.loader, strategy, seed=seed, device=device)
        self.parts = Parts(model, guide, self.steps.optimizer)
        self.state = State(self.parts.tensors())
        self.made_of = fingerprint(
            self.steps.parameters, strategy, seed, training=train, validation=val
        )

    def keep_in(self, folder: Path | None, log: Log, seconds: float) -> None:
        self.folder, self.log, self.seconds = folder, log, seconds
        self.written, self.pause = time.monotonic(), 0.0

    def begin(self, resume: str) -> None:
        if resume not in ("never", "auto", "must"):
            raise ValueError(f"resume must be 'never', 'auto' or 'must'; got {resume!r}")
        found = self.folder is not None and checkpoint.exists(self.folder)
        if resume == "must" and not found:
            raise FileNotFoundError(f"resume='must': there is no checkpoint in {self.folder}")
        if self.folder is not None and resume == "never":
            checkpoint.clear(self.folder)
        elif self.folder is not None and found:
            self.state = State.load(self.folder, self.parts, self.made_of)
        self.log.start(self.state.history)

    def run(self, bar: TrainingBar, on_epoch: Callable[[Row], None] | None) -> None:
        try:
            while not self.state.finished:
                try:
                    with seeded(self.steps.seed, self.steps.device), pyro.validation_enabled(False):
                        self._epoch(bar, on_epoch)
                except NotFiniteError as what:
                    self._go_back(str(what))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(self._interrupted()) from None

    def _epoch(self, bar: TrainingBar, on_epoch: Callable[[Row], None] | None) -> None:
        started, epoch = time.monotonic(), self.state.place.epoch
        c = ramp(epoch, self.strategy.temper_epochs)
        beta = ramp(epoch, self.strategy.warmup_epochs)
        self._steps(c, beta, bar)
        row = self._row(c, beta)
        waited = self._validate(row)
        row["seconds"] = time.monotonic() - started
        self._report(row, bar, on_epoch)
        self.state.place = Place(epoch=epoch + 1, step=self.state.place.step, waited=waited)
        self._close()

    def _steps(self, c: float, beta: float, bar: TrainingBar) -> None:
        state, place = self.state, self.state.place
        self.steps.mode(training=True)
        start = self.parts.tensors() if place.batch == 0 else None
        for batch in self.loader.epoch(place.epoch, place.batch):
            figures = self.steps.take(batch, state.place, tries=state.tries, c=c, beta=beta)
            if start is not None:
                state.good, state.good_place, start = start, place, None
            state.place = state.place.after(figures)
            bar.step(place.epoch, state.place.batch)
            self._save_after(self.seconds)

    def _row(self, c: float, beta: float) -> Row:
        sums = zip(FIGURES, self.state.place.sums, strict=True)
        means = {name: value / self.loader.total for name, value in sums}
        rate = self.steps.rate(self.state.place.step - 1, self.state.tries)
        row: Row = {"epoch": self.state.place.epoch, **means, "c": c, "beta": beta}
        return row | {"lr": rate, "val_elbo": None}

    def _validate(self, row: Row) -> int:
        """Validate where it is due; how many validations have passed without progress."""
        epoch, state = row["epoch"] + 1, self.state
        due = epoch % self.strategy.validate_every == 0 or epoch == self.strategy.epochs
        if self.val is None or not due:
            return state.place.waited
        row["val_elbo"] = elbo = self.steps.plain_bound(self.val)
        if min(row["c"], row["beta"]) < 1.0 or not self.steps.settled(state.place.step - 1):
            return 0
        if state.best is not None and elbo <= state.best.elbo:
            return state.place.waited + 1
        state.best, state.best_tensors = Best(epoch=epoch - 1, elbo=elbo), self.parts.modules()
        return 0

    def _report(self, row: Row, bar: TrainingBar, on_epoch: Callable[[Row], None] | None) -> None:
        self.state.history.rows.append(row)
        self.log.add(row)
        bar.epoch(row)
        if on_epoch is not None:
            on_epoch(row)

    def _close(self) -> None:
        place, strategy = self.state.place, self.strategy
        bored = strategy.patience is not None and place.waited >= strategy.patience
        if bored or place.epoch == strategy.epochs:
            self._finish()
        elif place.epoch % strategy.checkpoint_every == 0:
            self._save_after(self.pause)

    def _finish(self) -> None:
        if self.state.best is not None:
            self.parts.put_modules(self.state.best_tensors)
        self.state.finished = True
        self._save()
        self.steps.advance(1.0)
        if self.state.place.step >= SETTLED:
            self.steps.noise("collapse")
            rows = self.loader.order(0)[: self.strategy.batch_size]
            warn_of_collapse(self.parts.model, self.parts.guide, self.loader.take(rows))

    def _save_after(self, seconds: float) -> None:
        if time.monotonic() - self.written >= seconds:
            self._save()

    def _save(self) -> None:
        if self.folder is None:
            return
        begin = time.monotonic()
        self.state.save(self.folder, self.parts, self.made_of)
        self.written = time.monotonic()
        self.pause = (self.written - begin) / SHARE

    def _go_back(self, what: str) -> None:
        """Return to the last good state with half the step size, a bounded number of times."""
        state = self.state
        where = f"{what} is not finite at step {state.place.step} (epoch {state.place.epoch})"
        if state.tries == TRIES:
            raise TrainingError(
                f"{where}, after going back {TRIES} times with half the step size each time "
                f"(learning_rate={self.strategy.learning_rate:g}): try a smaller learning_rate "
                "or clip, another scaling, or look for outliers in the data"
            )
        state.tries += 1
        state.place = state.good_place
        self.parts.put(state.good)
        state.history.back_to(state.place.epoch)
        self.log.start(state.history)
        rate = self.steps.rate(state.place.step, state.tries)
        again = f"back to the start of epoch {state.place.epoch} with step size {rate:g}"
        warnings.warn(f"{where}: {again}", TrainingWarning, stacklevel=4)

    def _interrupted(self) -> str:
        where = f"interrupted in epoch {self.state.place.epoch} of {self.strategy.epochs}"
        if self.folder is None:
            return f"{where}; nothing was kept: with run_dir=... checkpoints are"
        if not checkpoint.exists(self.folder):
            return f"{where}; before the first checkpoint in {self.folder}: start it again"
        return f"{where}; resume='auto' goes on from the checkpoint in {self.folder}"


def _loader(data: Sequences | Pairs, strategy: Svi, seed: int, device: str) -> Loader:
    return Loader(
        data.to(device=device),
        batch_size=strategy.batch_size,
        window=strategy.window,
        stride=strategy.stride,
        seed=seed,
    )
