"""What a task shows to a model and what it hides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from zoo.arguments import seed_of, whole_number
from zoo.datasets.records import Sequences
from zoo.datasets.split import nearest
from zoo.errors import NotCapableError, UnknownNameError

__all__ = ["Setup", "hide_joints", "hide_section"]


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the tasks are posed: what a forecast sees, and which entries are missing.

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
