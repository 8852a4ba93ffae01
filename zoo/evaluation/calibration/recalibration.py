"""Recalibration of predictive standard deviations on held-out groups.

What is exchangeable between calibration and use is a whole group (a movement), never a frame. Few
groups have to do, so the factors of channels and lead times are shrunk (:class:`Stretch`), every
group weighs the same, and scores that set a level come from groups left out of the factors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from torch import Tensor

from zoo.errors import UnknownNameError
from zoo.evaluation.answers import Answer, Groups
from zoo.evaluation.calibration.conformal import Conformal
from zoo.evaluation.calibration.isotonic import Isotonic
from zoo.evaluation.calibration.promise import warn_of_few
from zoo.evaluation.calibration.scale import Scale
from zoo.evaluation.calibration.stretch import By
from zoo.prediction.prediction import Prediction, Recalibration

__all__ = [
    "RECALIBRATIONS",
    "Conformal",
    "Isotonic",
    "Scale",
    "Stored",
    "fitted",
    "recalibrate",
    "recalibration_from_state",
]


class Stored(Recalibration, Protocol):
    """A correction that a run keeps: it can be stored, and blended with another of its kind."""

    kind: ClassVar[str]

    @property
    def groups(self) -> int:
        """Number of groups that it was fitted on."""
        ...

    def blend(self, other: Any, share: float) -> Stored:
        """Between this correction and another, at a share of the way."""
        ...

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What a file must keep of it: JSON with its ``kind``, and tensors."""
        ...


class _Kind(Protocol):
    def fit(self, answer: Answer, by: tuple[By, ...]) -> Stored: ...

    def from_state(self, meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Stored: ...


RECALIBRATIONS: dict[str, _Kind] = {k.kind: k for k in (Conformal, Isotonic, Scale)}


def recalibrate(
    kind: str,
    prediction: Prediction,
    truth: Tensor,
    mask: Tensor | None = None,
    groups: Groups | None = None,
    *,
    by: tuple[By, ...] = ("channel", "time"),
) -> Stored:
    """A correction of ``prediction``'s bands, to be used on predictions of the same kind.

    ``kind`` is ``conformal``, ``isotonic`` or ``scale``; ``by`` says which factors are fitted
    beside the common one. Groups are those of :func:`~zoo.evaluation.answers.clusters`. Of too few
    for a conformal 90 % band with a guarantee (see
    :func:`~zoo.evaluation.calibration.promise.promised`) a :class:`~zoo.errors.FewGroupsWarning`
    says what they can promise and what the bands became.

    >>> import torch
    >>> from zoo.prediction.predictive import Predictive
    >>> raw = Prediction(
    ...     predictive=Predictive(location=torch.zeros(1, 400, 1), noise=torch.ones(1)),
    ...     axes=("item", "target"), names=("f_z",), units=("N",), task="regress")
    >>> truth = 3 * torch.randn(400, 1, generator=torch.Generator().manual_seed(0))
    >>> mended = raw.recalibrated(recalibrate("scale", raw, truth))
    >>> bool(2.7 < mended.std[0, 0] < 3.3)
    True
    """
    answer = Answer.of(prediction.raw, truth, mask, groups)
    found = fitted(kind, answer, by)
    if isinstance(found, Conformal):
        warn_of_few(answer, found, found.worth, found.reach, prediction.task)
    return found


def fitted(kind: str, answer: Answer, by: tuple[By, ...] = ("channel", "time")) -> Stored:
    """The same correction without a word on how few groups there are."""
    if answer.groups < 2:
        raise ValueError("recalibration needs at least 2 groups (movements or items); got 1")
    return _kind(kind).fit(answer, by)


def recalibration_from_state(meta: Mapping[str, Any], tensors: dict[str, Tensor]) -> Stored:
    """The recalibration that ``state()`` gave JSON and tensors of."""
    return _kind(meta["kind"]).from_state(meta, tensors)


def _kind(name: str) -> _Kind:
    if name not in RECALIBRATIONS:
        raise UnknownNameError(f"no recalibration {name!r}; there are {', '.join(RECALIBRATIONS)}")
    return RECALIBRATIONS[name]
