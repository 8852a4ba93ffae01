"""Inference strategies of the catalogue's entries: frozen settings, free of any model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["Exact", "Inference", "MarginalLikelihood", "Svi"]


@dataclass(frozen=True, kw_only=True)
class Svi:
    """Minibatch stochastic variational inference.

    ``window`` frames a window (None: whole movements), cut every ``stride`` frames;
    ``temper_epochs`` is T_a of (87), 0 for none; ``warmup_epochs`` a second schedule on the KL;
    ``patience`` validations without progress end the training and the best state is restored.
    ``max_steps`` bounds the work on large data: see :meth:`budgeted`.
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

    def __post_init__(self) -> None:
        """Refuse settings that no training could run with."""
        for name in ("epochs", "batch_size", "stride", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be positive; got {self.learning_rate}")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"max_steps must be at least 1; got {self.max_steps}")

    def budgeted(self, steps_an_epoch: int) -> Svi:
        """The same schedule, shortened as a whole where it would take more than ``max_steps``.

        >>> shorter = Svi(epochs=1000, temper_epochs=100, max_steps=5000).budgeted(50)
        >>> shorter.epochs, shorter.temper_epochs
        (100, 10)
        """
        if self.max_steps is None or self.epochs * steps_an_epoch <= self.max_steps:
            return self
        epochs = max(1, self.max_steps // steps_an_epoch)
        share = epochs / self.epochs
        return replace(
            self,
            epochs=epochs,
            temper_epochs=math.ceil(share * self.temper_epochs),
            warmup_epochs=math.ceil(share * self.warmup_epochs),
            validate_every=max(1, math.floor(share * self.validate_every)),
        )


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
