"""A trained model with everything it needs to predict: predict, calibrate, save and load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor, nn

from zoo.arguments import path_of, whole_number
from zoo.contract.capabilities import Decodes, Encodes
from zoo.datasets.records import Pairs, Sequences, check_record
from zoo.display import facts
from zoo.errors import NotCapableError
from zoo.evaluation.calibration.calibration import Calibration
from zoo.evaluation.figures.history import training
from zoo.evaluation.questions import Setup
from zoo.evaluation.scores import score
from zoo.evaluation.table import Table
from zoo.evaluation.tasks import Trained, posed
from zoo.inference.loader import whole
from zoo.inference.resume.lock import free
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive
from zoo.runs.answering import Answers, Query, Task
from zoo.runs.assembly import create
from zoo.runs.disk import load_run, save_run
from zoo.runs.record import Record
from zoo.runs.units import Ask, Exchange, check_unseen
from zoo.streams import seeded
from zoo.types import Wishes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Run", "create", "evaluate", "load"]


@dataclass(kw_only=True)
class Run(Record, Answers):
    """A trained model: predictions in the data's own units, calibration, saving."""

    def __repr__(self) -> str:
        """Model, data, tasks and calibration in one line."""
        calibrated = ", ".join(self.calibration.tasks) or "nothing"
        return (
            f"Run of {self.name} on {self.trained_on['name']!r}: "
            f"can {', '.join(self.capabilities)}; calibrated for {calibrated}"
        )

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.assembly.entry.name

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "trained on": self.trained_on["name"],
            "channels": self.assembly.layout.channels,
            "can": self.capabilities,
            "calibrated for": self.calibration.tasks,
            "parameters": self.assembly.parameters(),
            "training": f"{self.seconds:.3g} s, {len(self.history)} rows of history",
        }
        return facts(f"Run of {self.name}", rows)

    def plot_history(self, ax: Axes | None = None) -> Figure:
        """The training's bound over the epochs, or its log evidence over the iterations.

        Raises ValueError where the training was in closed form. The figure is returned.
        """
        return training(self.history, self.name, ax)

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

    @property
    def fingerprints(self) -> list[str]:
        """Those of the movements or items that were trained on."""
        found: list[str] = self.trained_on["fingerprints"]
        return found

    def uncorrected(self, query: Query) -> Prediction:
        """The answer without the correction of its bands."""
        if query.task == "regress":
            return self._regressed(query)
        found, frames = self.exchange.answer(query.data, self._method(query), query.seed)
        if query.task == "represent":
            return _latent(found, query.data.rate, frames)
        ahead = query.task == "forecast"
        return self._frames(
            self.exchange.unscaled(found, query.task),
            query.task,
            offset=int(query.data.lengths.max()) if ahead else 0,
            lengths=None if ahead else frames,
        )

    def encode(
        self, data: Sequences, *, draws: int = 200, seed: int = 0
    ) -> tuple[Float[Tensor, "sequence time latent"], Float[Tensor, "sequence time latent"]]:
        """Means and standard deviations of the latent coordinates of every frame, in their units.

        They are those of :meth:`represent`, 0 where the model gives no standard deviation. Of a
        primitive in an autoencoder they are the encoder's, which the primitive has not smoothed.
        Frames after the end of a shorter movement hold 0. Raises NotCapableError where the model
        has no latent coordinates.

        >>> import numpy as np, zoo
        >>> x = np.random.default_rng(0).normal(size=(4, 20, 3))
        >>> data = zoo.Sequences.from_arrays(x, rate=30.0)
        >>> run = zoo.fit(zoo.create("pca", data, latent_dim=2), data)
        >>> mean, std = run.encode(data)
        >>> mean.shape, std.shape
        (torch.Size([4, 20, 2]), torch.Size([4, 20, 2]))
        >>> run.decode(mean)
        Prediction of reconstruct: sequence 4, time 20, channel 3; in no unit, with spread
        """
        self._need("represent")
        whole_number(draws, "draws")
        model: Any = self.model
        ask = model.encode if isinstance(model, Encodes) else model.represent
        found, frames = self.exchange.answer(
            data, lambda batch, posterior, rows: ask(batch, posterior, draws=draws), seed
        )
        latent = _latent(found, data.rate, frames)
        std = latent.std if latent.has_spread else torch.zeros_like(latent.mean)
        return latent.mean, std

    def decode(self, latent: ArrayLike | Tensor) -> Prediction:
        """What the model observes at latent points, (sequence, time, latent), in the data's units.

        Each frame is decoded by itself; what the model knows of time does not enter. Raises
        NotCapableError where the model has no latent coordinates.
        """
        model = self.model
        if not isinstance(model, Decodes):
            raise NotCapableError(f"{self.name} cannot decode: it has no latent coordinates")
        z = torch.as_tensor(latent).to(device=self.assembly.device, dtype=self.assembly.dtype)
        if z.ndim != 3 or z.shape[-1] != model.latent_dim or not bool(z.isfinite().all()):
            raise ValueError(
                f"finite latent points (sequence, time, {model.latent_dim}) are needed; got "
                f"shape {tuple(z.shape)}"
            )
        with torch.no_grad():
            found = model.decode(z[None])
        return self._frames(self.exchange.unscaled(found, "decode"), "reconstruct")

    def _frames(
        self, found: Predictive, task: Task, *, offset: int = 0, lengths: Tensor | None = None
    ) -> Prediction:
        layout = self.assembly.layout
        return Prediction(
            predictive=found,
            axes=("sequence", "time", "channel"),
            names=layout.channels,
            units=layout.units,
            task=task,
            rate=layout.rate,
            offset=offset,
            lengths=lengths,
        )

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
        place = path_of(folder, "save needs a folder:")
        with free(place):
            return save_run(self, place, overwrite=overwrite)

    def _bare(self) -> Run:
        return replace(self, calibration=Calibration(), calibrated_on=[])

    def _keep(self, calibration: Calibration) -> None:
        self.calibration = calibration

    def _method(self, query: Query) -> Ask:
        """The model's method for the task, as it is asked about a batch."""
        method: Callable[..., Predictive] = getattr(self.model, query.task)
        draws = query.draws
        if query.task == "forecast":
            return lambda batch, posterior, rows: method(
                batch, posterior, horizon=query.horizon, draws=draws
            )
        if query.task == "generate":
            wishes = self._wishes(query)
            return lambda batch, posterior, rows: method(
                batch, posterior, wishes=wishes(rows), draws=draws
            )
        return lambda batch, posterior, rows: method(batch, posterior, draws=draws)

    def _wishes(self, query: Query) -> Callable[[list[int]], Wishes]:
        """The wishes for some of the movements, in the model's scale."""
        count, onto = len(query.data), query.onto
        goal = None if query.goal is None else self.exchange.goal(query.goal, count)
        other = None if onto is None else self.exchange.onto(onto, count)
        return lambda rows: Wishes(
            goal=None if goal is None else goal[rows],
            duration=query.duration,
            onto=None if other is None else whole(other[rows]),
            start=query.start,
            steps=query.steps,
        )

    def _regressed(self, query: Query) -> Prediction:
        pairs = self.exchange.scaled(self.exchange.pairs(query.data))
        with seeded(query.seed, self.assembly.device), torch.no_grad():
            regress: Callable[..., Predictive] = getattr(self.model, query.task)
            predictive = regress(pairs.inputs, draws=query.draws)
        layout = self.assembly.layout
        return Prediction(
            predictive=self.exchange.unscaled(predictive, "regress"),
            axes=("item", "target"),
            names=layout.channels,
            units=layout.units,
            task="regress",
        )


def _latent(found: Predictive, rate: float, lengths: Tensor) -> Prediction:
    """Latent coordinates, which have numbers for names and no unit."""
    count = found.location.shape[-1]
    return Prediction(
        predictive=found,
        axes=("sequence", "time", "latent"),
        names=tuple(f"z_{i + 1}" for i in range(count)),
        units=("",) * count,
        task="represent",
        rate=rate,
        lengths=lengths,
    )


def evaluate(
    run: Trained,
    data: Pairs | Sequences,
    *,
    tasks: Sequence[str] | None = None,
    setup: Setup | None = None,
) -> Table:
    """Score every task that the model can do, or those named, on held-out data.

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


def load(folder: str | Path, *, device: str = "cpu") -> Run:
    """A run that :meth:`Run.save` wrote; a damaged or foreign folder is refused with its reason."""
    place = path_of(folder, "load takes the folder that a run was saved in:")
    return Run(**vars(load_run(place, device=device)))
