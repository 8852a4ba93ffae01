"""One question that models are compared by: what is observed, what is hidden, and the folds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.errors import UnknownNameError
from zoo.prediction import Prediction
from zoo.tasks import Predictor, beginning

__all__ = ["Fold", "Protocol", "Published", "check_models"]

Need = Literal["forecast", "impute"]
Settings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Published:
    """A figure of a publication: the mean squared error in deg² on walks that are not at hand."""

    name: str
    mse: float


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Rows to train on, rows to fit the bands' correction on, rows to be judged.

    No group is in two of them.
    """

    train: tuple[int, ...]
    calibration: tuple[int, ...]
    judged: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """One question: ``seen`` frames and ``horizon`` to forecast, or ``hidden`` channels to impute.

    ``settings`` are what an entry is given here instead of its defaults; ``models`` are asked
    where none are named; ``command`` is what to type. Groups of ``by`` are never in two parts of a
    fold. ``centred`` movements have their own mean over all frames subtracted, those to be forecast
    included: hindsight, which the literature's protocol has and no other; ``published`` are its
    figures. Protocols whose ``data`` have one name share what was trained on them.
    """

    name: str
    summary: str
    load: Callable[[], Sequences]
    source: Literal["public", "simulated", "own"]
    need: Need
    models: tuple[str, ...]
    command: str = ""
    seen: int = 0
    horizon: int = 0
    hidden: tuple[str, ...] = ()
    by: str = "trial"
    centred: bool = False
    settings: Settings = field(default_factory=dict)
    published: tuple[Published, ...] = ()

    @property
    def protocol(self) -> str:
        """Which kind it is, in words for every table."""
        if self.centred:
            return (
                "published protocol: each movement is centred by its mean over all frames, "
                "those to be forecast included"
            )
        return "default protocol: nothing of what is hidden is used"

    def movements(self) -> Sequences:
        """The data as the models get them."""
        return self.prepared(self.load())

    def prepared(self, data: Sequences) -> Sequences:
        """Movements less their own means where the protocol is ``centred``, else as they are."""
        if not self.centred:
            return data
        means = (data.values * data.mask).sum(1, keepdim=True) / data.mask.sum(1, keepdim=True)
        return replace(data, values=torch.where(data.mask, data.values - means, 0.0))

    def answer(self, run: Predictor, data: Sequences, *, draws: int, seed: int) -> Prediction:
        """The prediction of a run for movements whose truth is ``data``."""
        if self.need == "forecast":
            known = beginning(data, self.seen, self.horizon)
            return run.forecast(known, horizon=self.horizon, draws=draws, seed=seed)
        mask = data.mask & ~self._hidden(data)
        known = replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))
        return run.impute(known, draws=draws, seed=seed)

    def truth(self, data: Sequences) -> tuple[Tensor, Tensor]:
        """The recorded values, and which of their entries were asked for."""
        if self.need == "forecast":
            future = data.frames(self.seen, self.seen + self.horizon)
            return future.values, future.mask
        return data.values, data.mask & self._hidden(data)

    def folds(self, data: Sequences, count: int) -> list[Fold]:
        """Fold k is judged, fold k + 1 calibrates, the rest trains; groups stay together."""
        groups = list(dict.fromkeys(data.groups[self.by]))
        if not 3 <= count <= len(groups):
            raise ValueError(
                f"folds must be between 3 (one is judged, one calibrates, the rest trains) and "
                f"{len(groups)}, the number of groups ({self.by}); got {count}"
            )
        home = {group: i % count for i, group in enumerate(groups)}
        each: list[list[int]] = [[] for _ in range(count)]
        for row, group in enumerate(data.groups[self.by]):
            each[home[group]].append(row)
        return [_fold(each, k) for k in range(count)]

    def _hidden(self, data: Sequences) -> Tensor:
        return torch.tensor([c.startswith(self.hidden) for c in data.channels])


def _fold(each: Sequence[Sequence[int]], k: int) -> Fold:
    after = (k + 1) % len(each)
    rest = (row for i, rows in enumerate(each) if i not in (k, after) for row in rows)
    return Fold(train=tuple(sorted(rest)), calibration=tuple(each[after]), judged=tuple(each[k]))


def check_models(names: Sequence[str], able: Sequence[str], need: str) -> None:
    """Refuse entries that do not exist or cannot do what is asked."""
    for name in names:
        if name not in able:
            raise UnknownNameError(
                f"no model {name!r} that can {need}; there are {', '.join(able)}"
            )
