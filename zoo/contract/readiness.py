"""What a model needs before it predicts: training, and a posterior."""

from __future__ import annotations

from torch import Tensor

from zoo.errors import NotFittedError
from zoo.types import Posterior

__all__ = ["check_fitted", "need"]


def check_fitted(name: str, buffer: Tensor) -> None:
    """Raise a NotFittedError while ``buffer`` is still the empty placeholder."""
    if buffer.numel() == 0:
        raise NotFittedError(f"{name} has seen no data yet; call zoo.fit or condition first")


def need(posterior: Posterior | None) -> Posterior:
    """The posterior; a model that predicts through its guide refuses to do without."""
    if posterior is None:
        raise TypeError("this model predicts through its guide; got no posterior")
    return posterior
