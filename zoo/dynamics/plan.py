"""What belongs to a movement of a latent primitive, whatever window of it is looked at."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

from jaxtyping import Float
from torch import Tensor

__all__ = ["Plan"]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Forcing weights and goal of movements, before g.

    ``start`` is there where goal − start scales the forcing term; ``phase`` at frame 0, in rad,
    and ``tempo``, the log of the speed over the usual one, where movements are rhythmic.
    """

    w: Float[Tensor, "*sequence kernel latent"]
    goal: Float[Tensor, "*sequence latent"]
    start: Float[Tensor, "*sequence latent"] | None = None
    phase: Float[Tensor, "*sequence"] | None = None
    tempo: Float[Tensor, "*sequence"] | None = None

    @classmethod
    def of(cls, drawn: dict[str, Tensor]) -> Self:
        """The plan among the draws of all sites."""
        return cls(**{f.name: drawn[f.name] for f in fields(cls) if f.name in drawn})
