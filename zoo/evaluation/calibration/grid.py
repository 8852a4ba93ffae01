"""Corrections of every question that a calibration is for: forecasts over a grid of lengths."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.records import Groups, Pairs, Sequences
from zoo.errors import NotCalibratedWarning, UnanswerableError
from zoo.evaluation.answers import Answer
from zoo.evaluation.calibration.adapted import difficulty, rehearsal
from zoo.evaluation.calibration.asked import Asked
from zoo.evaluation.calibration.calibration import PEOPLE, Calibrated
from zoo.evaluation.calibration.conformal import Conformal
from zoo.evaluation.calibration.promise import caller, warn_of_few
from zoo.evaluation.calibration.recalibration import fitted
from zoo.evaluation.questions import Question, Setup, ask
from zoo.evaluation.tasks import Predictor, answered, tasks_of
from zoo.prediction.prediction import Prediction

__all__ = ["Method", "corrections", "lengths_of", "observed_difficulty"]

Method = Literal["conformal", "isotonic", "scale"]
SHARES = (1 / 14, 1 / 7, 2 / 7, 1 / 2, 3 / 4)


def lengths_of(frames: int) -> tuple[int, ...]:
    """Observed lengths that forecasts are calibrated after, of movements of so many frames.

    >>> lengths_of(70), lengths_of(6)
    ((5, 10, 20, 35, 52), (2, 3, 4))
    """
    found = dict.fromkeys(max(2, int(share * frames)) for share in SHARES)
    return tuple(k for k in found if k < frames)


def corrections(
    run: Predictor,
    data: Pairs | Sequences,
    method: Method,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
    by: str | None = None,
    adapt: bool = True,
) -> list[Calibrated]:
    """A correction of the spread for every task, fitted on ``data``.

    Without a ``setup`` that says how many frames are observed, forecasts are calibrated over a grid
    of lengths. A task without an answer on these data stays as it is, with a NotCalibratedWarning.
    Where all have none the first one's UnanswerableError is raised.
    """
    if setup is not None and not isinstance(setup, Setup):
        raise TypeError(f"setup must be a zoo.Setup; got {type(setup).__name__}")
    found: list[Calibrated] = []
    refused: dict[str, UnanswerableError] = {}
    names = tasks_of(run, tasks)
    for task in names:
        try:
            found += _of_task(run, task, data, method, setup, by, adapt)
        except UnanswerableError as error:
            refused[task] = error
    if refused and len(refused) == len(names):
        raise next(iter(refused.values()))
    for task, reason in refused.items():
        told = f"{task} has no answer on the calibration data and stays uncalibrated: {reason}"
        warnings.warn(told, NotCalibratedWarning, stacklevel=caller())
    return found


def observed_difficulty(
    run: Predictor, data: Sequences, *, draws: int, seed: int
) -> Float[Tensor, " sequence"] | None:
    """How large errors are, in standard deviations, within what was observed of each movement.

    None of frames too few to ask the model about.
    """
    question = rehearsal(data)
    if question is None:
        return None
    try:
        prediction = answered(run, question, draws=draws, seed=seed)
    except UnanswerableError:
        return None
    return difficulty(prediction, question.truth, question.mask)


def _of_task(
    run: Predictor,
    task: str,
    data: Pairs | Sequences,
    method: Method,
    setup: Setup | None,
    by: str | None,
    adapt: bool,
) -> list[Calibrated]:
    """The task's questions, each with its correction; those without an answer are left out."""
    found: list[tuple[Calibrated, Answer]] = []
    first: UnanswerableError | None = None
    for how, question in _questions(task, data, setup):
        try:
            prediction = answered(run, question, draws=how.draws, seed=how.seed).raw
        except UnanswerableError as error:
            first = first or error
            continue
        if not prediction.has_spread:
            return []
        factor = None
        if adapt and task == "forecast":
            factor = observed_difficulty(run, question.given, draws=how.draws, seed=how.seed)
        found.append(_corrected(question, prediction, factor, method, by))
    if first is not None and not found:
        raise first
    _warn(task, found)
    return [part for part, _ in found]


def _questions(
    task: str, data: Pairs | Sequences, setup: Setup | None
) -> Iterator[tuple[Setup, Question]]:
    how = setup or Setup()
    if task != "forecast" or how.seen is not None or how.horizon is not None:
        yield how, ask(task, data, how)
        return
    for seen in lengths_of(int(data.lengths.min())) if isinstance(data, Sequences) else ():
        posed = replace(how, seen=seen)
        yield posed, ask(task, data, posed)


def _corrected(
    question: Question,
    prediction: Prediction,
    factor: Float[Tensor, " sequence"] | None,
    method: Method,
    by: str | None,
) -> tuple[Calibrated, Answer]:
    groups, like = question.groups, prediction.predictive.location
    if factor is not None:
        wide = factor.to(like).view(-1, *[1] * (len(prediction.shape) - 1))
        prediction = replace(prediction, predictive=prediction.predictive.stretched(wide))
    answer = Answer.of(prediction, question.truth, question.mask, groups, by)
    people = {k: tuple(dict.fromkeys(groups[k])) for k in _people(groups, by)}
    part = Calibrated(
        asked=Asked.of(question.task, question.given, question.horizon),
        correction=fitted(method, answer),
        groups=answer.groups,
        people=people,
        by=by or "",
        adaptive=factor is not None,
    )
    return part, answer


def _people(groups: Groups, by: str | None) -> list[str]:
    """Columns that tell people, and the one that tells groups."""
    return [k for k in groups if k in PEOPLE or k == by]


def _warn(task: str, found: Sequence[tuple[Calibrated, Answer]]) -> None:
    """Say once a task what so few groups can promise."""
    if not found:
        return
    part, answer = found[len(found) // 2]
    correction = part.correction
    if isinstance(correction, Conformal):
        lengths = torch.tensor([p.asked.observed for p, _ in found])
        what = str(part.asked)
        if len(found) > 1:
            what = f"{task} after {int(lengths.min())} to {int(lengths.max())} frames"
        warn_of_few(answer, correction, correction.worth, correction.reach, what)
