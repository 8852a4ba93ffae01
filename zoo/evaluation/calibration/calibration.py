"""What bands were calibrated for: which questions, on how many groups, of which people."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor

from zoo.errors import OtherPeopleWarning, OtherQuestionWarning
from zoo.evaluation.answers import Groups
from zoo.evaluation.calibration.asked import Asked
from zoo.evaluation.calibration.promise import LEVEL, caller, promised
from zoo.evaluation.calibration.recalibration import Stored, recalibration_from_state
from zoo.evaluation.questions import NEEDS

__all__ = ["PEOPLE", "Calibrated", "Calibration"]

PEOPLE = ("subject", "person", "participant")


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """The correction of one question, on how many ``groups`` it was fitted, and of which people.

    ``by`` is the column whose values count as groups, empty for movements. With ``adaptive`` it was
    fitted on spreads that follow the errors in the frames observed
    (:mod:`~zoo.evaluation.calibration.adapted`).
    """

    asked: Asked
    correction: Stored
    groups: int
    people: Mapping[str, tuple[str, ...]]
    by: str = ""
    adaptive: bool = False

    def __str__(self) -> str:
        """Question, promise, and for whom, in a sentence."""
        whose = [f"{k} {', '.join(v)}" for k, v in self.people.items() if k != self.by]
        group = self.by or "movement"
        return (
            f"{self.asked}: {self.correction.kind} on {self.groups} groups ({group}), which can "
            f"promise {promised(LEVEL, self.groups):.0%} for a {LEVEL:.0%} band of a new {group}"
            f"{' of ' + '; '.join(whose) if whose else ''}"
        )

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON and tensors to store."""
        meta, tensors = self.correction.state()
        about = {
            "asked": self.asked.state(),
            "people": {k: list(v) for k, v in self.people.items()},
            "by": self.by,
            "adaptive": self.adaptive,
        }
        return {**meta, **about}, tensors

    @classmethod
    def from_state(cls, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        correction = recalibration_from_state(meta, tensors)
        return cls(
            asked=Asked.from_state(meta["asked"]),
            correction=correction,
            groups=correction.groups,
            people={k: tuple(v) for k, v in meta["people"].items()},
            by=str(meta["by"]),
            adaptive=bool(meta["adaptive"]),
        )

    def strangers(self, groups: Groups) -> str:
        """People among ``groups`` that the calibration did not have, in words; empty if none."""
        for column, known in self.people.items():
            new = [p for p in dict.fromkeys(groups.get(column, ())) if p not in known]
            if new and column != self.by:
                return f"{column} {', '.join(known)}; these are of {column} {', '.join(new)}"
        return ""


@dataclass(frozen=True)
class Calibration:
    """All questions that the bands of a run were calibrated for."""

    parts: tuple[Calibrated, ...] = ()

    def __bool__(self) -> bool:
        """Whether any question was."""
        return bool(self.parts)

    def __repr__(self) -> str:
        """A line a question: what is promised, on how many groups, for whom."""
        return "\n".join(str(part) for part in self.parts) or "not calibrated"

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks that any question is of."""
        return tuple(dict.fromkeys(part.asked.task for part in self.parts))

    def state(self) -> tuple[list[dict[str, Any]], dict[str, Tensor]]:
        """JSON and tensors to store, those of part i by names that begin with i."""
        metas, tensors = [], dict[str, Tensor]()
        for i, part in enumerate(self.parts):
            meta, extra = part.state()
            metas.append(meta)
            tensors.update({f"{i}.{k}": v for k, v in extra.items()})
        return metas, tensors

    @classmethod
    def from_state(cls, metas: Sequence[Mapping[str, Any]], tensors: dict[str, Tensor]) -> Self:
        """What :meth:`state` gave."""
        parts = []
        for i, meta in enumerate(metas):
            own = {k.removeprefix(f"{i}."): v for k, v in tensors.items() if k.startswith(f"{i}.")}
            parts.append(Calibrated.from_state(meta, own))
        return cls(tuple(parts))

    def joined(self, parts: Iterable[Calibrated]) -> Calibration:
        """With more questions; of one question the latest correction is kept."""
        kept = {part.asked: part for part in (*self.parts, *parts)}
        return Calibration(tuple(kept.values()))

    def part(self, asked: Asked, groups: Groups) -> Calibrated | None:
        """The correction for a question; None where no question of its task was calibrated for.

        Between two observed lengths corrections are interpolated. Warns, by
        :class:`~zoo.errors.OtherQuestionWarning`, where no question like it was calibrated for, and
        by :class:`~zoo.errors.OtherPeopleWarning` of people that the calibration did not have.
        """
        same = [part for part in self.parts if part.asked.task == asked.task]
        if not same:
            _warn_of_raw(asked, self.tasks)
            return None
        near = _nearest(same, asked)
        if not (asked.like(near.asked) or _between(same, asked)):
            known = "; ".join(str(part.asked) for part in same)
            warnings.warn(
                f"{asked}: its bands are those of another question ({near.asked}), and nothing is "
                f"promised for them; calibrated for: {known}. run.calibrate(data, "
                "setup=zoo.Setup(...)) calibrates for this one; prediction.raw has the raw bands",
                OtherQuestionWarning,
                stacklevel=caller(),
            )
        if people := near.strangers(groups):
            follow = (
                "bands follow the errors of the model in the frames observed, but "
                if near.adaptive
                else ""
            )
            warnings.warn(
                f"{asked.task}: bands were calibrated on {people}: {follow}nothing is promised for "
                'people who were not in the calibration; run.calibrate(data, by="subject") on '
                "several people counts people as groups",
                OtherPeopleWarning,
                stacklevel=caller(),
            )
        return _interpolated(same, asked, near)


def _warn_of_raw(asked: Asked, tasks: Sequence[str]) -> None:
    """Say that bands are raw where others of the run are not, and these could be calibrated."""
    if asked.task in NEEDS:
        warnings.warn(
            f"{asked}: its bands are raw, as the model gives them: calibrated for "
            f"{', '.join(tasks)} only",
            OtherQuestionWarning,
            stacklevel=caller(),
        )


def _nearest(parts: list[Calibrated], asked: Asked) -> Calibrated:
    """Of forecasts the nearest observed length, of imputations one that hides what is like it."""

    def apart(part: Calibrated) -> tuple[bool, float, int]:
        other = part.asked
        frames = abs(other.section - asked.section)
        return other.hidden != asked.hidden, other.distance(asked), frames

    return min(parts, key=apart)


def _between(parts: list[Calibrated], asked: Asked) -> bool:
    """Whether a forecast lies within a grid of observed lengths, and ends where they ended."""
    lengths = [part.asked.observed for part in parts]
    last = max(part.asked.observed + part.asked.horizon for part in parts)
    inside = min(lengths) <= asked.observed <= max(lengths)
    return asked.task == "forecast" and inside and asked.observed + asked.horizon <= last


def _interpolated(parts: list[Calibrated], asked: Asked, near: Calibrated) -> Calibrated:
    """Between its neighbours of a grid, linear in the log of the observed length."""
    below = [p for p in parts if p.asked.observed <= asked.observed]
    above = [p for p in parts if p.asked.observed > asked.observed]
    if asked.task != "forecast" or not below or not above:
        return near
    low = max(below, key=lambda p: p.asked.observed)
    high = min(above, key=lambda p: p.asked.observed)
    alike = low.adaptive == high.adaptive and low.correction.kind == high.correction.kind
    if not alike or low.asked.observed == asked.observed:
        return near
    share = low.asked.distance(asked) / low.asked.distance(high.asked)
    between = low.correction.blend(high.correction, share)
    return Calibrated(
        asked=asked,
        correction=between,
        groups=min(low.groups, high.groups),
        people=near.people,
        by=near.by,
        adaptive=near.adaptive,
    )
