"""A trained model with everything it needs to predict: predict, calibrate, save and load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import nn

from zoo.arguments import whole_number
from zoo.assembly import Assembly, create
from zoo.datasets.records import Pairs, Sequences, check_record
from zoo.datasets.scaling import Scaler
from zoo.errors import NotCapableError
from zoo.evaluation.scores import score
from zoo.evaluation.table import Table
from zoo.exchange import Answer, Exchange, check_timing, check_unseen, fingerprints, question
from zoo.inference.loader import whole
from zoo.prediction import Prediction, Predictive, Recalibration
from zoo.questions import Setup
from zoo.streams import seeded
from zoo.tasks import Method, Trained, corrections, posed
from zoo.types import Batch, Posterior

__all__ = ["Run", "create", "evaluate", "load"]


@dataclass(kw_only=True)
class Run:
    """A trained model: predictions in the data's own units, calibration, saving.

    ``history`` has a row an epoch or iteration; ``recalibrations`` one correction a task;
    ``trained_on`` fingerprints of the training data, so that an evaluation on them is noticed,
    as ``calibrated_on`` are of those that bands were calibrated on;
    ``made_of`` all that determined it (:mod:`zoo.fingerprint`), empty where it was trained without
    a folder; ``seconds`` the wall clock of its training.
    """

    assembly: Assembly
    scaler: Scaler
    history: list[dict[str, Any]]
    seconds: float
    trained_on: dict[str, Any]
    made_of: dict[str, str] = field(default_factory=dict)
    recalibrations: dict[str, Recalibration] = field(default_factory=dict)
    calibrated_on: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        """Model, data, tasks and calibration in one line."""
        calibrated = ", ".join(self.recalibrations) or "nothing"
        return (
            f"Run of {self.name} on {self.trained_on['name']!r}: "
            f"can {', '.join(self.capabilities)}; calibrated for {calibrated}"
        )

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.assembly.entry.name

    @property
    def model(self) -> nn.Module:
        """The trained generative model."""
        return self.assembly.model

    @property
    def exchange(self) -> Exchange:
        """Scaling in and out of the model."""
        return Exchange(assembly=self.assembly, scaler=self.scaler)

    @property
    def capabilities(self) -> tuple[str, ...]:
        """Tasks that the model can do."""
        return self.assembly.entry.capabilities

    def forecast(
        self, data: Sequences, *, horizon: int, draws: int = 200, seed: int = 0
    ) -> Prediction:
        """The ``horizon`` frames after the movements in ``data``, which hold the frames seen."""
        horizon, draws = (
            whole_number(horizon, "horizon", unit="frame"),
            whole_number(draws, "draws"),
        )
        forecast = self._capability("forecast")

        def answer(batch: Batch, posterior: Posterior | None, rows: list[int]) -> Predictive:
            return forecast(batch, posterior, horizon=horizon, draws=draws)

        prediction = self._predict("forecast", data, answer, seed)
        return replace(prediction, offset=int(data.lengths.max()), lengths=None)

    def reconstruct(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """The movements as the model reproduces them."""
        return self._simple("reconstruct", data, draws, seed)

    def impute(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """All entries of the movements, those missing (NaN in the arrays) filled in."""
        return self._simple("impute", data, draws, seed)

    def represent(self, data: Sequences, *, draws: int = 200, seed: int = 0) -> Prediction:
        """Latent trajectories of the movements."""
        represent, draws = self._capability("represent"), whole_number(draws, "draws")

        def answer(batch: Batch, posterior: Posterior | None, rows: list[int]) -> Predictive:
            return represent(batch, posterior, draws=draws)

        latent, frames = self.exchange.answer(data, answer, seed)
        count = latent.location.shape[-1]
        return Prediction(
            predictive=latent,
            axes=("sequence", "time", "latent"),
            names=tuple(f"z_{i + 1}" for i in range(count)),
            units=("",) * count,
            task="represent",
            rate=data.rate,
            lengths=frames,
        )

    def regress(self, data: Pairs | ArrayLike, *, draws: int = 200, seed: int = 0) -> Prediction:
        """Targets of new inputs, given as Pairs or as an array (item, feature)."""
        regress = self._capability("regress")
        pairs = self.exchange.scaled(self.exchange.pairs(data))
        draws = whole_number(draws, "draws")
        with seeded(seed, self.assembly.device), torch.no_grad():
            predictive = regress(pairs.inputs, draws=draws)
        layout = self.assembly.layout
        return Prediction(
            predictive=self.exchange.unscaled(predictive, "regress"),
            axes=("item", "target"),
            names=layout.channels,
            units=layout.units,
            task="regress",
            recalibration=self.recalibrations.get("regress"),
        )

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
        generate, draws = self._capability("generate"), whole_number(draws, "draws")
        check_record(like, "generate")
        check_timing(like, duration, onto is not None, start, steps)
        target = None if goal is None else self.exchange.goal(goal, len(like))
        other = None if onto is None else self.exchange.onto(onto, len(like))

        def answer(batch: Batch, posterior: Posterior | None, rows: list[int]) -> Predictive:
            return generate(
                batch,
                posterior,
                goal=None if target is None else target[rows],
                duration=duration,
                onto=None if other is None else whole(other[rows]),
                start=start,
                steps=steps,
                draws=draws,
            )

        return self._predict("generate", like, answer, seed)

    def calibrate(
        self,
        data: Pairs | Sequences,
        *,
        method: Method = "conformal",
        tasks: Sequence[str] | None = None,
        setup: Setup | None = None,
    ) -> Run:
        """Fit and keep a correction of every spread on movements that training never saw.

        ``setup`` says how the tasks will be posed, such as which channels will be missing.
        """
        check_record(data, "calibrate")
        check_unseen(data, self.trained_on["fingerprints"], "calibration")
        self.recalibrations.update(corrections(self, data, method, tasks, setup))
        self.calibrated_on = [*self.calibrated_on, *fingerprints(data)]
        return self

    def report(self) -> dict[str, Any]:
        """What the model says of its learned parameters; empty where it says nothing.

        Standard deviations (``…_std…``) are in the data's units, one for each target or channel.
        """
        return self.exchange.report()

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the run as a folder of safetensors and JSON.

        Another run there is replaced only with ``overwrite``, else RunExistsError is raised; the
        same training with a newer calibration always is.
        """
        from zoo.lock import free
        from zoo.storage import save_run

        with free(Path(folder)):
            return save_run(self, Path(folder), overwrite=overwrite)

    def _capability(self, task: str) -> Callable[..., Predictive]:
        if task not in self.capabilities:
            raise NotCapableError(
                f"{self.name} cannot {task}; it can {', '.join(self.capabilities)}"
            )
        method: Callable[..., Predictive] = getattr(self.model, task)
        return method

    def _simple(self, task: Any, data: Sequences, draws: int, seed: int) -> Prediction:
        method, draws = self._capability(task), whole_number(draws, "draws")

        def answer(batch: Batch, posterior: Posterior | None, rows: list[int]) -> Predictive:
            return method(batch, posterior, draws=draws)

        return self._predict(task, data, answer, seed)

    def _predict(self, task: Any, data: Sequences, answer: Answer, seed: int) -> Prediction:
        scaled, frames = self.exchange.answer(data, answer, seed)
        predictive = self.exchange.unscaled(scaled, task)
        layout = self.assembly.layout
        return Prediction(
            predictive=predictive,
            axes=("sequence", "time", "channel"),
            names=layout.channels,
            units=layout.units,
            task=task,
            rate=layout.rate,
            lengths=frames,
            recalibration=self.recalibrations.get(question(task, data)),
        )


def evaluate(
    run: Trained,
    data: Pairs | Sequences,
    *,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> Table:
    """Score every task that the model can do, or those named, on data it never saw.

    A task without an answer on these data is a line that says why; the others are scored.
    """
    if not hasattr(run, "trained_on"):
        raise TypeError(f"evaluate scores a run, which zoo.fit gives; got {type(run).__name__}")
    check_record(data, "evaluate")
    check_unseen(data, run.trained_on["fingerprints"], "evaluation")
    check_unseen(data, run.calibrated_on, "evaluation", "calibrated on")
    found, refused = posed(run, data, tasks, setup)
    scores = [(t.task, score(t.prediction, t.truth, t.mask, t.groups)) for t in found]
    return Table.of(run.name, data.name, scores, refused)


def load(folder: str | Path) -> Run:
    """A run that :meth:`Run.save` wrote; a damaged or foreign folder is refused with its reason."""
    from zoo.storage import load_run

    return load_run(Path(folder))
