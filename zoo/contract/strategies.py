"""Inference strategies of the catalogue's entries: frozen settings, free of any model."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field

from zoo.contract.settings import Count, Positive, settings

__all__ = ["Exact", "Inference", "MarginalLikelihood", "Svi"]

_RAMPS = {"temper_epochs": "c", "warmup_epochs": "β"}


@settings
class Svi:
    """Minibatch stochastic variational inference.

    ``window`` frames a window (None: whole movements), cut every ``stride`` frames;
    ``temper_epochs`` is T_a of (87), 0 for none; ``warmup_epochs`` a second schedule on the KL:
    both end before the last epoch, so that c = β = 1 is reached;
    ``patience`` validations without progress end the training and the best state is restored.
    ``max_steps`` bounds the work on large data: see :meth:`budgeted`. ``kept_out`` is the share of
    the movements' groups that the networks are not trained on where there is no validation part
    and there are at least 8 groups: a model that learns its noise from new movements needs them.
    """

    epochs: Count = 500
    batch_size: Count = 64
    window: Count | None = 1
    stride: Count = 1
    learning_rate: Positive = 1e-3
    schedule: Literal["constant", "cosine"] = "cosine"
    clip: Positive | None = 10.0
    temper_epochs: Annotated[int, Field(ge=0)] = 0
    warmup_epochs: Annotated[int, Field(ge=0)] = 0
    patience: Count | None = 20
    validate_every: Count = 10
    checkpoint_every: Count = 10
    max_steps: Count | None = None
    kept_out: Annotated[float, Field(ge=0, lt=1)] = 0.0

    def __post_init__(self) -> None:
        """Refuse a schedule that does not reach its end."""
        for name, symbol in _RAMPS.items():
            if getattr(self, name) >= self.epochs:
                raise ValueError(
                    f"{name} must be below epochs, else {symbol} = 1 is never reached; got "
                    f"{name}={getattr(self, name)} and epochs={self.epochs}: "
                    f"raise epochs or lower {name} (0 for none)"
                )

    def lasting(self, epochs: int) -> Svi:
        """The same schedule over fewer epochs: tempering and warm-up keep their share of it.

        >>> Svi(epochs=1500, temper_epochs=100).lasting(300).temper_epochs
        20
        >>> Svi(epochs=1500, temper_epochs=100).lasting(1).temper_epochs
        0
        """
        share = min(1.0, epochs / self.epochs)
        ramps = {n: min(math.ceil(share * getattr(self, n)), max(0, epochs - 1)) for n in _RAMPS}
        return replace(self, epochs=epochs, **ramps)

    def budgeted(self, steps_an_epoch: int) -> Svi:
        """The same schedule, shortened as a whole where it would take more than ``max_steps``.

        >>> shorter = Svi(epochs=1000, temper_epochs=100, max_steps=5000).budgeted(50)
        >>> shorter.epochs, shorter.temper_epochs
        (100, 10)
        """
        if self.max_steps is None or self.epochs * steps_an_epoch <= self.max_steps:
            return self
        shorter = self.lasting(max(1, self.max_steps // steps_an_epoch))
        share = shorter.epochs / self.epochs
        return replace(shorter, validate_every=max(1, math.floor(share * self.validate_every)))


@settings
class Exact:
    """Closed form: ``model.condition(train)`` is the whole training."""


@settings
class MarginalLikelihood:
    """Type-II maximum likelihood of ``model.objective()`` after ``model.condition(train)``."""

    optimizer: Literal["l-bfgs", "newton"] = "l-bfgs"
    iterations: Count = 200
    restarts: Count = 1
    tolerance: Positive = 1e-6


Inference = Svi | Exact | MarginalLikelihood
