"""Questions that a trained model is asked, each with the truth that its answer is held against."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeVar

from torch import Tensor

from zoo.datasets.records import Groups, Pairs, Sequences
from zoo.errors import (
    NotCalibratedWarning,
    UnanswerableError,
    UnknownNameError,
)
from zoo.evaluation.calibration import recalibrate
from zoo.prediction import Prediction, Recalibration
from zoo.questions import Setup, hide_joints, hide_section

__all__ = [
    "TASKS",
    "Method",
    "Predictor",
    "Trained",
    "Trial",
    "beginning",
    "corrections",
    "posed",
    "trials",
]

Method = Literal["conformal", "isotonic", "scale"]
_Record = TypeVar("_Record", Pairs, Sequences)


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
        """The frames after those seen."""
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
class Trial:
    """One answer and its truth; ``mask`` is True where the truth is known and was asked for."""

    task: str
    prediction: Prediction
    truth: Tensor
    mask: Tensor
    groups: Groups


def _regress(run: Predictor, data: Pairs | Sequences, setup: Setup) -> Trial:
    pairs = _expect(data, Pairs)
    prediction = run.regress(pairs, draws=setup.draws, seed=setup.seed)
    return Trial(
        task="regress",
        prediction=prediction,
        truth=pairs.targets,
        mask=pairs.mask,
        groups=pairs.groups,
    )


def _reconstruct(run: Predictor, data: Pairs | Sequences, setup: Setup) -> Trial:
    movements = _expect(data, Sequences)
    prediction = run.reconstruct(movements, draws=setup.draws, seed=setup.seed)
    return _trial("reconstruct", prediction, movements, movements.mask)


def _forecast(run: Predictor, data: Pairs | Sequences, setup: Setup) -> Trial:
    movements = _expect(data, Sequences)
    seen, horizon = setup.frames(movements)
    known = beginning(movements, seen, horizon)
    prediction = run.forecast(known, horizon=horizon, draws=setup.draws, seed=setup.seed)
    future = movements.frames(seen, seen + horizon)
    return _trial("forecast", prediction, future, future.mask)


def _impute_joints(run: Predictor, data: Pairs | Sequences, setup: Setup) -> Trial:
    movements = _expect(data, Sequences)
    holed = hide_joints(movements, setup.hidden, seed=setup.seed)
    prediction = run.impute(holed, draws=setup.draws, seed=setup.seed)
    return _trial("impute joints", prediction, movements, movements.mask & ~holed.mask)


def _impute_section(run: Predictor, data: Pairs | Sequences, setup: Setup) -> Trial:
    movements = _expect(data, Sequences)
    holed = hide_section(movements, setup.section)
    prediction = run.impute(holed, draws=setup.draws, seed=setup.seed)
    return _trial("impute section", prediction, movements, movements.mask & ~holed.mask)


TASKS: dict[str, tuple[str, Callable[[Predictor, Pairs | Sequences, Setup], Trial]]] = {
    "regress": ("regress", _regress),
    "reconstruct": ("reconstruct", _reconstruct),
    "forecast": ("forecast", _forecast),
    "impute joints": ("impute", _impute_joints),
    "impute section": ("impute", _impute_section),
}


def trials(
    run: Predictor,
    data: Pairs | Sequences,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> list[Trial]:
    """Pose every task that the run's model can do, or those named, on ``data``.

    A task without an answer on these data is left out, see :func:`posed`.
    """
    return posed(run, data, tasks, setup)[0]


def posed(
    run: Predictor,
    data: Pairs | Sequences,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> tuple[list[Trial], dict[str, str]]:
    """The answers to every task that the model can do, or to those named, and why others have none.

    Where no task has an answer the first one's UnanswerableError is raised.
    """
    found: list[Trial] = []
    refused: dict[str, UnanswerableError] = {}
    for name in _names(run, tasks):
        try:
            found.append(TASKS[name][1](run, data, setup or Setup()))
        except UnanswerableError as error:
            refused[name] = error
    if refused and not found:
        raise next(iter(refused.values()))
    return found, {name: str(error) for name, error in refused.items()}


def _names(run: Predictor, tasks: Sequence[str] | None) -> list[str]:
    """Tasks to pose; those that the model has not are named."""
    names = [t for t, (need, _) in TASKS.items() if need in run.capabilities]
    if tasks is not None:
        unknown = [t for t in tasks if t not in names]
        if unknown:
            raise UnknownNameError(
                f"no task {unknown[0]!r} for this model; it has {', '.join(names)}"
            )
        names = list(tasks)
    return names


def corrections(
    run: Predictor,
    data: Pairs | Sequences,
    method: Method,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> dict[str, Recalibration]:
    """A correction of the spread for every task, fitted on ``data``.

    A task without an answer on these data stays as it is, with a NotCalibratedWarning.
    """
    found, refused = posed(run, data, tasks, setup)
    for task, reason in refused.items():
        told = f"{task} has no answer on the calibration data and stays uncalibrated: {reason}"
        warnings.warn(told, NotCalibratedWarning, stacklevel=3)
    return {
        trial.task: recalibrate(method, trial.prediction.raw, trial.truth, trial.mask, trial.groups)
        for trial in found
        if trial.prediction.has_spread
    }


def beginning(data: Sequences, seen: int, horizon: int) -> Sequences:
    """What a forecast may see: the first frames, and the controls of those to come as well."""
    known = data.frames(0, seen)
    if data.controls is None:
        return known
    return replace(known, controls=data.controls[:, : seen + horizon])


def _trial(task: str, prediction: Prediction, truth: Sequences, mask: Tensor) -> Trial:
    return Trial(
        task=task, prediction=prediction, truth=truth.values, mask=mask, groups=truth.groups
    )


def _expect(data: Pairs | Sequences, kind: type[_Record]) -> _Record:
    if not isinstance(data, kind):
        raise TypeError(f"{kind.__name__} are needed; got {type(data).__name__}")
    return data
