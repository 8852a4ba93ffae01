"""One question that models are compared by: what is observed, what is hidden, and the folds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from zoo.datasets.records import Sequences
from zoo.errors import UnknownNameError
from zoo.evaluation.questions import Question, Setup, ask

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

    def question(self, data: Sequences) -> Question:
        """What models are given of ``data``, and what of it is asked for."""
        if self.need == "forecast":
            return ask("forecast", data, Setup(seen=self.seen, horizon=self.horizon))
        return ask("impute joints", data, Setup(hidden=self.hidden))

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
