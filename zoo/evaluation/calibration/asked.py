"""What a question shows and hides, as far as the errors of its answers depend on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import torch

from zoo.datasets.records import Pairs, Sequences

__all__ = ["Asked"]

LIKE, FEW = 1.25, 2


@dataclass(frozen=True, kw_only=True)
class Asked:
    """A question, as a calibration remembers it.

    ``observed`` and ``horizon`` are frames of a forecast, ``hidden`` the channels that an
    imputation misses throughout, ``section`` the number of frames that it misses in all channels.
    """

    task: str
    observed: int = 0
    horizon: int = 0
    hidden: tuple[str, ...] = ()
    section: int = 0

    @classmethod
    def of(cls, task: str, data: Pairs | Sequences, horizon: int = 0) -> Self:
        """The question that ``task`` is about these data; an imputation is of joints or a section.

        >>> import numpy as np
        >>> data = Sequences.from_arrays(np.zeros((2, 30, 3)), rate=30.0)
        >>> Asked.of("forecast", data, 20)
        Asked(task='forecast', observed=30, horizon=20, hidden=(), section=0)
        """
        if isinstance(data, Pairs) or not isinstance(data, Sequences):
            return cls(task=task)
        if task == "forecast":
            lengths = data.lengths.double().sort().values
            return cls(task=task, observed=int(lengths[len(lengths) // 2]), horizon=horizon)
        if not task.startswith("impute"):
            return cls(task=task)
        inside = torch.arange(data.values.shape[1]) < data.lengths[:, None]
        section = int((inside & ~data.mask.any(-1)).sum(1).max())
        seen = data.mask.flatten(0, 1).any(0).tolist()
        hidden = tuple(c for c, known in zip(data.channels, seen, strict=True) if not known)
        joints = bool(hidden) or not section
        kind = "impute joints" if joints else "impute section"
        return cls(task=kind, hidden=hidden, section=section)

    def __str__(self) -> str:
        """The question in words."""
        if self.task == "forecast" and not self.observed:
            return "forecast of unknown length"
        if self.task == "forecast":
            return f"forecast of {self.horizon} frames after {self.observed}"
        if self.task == "impute joints":
            names = ", ".join(self.hidden[:4]) or "single entries"
            more = f" and {len(self.hidden) - 4} more" if len(self.hidden) > 4 else ""
            return f"imputation of {names}{more}"
        if self.task == "impute section":
            return f"imputation of {self.section} frames"
        return self.task

    def distance(self, other: Asked) -> float:
        """How far apart the observed lengths of two forecasts are, as the log of their ratio."""
        return abs(math.log(max(self.observed, 1) / max(other.observed, 1)))

    def like(self, other: Asked) -> bool:
        """Whether bands of ``other`` may be given for this question.

        The same channels are hidden; frames observed and frames hidden differ by a quarter at most;
        no forecast goes more than a quarter further from its first frame.
        """
        if self.task != other.task or self.hidden != other.hidden:
            return False
        if self.task == "forecast":
            further = (self.observed + self.horizon) > LIKE * (other.observed + other.horizon)
            return self.distance(other) <= math.log(LIKE) and not further
        sections = self.section, other.section
        return max(sections) - min(sections) <= max(FEW, (1 - 1 / LIKE) * max(sections))

    def state(self) -> dict[str, Any]:
        """As JSON keeps it."""
        return asdict(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """What :meth:`state` gave."""
        return cls(**{**state, "hidden": tuple(state["hidden"])})
