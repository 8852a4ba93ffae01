"""Answers of a trained model to questions, beside the truth that they are held against."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from torch import Tensor

from zoo.arguments import list_of
from zoo.datasets.records import Groups, Pairs, Sequences
from zoo.errors import UnanswerableError, UnknownNameError
from zoo.evaluation.questions import NEEDS, Question, Setup, ask
from zoo.prediction.prediction import Prediction

__all__ = [
    "Outcome",
    "Predictor",
    "Trained",
    "answered",
    "outcomes",
    "posed",
    "tasks_of",
]

T = TypeVar("T")


class Predictor(Protocol):
    """What a task needs of a run."""

    @property
    def capabilities(self) -> tuple[str, ...]:
        """Tasks that the run's model can do."""
        ...

    def regress(self, data: Pairs, *, draws: int, seed: int) -> Prediction:
        """Targets of the items."""
        ...

    def reconstruct(self, data: Sequences, *, draws: int, seed: int) -> Prediction:
        """The movements through the model."""
        ...

    def forecast(self, data: Sequences, *, horizon: int, draws: int, seed: int) -> Prediction:
        """The frames after those observed."""
        ...

    def impute(self, data: Sequences, *, draws: int, seed: int) -> Prediction:
        """The missing entries."""
        ...


class Trained(Predictor, Protocol):
    """A predictor that knows what it was trained on: a run or an ensemble of runs."""

    @property
    def name(self) -> str:
        """Name of the entry or entries."""
        ...

    @property
    def trained_on(self) -> dict[str, Any]:
        """``name`` and ``fingerprints`` of the training data."""
        ...

    @property
    def calibrated_on(self) -> list[str]:
        """Fingerprints of the movements or items that its bands were calibrated on."""
        ...


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One answer and its truth; ``mask`` is True where the truth is known and was asked for."""

    task: str
    prediction: Prediction
    truth: Tensor
    mask: Tensor
    groups: Groups


def answered(run: Predictor, question: Question, *, draws: int, seed: int) -> Prediction:
    """What a run says to a question; it gets nothing of the truth but what is ``given``."""
    given = question.given
    if question.need == "regress":
        return run.regress(given, draws=draws, seed=seed)
    if question.need == "reconstruct":
        return run.reconstruct(given, draws=draws, seed=seed)
    if question.need == "forecast":
        return run.forecast(given, horizon=question.horizon, draws=draws, seed=seed)
    return run.impute(given, draws=draws, seed=seed)


def outcomes(
    run: Predictor,
    data: Pairs | Sequences,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> list[Outcome]:
    """Pose every task that the run's model can do, or those named, on ``data``.

    A task without an answer on these data is left out, see :func:`posed`.
    """
    return posed(run, data, tasks, setup)[0]


def posed(
    run: Predictor,
    data: Pairs | Sequences,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> tuple[list[Outcome], dict[str, str]]:
    """The answers to every task that the model can do, or to those named, and why others have none.

    All questions are posed before any is answered: a setup that one of them cannot have is refused
    at once. Where no task has an answer the first one's UnanswerableError is raised.
    """
    how = Setup() if setup is None else setup
    if not isinstance(how, Setup):
        raise TypeError(f"setup must be a zoo.Setup; got {type(how).__name__}")
    names = tasks_of(run, tasks)
    questions, refused = _taken(names, lambda name: ask(name, data, how))
    found, unanswered = _taken(questions, lambda name: _outcome(run, questions[name], how))
    refused |= unanswered
    why = {name: refused[name] for name in names if name in refused}
    if why and not found:
        raise next(iter(why.values()))
    return list(found.values()), {name: str(error) for name, error in why.items()}


def _taken(
    names: Iterable[str], found: Callable[[str], T]
) -> tuple[dict[str, T], dict[str, UnanswerableError]]:
    """What is found for every name, and the errors of names for which there is no answer."""
    taken, refused = dict[str, T](), dict[str, UnanswerableError]()
    for name in names:
        try:
            taken[name] = found(name)
        except UnanswerableError as error:
            refused[name] = error
    return taken, refused


def tasks_of(run: Predictor, tasks: Sequence[str] | None = None) -> list[str]:
    """Tasks to pose: those named, all of which the model must have, or all that it has."""
    names = [task for task, need in NEEDS.items() if need in run.capabilities]
    if tasks is not None:
        wanted = list_of(tasks, "tasks")
        unknown = [t for t in wanted if not isinstance(t, str) or t not in names]
        if unknown or not wanted:
            problem = f"no task {unknown[0]!r} for this model" if unknown else "tasks names none"
            raise UnknownNameError(f"{problem}; it has {', '.join(names)}")
        names = wanted
    return names


def _outcome(run: Predictor, question: Question, setup: Setup) -> Outcome:
    return Outcome(
        task=question.task,
        prediction=answered(run, question, draws=setup.draws, seed=setup.seed),
        truth=question.truth,
        mask=question.mask,
        groups=question.groups,
    )
