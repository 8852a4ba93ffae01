"""What belongs to a movement of a latent primitive, whatever window of it is looked at."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

from jaxtyping import Float
from torch import Tensor

__all__ = ["Latents", "Plan"]


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

    def draws(self) -> list[Plan]:
        """The plans of each draw, where the values have an axis of draws before the movements."""
        axes = {"w": 3, "goal": 2, "start": 2, "phase": 1, "tempo": 1}
        given = {name: v for name in axes if (v := getattr(self, name)) is not None}
        flat = {name: v.reshape(-1, *v.shape[v.ndim - axes[name] :]) for name, v in given.items()}
        return [
            replace(self, **dict(zip(flat, one, strict=True)))
            for one in zip(*flat.values(), strict=True)
        ]

    @classmethod
    def of(cls, drawn: dict[str, Tensor]) -> Self:
        """The plan among the draws of all sites."""
        return cls(**{f.name: drawn[f.name] for f in fields(cls) if f.name in drawn})


@dataclass(frozen=True)
class Latents:
    """What belongs to movements, in the space of z*; w is scaled by goal − start, if at all."""

    plan: Plan
    w: Float[Tensor, "sample sequence kernel latent"]
    goal: Float[Tensor, "sample sequence latent"]
    position: Float[Tensor, "sample sequence latent"]
    velocity: Float[Tensor, "sample sequence latent"]
