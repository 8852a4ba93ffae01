"""Type-II maximum likelihood of any model with a log evidence, resumable bit for bit."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from torch import nn
from torch.linalg import LinAlgError  # type: ignore[attr-defined]
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import TrainingError
from zoo.inference.minimise import MINIMISERS, Evaluate, Vector
from zoo.inference.resume.journal import Journal
from zoo.streams import seeded

__all__ = ["evaluator", "fit_marginal", "maximise"]

_MOST = 32
_log = logging.getLogger(__name__)


def fit_marginal(
    model: Any,
    train: Sequences | Pairs,
    strategy: MarginalLikelihood,
    *,
    seed: int,
    progress: bool = False,
    folder: Path | None = None,
    resume: Literal["never", "auto", "must"] = "never",
) -> list[dict[str, Any]]:
    """Fit a model with an evidence to scaled data; returns a row an iteration.

    ``model`` is :class:`~zoo.contract.parts.MaximisesEvidence`.
    With ``folder`` every evaluation is kept in a journal there, from which ``resume`` goes on.
    Raises :class:`~zoo.errors.TrainingError` where the evidence is not finite at the start or
    nowhere near the best point.
    """
    with seeded(seed), _bar(progress, strategy.iterations * strategy.restarts) as advance:
        model.condition(train)
        journal = Journal(evaluator(model), folder, resume)
        rows = maximise(model, strategy, journal, advance)
        model.settle()
    return rows


def maximise(
    model: Any, strategy: MarginalLikelihood, evaluate: Evaluate, advance: Any = None
) -> list[dict[str, Any]]:
    """Set the model's parameters to the best of ``strategy.restarts`` optimisations.

    The first starts where the parameters are, the others one standard normal step away.
    """
    parameters = _trainable(model)
    count = sum(p.numel() for p in parameters)
    if strategy.optimizer == "newton" and count > _MOST:
        raise ValueError(
            f"optimizer='newton' is for up to {_MOST} parameters; {type(model).__name__} has "
            f"{count}: take optimizer='l-bfgs'"
        )
    origin = parameters_to_vector(parameters).detach().double().numpy().copy()
    rows: list[dict[str, Any]] = []
    ends: list[tuple[float, Vector]] = []
    for restart in range(strategy.restarts):
        start = origin if restart == 0 else origin + torch.randn(origin.size).double().numpy()
        log = _Log(evaluate, type(model).__name__, restart, rows, advance)
        log.begin(start)
        minimise = MINIMISERS[strategy.optimizer]
        end = minimise(
            log,
            start,
            iterations=strategy.iterations,
            tolerance=strategy.tolerance,
            report=log.report,
        )
        ends.append((rows[-1]["objective"], end))
    best = min(range(len(ends)), key=lambda i: ends[i][0])
    _assign(parameters, ends[best][1])
    return rows


def evaluator(model: Any) -> Evaluate:
    """The model's objective as a function from a parameter vector to value and gradient.

    A covariance that cannot be factorised counts as a value that is not finite.
    """
    parameters = _trainable(model)

    def evaluate(x: Vector) -> tuple[float, Vector]:
        _assign(parameters, x)
        try:
            value = model.objective()
        except LinAlgError as error:
            _log.info("no factorisation at %s: %s", x[:4], error)
            return np.nan, np.full_like(x, np.nan)
        gradients = torch.autograd.grad(value, parameters)
        flat = torch.cat([g.reshape(-1) for g in gradients])
        return float(value.detach()), flat.double().numpy().copy()

    return evaluate


class _Log:
    """Counts evaluations and writes the history's rows."""

    def __init__(
        self, evaluate: Evaluate, model: str, restart: int, rows: list[dict[str, Any]], advance: Any
    ) -> None:
        self.evaluate, self.model, self.restart = evaluate, model, restart
        self.rows, self.advance = rows, advance
        self.iteration = self.evaluations = 0
        self.first: tuple[bytes, tuple[float, Vector]] | None = None

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        if self.first is not None and self.first[0] == x.tobytes():
            return self.first[1]
        self.evaluations += 1
        return self.evaluate(x)

    def begin(self, x: Vector) -> None:
        """Evaluate the start, which must be finite."""
        value, gradient = self(x)
        if not np.isfinite(value) or not np.isfinite(gradient).all():
            raise TrainingError(
                f"{self.model}: the log evidence is {value} at the start of optimisation "
                f"{self.restart}; scale the data, or raise noise_floor or jitter"
            )
        self.first = x.tobytes(), (value, gradient)
        self.report(x, value, gradient)

    def report(self, x: Vector, value: float, gradient: Vector) -> None:
        """Add a row."""
        row = {
            "iteration": self.iteration,
            "restart": self.restart,
            "objective": value,
            "gradient_norm": float(np.linalg.norm(gradient)),
            "evaluations": self.evaluations,
        }
        self.rows.append(row)
        self.iteration += 1
        if self.advance is not None:
            self.advance(value)


def _trainable(model: Any) -> list[nn.Parameter]:
    return [p for p in model.parameters() if p.requires_grad]


def _assign(parameters: list[nn.Parameter], x: Vector) -> None:
    with torch.no_grad():
        vector_to_parameters(torch.from_numpy(x.copy()).to(parameters[0]), parameters)


@contextmanager
def _bar(show: bool, total: int) -> Iterator[Any]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not show, transient=True) as bar:
        task = bar.add_task("marginal likelihood", total=total)
        yield lambda value: bar.update(
            task, advance=1, description=f"marginal likelihood, −log p(y) = {value:.6g}"
        )
