"""Questions on real movements, each with its data, its hidden part and its folds by trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from zoo.datasets.cmu_mocap import load
from zoo.datasets.records import Sequences
from zoo.datasets.robot_arm import load as load_arm
from zoo.errors import UnknownNameError
from zoo.prediction import Prediction
from zoo.tasks import Predictor, beginning

__all__ = ["BASELINES", "PROTOCOLS", "Protocol", "check_models", "protocol"]

BASELINES = ("mean", "last-value", "ar", "nearest-neighbour", "kernel-ridge")
LEG = ("rfemur", "rtibia", "rfoot", "rtoes")
FRAMES = 300
Need = Literal["forecast", "impute"]
Settings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """One question: ``seen`` frames and the rest to forecast, or ``hidden`` channels to fill in.

    ``settings`` are what an entry is given here instead of its defaults; ``models`` are asked
    where none are named. Groups of ``by`` are never in training and test at once. Protocols whose
    ``data`` have one name share what was trained on them.
    """

    summary: str
    load: Callable[[], Sequences]
    source: Literal["public", "simulated"]
    need: Need
    models: tuple[str, ...]
    data: str = ""
    seen: int = 0
    hidden: tuple[str, ...] = ()
    by: str = "trial"
    settings: Settings = field(default_factory=dict)

    def answer(self, run: Predictor, data: Sequences, *, draws: int, seed: int) -> Prediction:
        """The prediction of a run for movements whose truth is ``data``."""
        if self.need == "forecast":
            horizon = int(data.lengths.min()) - self.seen
            known = beginning(data, self.seen, horizon)
            return run.forecast(known, horizon=horizon, draws=draws, seed=seed)
        mask = data.mask & ~self._hidden(data)
        known = replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))
        return run.impute(known, draws=draws, seed=seed)

    def truth(self, data: Sequences) -> tuple[Tensor, Tensor]:
        """What came true, and which entries were asked for."""
        if self.need == "forecast":
            future = data.frames(self.seen, int(data.lengths.min()))
            return future.values, future.mask
        return data.values, data.mask & self._hidden(data)

    def folds(self, data: Sequences, count: int | None) -> list[list[int]]:
        """Rows of every fold: all movements of a group stay together; None is one group each."""
        groups = list(dict.fromkeys(data.groups[self.by]))
        number = len(groups) if count is None else count
        if not 2 <= number <= len(groups):
            raise ValueError(f"folds must be between 2 and {len(groups)} groups; got {number}")
        home = {group: i % number for i, group in enumerate(groups)}
        rows = enumerate(data.groups[self.by])
        each: list[list[int]] = [[] for _ in range(number)]
        for row, group in rows:
            each[home[group]].append(row)
        return each

    def _hidden(self, data: Sequences) -> Tensor:
        return torch.tensor([c.startswith(self.hidden) for c in data.channels])


def _centred_walks() -> Sequences:
    """The first 300 frames of 35_01–35_16, 120 Hz, less each walk's own mean."""
    walks = load("35-walk", frames=None).frames(0, FRAMES)
    return replace(walks, values=walks.values - walks.values.mean(1, keepdim=True))


def _slow_walks() -> Sequences:
    """The same walks at 30 Hz, 75 frames, not centred."""
    return load("35-walk", frames=None, rate=30.0).frames(0, FRAMES // 4)


_FORECASTERS = (
    *BASELINES,
    "dmp",
    "promp",
    "promp-rhythmic",
    "pca-dmp",
    "vae-dmp-rhythmic",
    "vae-dmp",
    "ae-dmp",
    "dvbf",
    "sparse-ae-dmp",
    "ae-then-dmp",
    "promp-rhythmic+vae-dmp-rhythmic",
)
_IMPUTERS = (
    "mean",
    "ar",
    "nearest-neighbour",
    "kernel-ridge",
    "pca",
    "dmp",
    "promp",
    "promp-rhythmic",
    "ae-dmp",
    "vae",
    "vae-dmp",
    "vae-dmp-rhythmic",
    "nearest-neighbour+promp-rhythmic",
    "promp-rhythmic+vae-dmp-rhythmic",
)
_AE_DMP: Mapping[str, Any] = {"epochs": 1000}
_WALK_SETTINGS: Settings = {
    "kernel-ridge": {"places": 200},
    "ae-dmp": _AE_DMP,
    "sparse-ae-dmp": _AE_DMP,
    "ae-then-dmp": _AE_DMP,
    "vae-dmp": {"window": 20, "stride": 5, "epochs": 200},
    "vae-dmp-rhythmic": {"latent_dim": 8, "epochs": 200},
    "dvbf": {"window": 60, "stride": 20, "epochs": 500},
}

PROTOCOLS: dict[str, Protocol] = {
    "walk-setup-1": Protocol(
        summary="walks, 3 frames seen and 297 forecast: 50 channels, 120 Hz, each centred",
        load=_centred_walks,
        source="public",
        need="forecast",
        models=_FORECASTERS,
        data="centred-walks",
        seen=3,
        settings=_WALK_SETTINGS,
    ),
    "walk-setup-2": Protocol(
        summary="walks, 100 frames seen and 200 forecast: 50 channels, 120 Hz, each centred",
        load=_centred_walks,
        source="public",
        need="forecast",
        models=_FORECASTERS,
        data="centred-walks",
        seen=100,
        settings=_WALK_SETTINGS,
    ),
    "walk-missing-leg": Protocol(
        summary="walks at 30 Hz, 75 frames, the right leg's seven channels filled in",
        load=_slow_walks,
        source="public",
        need="impute",
        models=_IMPUTERS,
        hidden=LEG,
        settings={
            "pca": {"latent_dim": 12},
            "vae": {"latent_dim": 12},
            "ae-dmp": {"latent_dim": 12, **_AE_DMP},
            "vae-dmp": {"latent_dim": 8, "epochs": 300},
            "vae-dmp-rhythmic": {"latent_dim": 8, "stride": 2, "epochs": 400},
        },
    ),
    "arm-goals": Protocol(
        summary="a robot arm's reaches, 10 of 76 frames seen, the goal held out",
        load=load_arm,
        source="simulated",
        need="forecast",
        models=(*BASELINES, "dmp", "promp"),
        seen=10,
        by="goal",
    ),
}


def protocol(name: str, known: Mapping[str, Protocol] = PROTOCOLS) -> Protocol:
    """A protocol by name.

    >>> protocol("walk-setup-2").seen
    100
    """
    if name not in known:
        raise UnknownNameError(f"no protocol {name!r}; there are {', '.join(known)}")
    return known[name]


def check_models(names: Sequence[str], able: Sequence[str], need: str) -> None:
    """Refuse entries that do not exist or cannot do what is asked."""
    for name in names:
        if name not in able:
            raise UnknownNameError(
                f"no model {name!r} that can {need}; there are {', '.join(able)}"
            )
