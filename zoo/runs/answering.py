"""The questions that one trained model, or several as one, answer in the data's own units."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from numpy.typing import ArrayLike

from zoo.arguments import positive, whole_number
from zoo.datasets.records import Pairs, Sequences, check_record
from zoo.errors import NotCapableError, OtherQuestionWarning
from zoo.evaluation.calibration.adapted import Adapted
from zoo.evaluation.calibration.asked import Asked
from zoo.evaluation.calibration.calibration import Calibrated, Calibration
from zoo.evaluation.calibration.grid import Method, corrections, observed_difficulty
from zoo.evaluation.calibration.promise import caller
from zoo.evaluation.questions import Setup
from zoo.prediction.prediction import Prediction, Recalibration
from zoo.runs.units import check_unseen, fingerprints

__all__ = ["Answers", "Query", "Task"]

Task = Literal["regress", "represent", "reconstruct", "forecast", "impute", "generate"]


@dataclass(frozen=True, kw_only=True)
class Query:
    """One question as it is asked of a run, in the data's units.

    ``horizon`` belongs to forecasts; ``goal``, ``duration``, ``onto``, ``start`` and ``steps`` to
    :meth:`Answers.generate`.
    """

    task: Task
    data: Any
    draws: int
    seed: int
    horizon: int = 0
    goal: ArrayLike | None = None
    duration: float = 1.0
    onto: Sequences | None = None
    start: int = 0
    steps: int = 1


class Answers(ABC):
    """Forecast, reconstruct, impute, represent, regress, generate, and calibrate."""

    calibration: Calibration
    calibrated_on: list[str]

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the entry or entries."""
        ...

    @property
    @abstractmethod
    def capabilities(self) -> tuple[str, ...]:
        """Tasks that can be asked."""
        ...

    @property
    @abstractmethod
    def fingerprints(self) -> list[str]:
        """Those of the movements or items that were trained on."""
        ...

    @abstractmethod
    def uncorrected(self, query: Query) -> Prediction:
        """The answer without the correction of its bands."""
        ...

    def forecast(
        self, data: Sequences, *, horizon: int, draws: int = 200, seed: int = 0
    ) -> Prediction:
        """The ``horizon`` frames after the movements in ``data``, which hold the frames observed.

        Raises NotCapableError where the model cannot forecast.
        """
        ahead = whole_number(horizon, "horizon", unit="frame")
        return self._answer(
            Query(task="forecast", data=data, horizon=ahead, draws=draws, seed=seed)
        )

    def reconstruct(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """The movements as the model reproduces them."""
        return self._answer(Query(task="reconstruct", data=data, draws=draws, seed=seed))

    def impute(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """All entries of the movements, those missing (NaN in the arrays) filled in."""
        return self._answer(Query(task="impute", data=data, draws=draws, seed=seed))

    def represent(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """Latent trajectories of the movements."""
        return self._answer(Query(task="represent", data=data, draws=draws, seed=seed))

    def regress(self, data: Pairs | ArrayLike, *, draws: int = 200, seed: int = 0) -> Prediction:
        """Targets of new inputs, given as Pairs or as an array (item, feature)."""
        return self._answer(Query(task="regress", data=data, draws=draws, seed=seed))

    def generate(
        self,
        like: Sequences,
        *,
        goal: ArrayLike | None = None,
        duration: float = 1.0,
        onto: Sequences | None = None,
        start: int = 0,
        steps: int = 1,
        draws: int = 200,
        seed: int = 0,
    ) -> Prediction:
        """New movements after the demonstrations ``like``.

        ``goal`` is the last frame to reach (of a rhythmic movement the centre to swing about), in
        the data's units, one for all or one for each movement; ``duration`` stretches time;
        ``onto`` are the movements to switch to, one for all or one for each, from frame ``start``
        of the new movement over ``steps`` frames, (89).
        """
        self._need("generate")
        check_record(like, "generate")
        duration = positive(duration, "duration")
        start, steps = whole_number(start, "start", 0), whole_number(steps, "steps")
        _check_timing(like, duration, onto is not None, start, steps)
        return self._answer(
            Query(
                task="generate",
                data=like,
                goal=goal,
                duration=duration,
                onto=onto,
                start=start,
                steps=steps,
                draws=draws,
                seed=seed,
            )
        )

    def calibrate(
        self,
        data: Pairs | Sequences,
        *,
        method: Method = "conformal",
        tasks: Sequence[str] | None = None,
        setup: Setup | None = None,
        by: str | None = None,
        adapt: bool = True,
    ) -> Self:
        """Fit and keep a correction of the bands on held-out movements.

        ``setup`` says how the tasks will be posed, such as which channels will be missing; without
        it forecasts are calibrated after a grid of observed lengths, and what is asked between two
        of them gets bands between theirs. Another question warns
        (:class:`~zoo.errors.OtherQuestionWarning`). ``by`` is the group column whose values are
        independent (``"subject"`` where new people are to be forecast), movements by default. With
        ``adapt`` the bands of a forecast follow the errors that the model makes in the frames
        observed, whose second half it is asked to forecast from the first. :attr:`calibration`
        says what is promised.
        """
        check_record(data, "calibrate")
        check_unseen(data, self.fingerprints, "calibration")
        found = corrections(self._bare(), data, method, tasks, setup, by, adapt)
        self._keep(self.calibration.joined(found))
        self.calibrated_on.extend(fingerprints(data))
        return self

    @abstractmethod
    def _bare(self) -> Self:
        """The same without calibration."""
        ...

    @abstractmethod
    def _keep(self, calibration: Calibration) -> None:
        """Take another calibration."""
        ...

    def _answer(self, query: Query) -> Prediction:
        self._need(query.task)
        whole_number(query.draws, "draws")
        found = self.uncorrected(query)
        if not self.calibration or not found.has_spread:
            return found
        part = self.calibration.part(
            Asked.of(query.task, query.data, query.horizon), getattr(query.data, "groups", {})
        )
        return found if part is None else replace(found, recalibration=self._fitting(part, query))

    def _fitting(self, part: Calibrated, query: Query) -> Recalibration | None:
        """The correction, for spreads that follow the errors observed where it is of such."""
        if not part.adaptive:
            return part.correction
        factor = observed_difficulty(self._bare(), query.data, draws=query.draws, seed=query.seed)
        if factor is None:
            warnings.warn(
                f"{query.task}: too few frames are observed for bands that follow the errors in "
                "them, as those calibrated do: these are raw",
                OtherQuestionWarning,
                stacklevel=caller(),
            )
        return None if factor is None else Adapted(correction=part.correction, factor=factor)

    def _need(self, task: str) -> None:
        if task not in self.capabilities:
            can = ", ".join(self.capabilities) or "nothing"
            raise NotCapableError(f"{self.name} cannot {task}; it can {can}")


def _check_timing(like: Sequences, duration: float, switches: bool, start: int, steps: int) -> None:
    """Refuse a duration without frames, and a switch outside the new movement."""
    shortest = int(like.lengths.min())
    frames = round((shortest - 1) * duration) + 1
    if frames < 3:
        raise ValueError(
            f"duration={duration:g} leaves {frames} of {shortest} frames; at least 3 are needed"
        )
    if not switches and (start, steps) != (0, 1):
        raise ValueError("start and steps are those of a switch: name the movements to go onto")
    if switches and start + steps > frames:
        raise ValueError(
            f"switching from frame {start} over {steps} frames does not fit in {frames} frames"
        )
