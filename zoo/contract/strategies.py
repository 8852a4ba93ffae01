"""Inference strategies of the catalogue's entries: frozen settings, free of any model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["Exact", "Inference", "MarginalLikelihood", "Svi"]

_RAMPS = {"temper_epochs": "c", "warmup_epochs": "β"}
_LEAST = dict.fromkeys(_RAMPS, 0) | {
    "epochs": 1,
    "batch_size": 1,
    "window": 1,
    "stride": 1,
    "patience": 1,
    "validate_every": 1,
    "checkpoint_every": 1,
    "max_steps": 1,
}


@dataclass(frozen=True, kw_only=True)
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

    epochs: int = 500
    batch_size: int = 64
    window: int | None = 1
    stride: int = 1
    learning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "cosine"
    clip: float | None = 10.0
    temper_epochs: int = 0
    warmup_epochs: int = 0
    patience: int | None = 20
    validate_every: int = 10
    checkpoint_every: int = 10
    max_steps: int | None = None
    kept_out: float = 0.0

    def __post_init__(self) -> None:
        """Refuse settings that no training could run with."""
        for name, bound in _LEAST.items():
            value = getattr(self, name)
            if value is not None and value < bound:
                raise ValueError(f"{name} must be at least {bound}; got {value}")
        for name in ("learning_rate", "clip"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive; got {value}")
        if not 0 <= self.kept_out < 1:
            raise ValueError(f"kept_out must be at least 0 and below 1; got {self.kept_out}")
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


@dataclass(frozen=True, kw_only=True)
class Exact:
    """Closed form: ``model.condition(train)`` is the whole training."""


@dataclass(frozen=True, kw_only=True)
class MarginalLikelihood:
    """Type-II maximum likelihood of ``model.objective()`` after ``model.condition(train)``."""

    optimizer: Literal["l-bfgs", "newton"] = "l-bfgs"
    iterations: int = 200
    restarts: int = 1
    tolerance: float = 1e-6


Inference = Svi | Exact | MarginalLikelihood
