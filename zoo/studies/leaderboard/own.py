"""A protocol on one's own movements: nothing of what is hidden is used."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.evaluation.questions import hide_joints
from zoo.studies.leaderboard.protocol import Protocol
from zoo.studies.leaderboard.protocols import FORECASTERS, IMPUTERS, protocol

__all__ = ["asked_for", "own_protocol"]


def own_protocol(
    data: Sequences,
    *,
    seen: int = 0,
    horizon: int = 0,
    hidden: Sequence[str] = (),
    by: str = "trial",
    settings: Mapping[str, Mapping[str, Any]] | None = None,
) -> Protocol:
    """Forecast ``horizon`` frames after ``seen``, or impute the channels or joints ``hidden``.

    ``by`` is the group column whose values stay together in a fold; ``settings`` are those of
    entries by name. A ``ValueError`` says what the data cannot be asked.

    >>> import numpy as np
    >>> data = Sequences.from_arrays(np.zeros((6, 30, 2)), rate=30.0, name="reaches")
    >>> own_protocol(data, seen=10, horizon=20).name
    'reaches-10-20'
    """
    _check_groups(data, by)
    question = _imputation(data, hidden) if hidden else _forecast(data, seen, horizon)
    if hidden and (seen or horizon):
        raise ValueError("either seen and horizon or hidden channels are asked; got both")
    return Protocol(
        load=partial(_given, data), source="own", by=by, settings=settings or {}, **question
    )


def asked_for(
    name: str | None, data: str | None, seen: int, horizon: int, hidden: str, by: str
) -> Protocol:
    """The protocol that a command line asks for: one that ships, or one on a data set by name."""
    if data is None:
        if name is None or seen or horizon or hidden:
            raise ValueError("--seen, --horizon and --hidden need --data; a protocol has its own")
        return protocol(name)
    if name is not None:
        raise ValueError(f"either a protocol or --data is asked; got {name} and {data}")
    movements = load_data(data)
    if not isinstance(movements, Sequences):
        raise TypeError(f"a leaderboard needs movements; {data} holds {type(movements).__name__}")
    parts = [h for h in hidden.split(",") if h]
    options = {
        "seen": seen,
        "horizon": horizon,
        "hidden": hidden,
        "by": by if by != "trial" else "",
    }
    words = "".join(f" --{k} {v}" for k, v in options.items() if v)
    asked = own_protocol(movements, seen=seen, horizon=horizon, hidden=parts, by=by)
    return replace(asked, command=f"zoo leaderboard --data {data}{words}")


def _given(data: Sequences) -> Sequences:
    return data


def _forecast(data: Sequences, seen: int, horizon: int) -> dict[str, Any]:
    shortest = int(data.lengths.min())
    if seen < 1 or horizon < 1 or seen + horizon > shortest:
        raise ValueError(
            "a forecast needs seen and horizon of at least 1 frame and together at most "
            f"{shortest}, the length of the shortest movement of {data.name!r}; got {seen} and "
            f"{horizon}"
        )
    return {
        "name": f"{_slug(data.name)}-{seen}-{horizon}",
        "summary": f"{data.name}: {seen} frames observed and {horizon} forecast",
        "need": "forecast",
        "models": FORECASTERS,
        "seen": seen,
        "horizon": horizon,
    }


def _imputation(data: Sequences, hidden: Sequence[str]) -> dict[str, Any]:
    left = hide_joints(data, tuple(hidden)).mask.flatten(0, 1).any(0).tolist()
    recorded = data.mask.flatten(0, 1).any(0).tolist()
    pairs = zip(data.channels, recorded, left, strict=True)
    inside = [c for c, known, kept in pairs if known and not kept]
    return {
        "name": f"{_slug(data.name)}-without-{_slug('-'.join(hidden))}",
        "summary": f"{data.name}: {len(inside)} channels imputed, {', '.join(inside)}",
        "need": "impute",
        "models": IMPUTERS,
        "hidden": tuple(hidden),
    }


def _check_groups(data: Sequences, by: str) -> None:
    if by not in data.groups:
        raise ValueError(f"no group column {by!r}; there are {', '.join(data.groups) or 'none'}")


def _slug(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-")
