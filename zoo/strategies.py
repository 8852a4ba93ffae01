"""Inference strategies of the catalogue's entries: frozen settings, free of any model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Exact", "Inference", "MarginalLikelihood", "Svi"]


@dataclass(frozen=True, kw_only=True)
class Svi:
    """Minibatch stochastic variational inference.

    ``window`` frames a window (None: whole movements), cut every ``stride`` frames;
    ``temper_epochs`` is T_a of (87), 0 for none; ``warmup_epochs`` a second schedule on the KL;
    ``patience`` validations without progress end the training and the best state is restored.
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

    def __post_init__(self) -> None:
        """Refuse settings that no training could run with."""
        for name in ("epochs", "batch_size", "stride", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be positive; got {self.learning_rate}")


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
