"""What a task shows to a model and what it hides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.arguments import seed_of, whole_number
from zoo.datasets.records import Groups, Pairs, Sequences
from zoo.datasets.split import nearest
from zoo.errors import NotCapableError, UnknownNameError

__all__ = ["NEEDS", "Question", "Setup", "ask", "beginning", "hide_joints", "hide_section"]


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the tasks are posed: which frames a forecast gets, and which entries are missing.

    ``hidden`` are the channels that "impute joints" hides throughout: a share of them, drawn by
    ``seed``, or names, where that of a joint stands for all its channels (``rfemur`` for
    ``rfemur_rx``, …). ``section`` are the frames that "impute section" hides in all channels: a
    share of each movement, in its middle, or frames (start, stop). Give a calibration the setup
    that will be asked: bands are corrected for what was hidden then.

    Raises ValueError or TypeError for settings that no task could have; names that the data do not
    have raise UnknownNameError when a task is posed.

    >>> Setup(hidden=("rfemur", "rtibia"), section=(20, 60)).hidden
    ('rfemur', 'rtibia')
    """

    seen: int | None = None
    horizon: int | None = None
    hidden: float | tuple[str, ...] = 0.2
    section: float | tuple[int, int] = 0.2
    draws: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse shares, names, frames and counts that mean nothing."""
        _check_hidden(self.hidden)
        _check_section(self.section)
        for name in ("seen", "horizon", "draws"):
            value = getattr(self, name)
            if value is not None or name == "draws":
                whole_number(value, name)
        seed_of(self.seed)

    def frames(self, data: Sequences, *, beyond: bool = False) -> tuple[int, int]:
        """Frames observed and frames to forecast; by default a seventh is observed (10 of 70).

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
class Question:
    """What a model is given, and the truth that its answer is held against.

    ``given`` holds nothing that is asked for; ``mask`` is True where the truth is known and asked
    for; ``horizon`` belongs to forecasts.
    """

    task: str
    given: Any
    truth: Float[Tensor, "..."]
    mask: Bool[Tensor, "..."]
    groups: Groups
    horizon: int = 0

    @property
    def need(self) -> str:
        """The capability that an answer takes."""
        return NEEDS[self.task]


NEEDS = {
    "regress": "regress",
    "reconstruct": "reconstruct",
    "forecast": "forecast",
    "impute joints": "impute",
    "impute section": "impute",
}


def ask(task: str, data: Pairs | Sequences, setup: Setup) -> Question:
    """The question of that task about ``data``.

    Raises UnknownNameError for a task that does not exist, TypeError for data of the other kind.

    >>> import numpy as np
    >>> data = Sequences.from_arrays(np.zeros((2, 30, 3)), rate=30.0)
    >>> question = ask("forecast", data, Setup(seen=10, horizon=5))
    >>> question.given.values.shape, question.truth.shape
    (torch.Size([2, 10, 3]), torch.Size([2, 5, 3]))
    """
    if task not in NEEDS:
        raise UnknownNameError(f"no task {task!r}; there are {', '.join(NEEDS)}")
    kind = Pairs if task == "regress" else Sequences
    if not isinstance(data, kind):
        raise TypeError(f"{kind.__name__} are needed; got {type(data).__name__}")
    if isinstance(data, Pairs):
        return Question(
            task=task, given=data, truth=data.targets, mask=data.mask, groups=data.groups
        )
    if task == "forecast":
        return _forecast(data, *setup.frames(data))
    if task == "reconstruct":
        return _about(task, data, data, data.mask)
    joints = task == "impute joints"
    hidden, section = setup.hidden, setup.section
    holed = hide_joints(data, hidden, seed=setup.seed) if joints else hide_section(data, section)
    return _about(task, holed, data, data.mask & ~holed.mask)


def _forecast(data: Sequences, seen: int, horizon: int) -> Question:
    future = data.frames(seen, seen + horizon)
    found = _about("forecast", beginning(data, seen, horizon), future, future.mask)
    return replace(found, horizon=horizon)


def _about(task: str, given: Sequences, truth: Sequences, mask: Tensor) -> Question:
    return Question(task=task, given=given, truth=truth.values, mask=mask, groups=truth.groups)


def beginning(data: Sequences, seen: int, horizon: int) -> Sequences:
    """What a forecast may see: the first frames, and the controls of those to come as well."""
    known = data.frames(0, seen)
    if data.controls is None:
        return known
    return replace(known, controls=data.controls[:, : seen + horizon])


def hide_joints(data: Sequences, hidden: float | tuple[str, ...], *, seed: int = 0) -> Sequences:
    """The movements with channels missing throughout: a share drawn at random, or those named."""
    if len(data.channels) < 2:
        raise NotCapableError(f"hiding joints needs at least 2 channels; {data.name!r} has 1")
    if isinstance(hidden, tuple):
        pick = [i for name in hidden for i in _columns(data.channels, name)]
    else:
        count = len(data.channels)
        number = min(max(1, round(hidden * count)), count - 1)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
        pick = order[:number].tolist()
    keep = torch.ones(len(data.channels), dtype=torch.bool)
    keep[pick] = False
    if not bool(keep.any()):
        raise ValueError(f"hidden names all {len(data.channels)} channels; at least 1 must be left")
    return _masked(data, data.mask & keep)


def hide_section(data: Sequences, section: float | tuple[int, int]) -> Sequences:
    """The movements without some frames, in all channels: a share in the middle, or from to."""
    time = torch.arange(data.values.shape[1])
    length = data.lengths[:, None]
    if isinstance(section, tuple):
        start, stop = section
        shortest = int(length.min())
        if stop > shortest or stop - start == shortest:
            raise ValueError(
                f"section {start} to {stop} must leave frames of the shortest movement, which has "
                f"{shortest}"
            )
        inside = ((time >= start) & (time < stop)).expand(len(data), -1)
    else:
        width = (section * length).round().clamp(min=1)
        start_of = (length - width) / 2
        inside = (time >= start_of) & (time < start_of + width)
    return _masked(data, data.mask & ~inside[..., None])


def _columns(channels: Sequence[str], name: str) -> list[int]:
    """The channel of that name, or all channels of the joint of that name."""
    found = [i for i, c in enumerate(channels) if c == name or c.startswith(f"{name}_")]
    if not found:
        raise UnknownNameError(f"no channel or joint {name!r} to hide{nearest(name, channels)}")
    return found


def _check_hidden(hidden: object) -> None:
    if isinstance(hidden, tuple):
        if not hidden or not all(isinstance(name, str) for name in hidden):
            raise ValueError(f"hidden needs names of channels or joints; got {hidden!r}")
    else:
        _check_share("hidden", "names of channels or joints in a tuple", hidden)


def _check_section(section: object) -> None:
    if isinstance(section, tuple):
        whole = len(section) == 2 and all(isinstance(frame, int) for frame in section)
        if not whole or not 0 <= section[0] < section[1]:
            raise ValueError(f"section needs frames 0 <= start < stop; got {section!r}")
    else:
        _check_share("section", "frames (start, stop)", section)


def _check_share(name: str, other: str, share: object) -> None:
    if not isinstance(share, int | float):
        raise TypeError(f"{name} takes a share or {other}; got {share!r}")
    if not 0 < share < 1:
        raise ValueError(f"{name} as a share must be above 0 and below 1; got {share}")


def _masked(data: Sequences, mask: Tensor) -> Sequences:
    return replace(data, mask=mask, values=torch.where(mask, data.values, 0.0))
