"""Questions that a trained model is asked, each with the truth that its answer is held against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeVar

import torch
from torch import Tensor

from zoo.datasets.records import Groups, Pairs, Sequences
from zoo.errors import UnknownNameError
from zoo.evaluation.calibration import recalibrate
from zoo.prediction import Prediction, Recalibration

__all__ = [
    "TASKS",
    "Method",
    "Predictor",
    "Setup",
    "Trained",
    "Trial",
    "beginning",
    "corrections",
    "hide_joints",
    "hide_section",
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


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the tasks are posed: frames seen by a forecast, share of joints or frames hidden."""

    seen: int | None = None
    horizon: int | None = None
    hidden: float = 0.2
    draws: int = 200
    seed: int = 0

    def frames(self, data: Sequences, *, beyond: bool = False) -> tuple[int, int]:
        """Frames seen and frames to forecast; by default a seventh is seen (10 of 70).

        The forecast ends where the shortest movement does, unless it may go ``beyond``.
        """
        shortest = int(data.lengths.min())
        seen = max(2, shortest // 7) if self.seen is None else self.seen
        horizon = shortest - seen if self.horizon is None else self.horizon
        if seen < 1 or seen > shortest:
            raise ValueError(f"a forecast sees 1 to {shortest} frames of these data; got {seen}")
        if horizon < 1:
            raise ValueError(f"a forecast needs a horizon of at least 1 frame; got {horizon}")
        if seen + horizon > shortest and not beyond:
            raise ValueError(
                f"a forecast of {horizon} frames after {seen} needs {seen + horizon} frames; "
                f"the shortest movement has {shortest}"
            )
        return seen, horizon


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
    holed = hide_section(movements, setup.hidden)
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
    """Pose every task that the run's model can do, or those named, on ``data``."""
    names = [t for t, (need, _) in TASKS.items() if need in run.capabilities]
    if tasks is not None:
        unknown = [t for t in tasks if t not in names]
        if unknown:
            raise UnknownNameError(
                f"no task {unknown[0]!r} for this model; it has {', '.join(names)}"
            )
        names = list(tasks)
    return [TASKS[name][1](run, data, setup or Setup()) for name in names]


def corrections(
    run: Predictor,
    data: Pairs | Sequences,
    method: Method,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> dict[str, Recalibration]:
    """A correction of the spread for every task, fitted on ``data``."""
    return {
        trial.task: recalibrate(method, trial.prediction.raw, trial.truth, trial.mask, trial.groups)
        for trial in trials(run, data, tasks, setup)
        if trial.prediction.has_spread
    }


def beginning(data: Sequences, seen: int, horizon: int) -> Sequences:
    """What a forecast may see: the first frames, and the controls of those to come as well."""
    known = data.frames(0, seen)
    if data.controls is None:
        return known
    return replace(known, controls=data.controls[:, : seen + horizon])


def hide_joints(data: Sequences, share: float, *, seed: int = 0) -> Sequences:
    """The movements with a random ``share`` of the channels (at least one) missing throughout."""
    count = len(data.channels)
    hidden = min(max(1, round(share * count)), count - 1)
    if hidden < 1:
        raise ValueError("hiding joints needs at least two channels")
    pick = torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:hidden]
    keep = torch.ones(count, dtype=torch.bool)
    keep[pick] = False
    return _masked(data, data.mask & keep)


def hide_section(data: Sequences, share: float) -> Sequences:
    """The movements with a ``share`` of the frames missing in the middle, all channels."""
    time = torch.arange(data.values.shape[1])
    length = data.lengths[:, None]
    width = (share * length).round().clamp(min=1)
    start = (length - width) / 2
    inside = (time >= start) & (time < start + width)
    return _masked(data, data.mask & ~inside[..., None])


def _masked(data: Sequences, mask: Tensor) -> Sequences:
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))


def _trial(task: str, prediction: Prediction, truth: Sequences, mask: Tensor) -> Trial:
    return Trial(
        task=task, prediction=prediction, truth=truth.values, mask=mask, groups=truth.groups
    )


def _expect(data: Pairs | Sequences, kind: type[_Record]) -> _Record:
    if not isinstance(data, kind):
        raise TypeError(f"{kind.__name__} are needed; got {type(data).__name__}")
    return data
