"""The shape of a mixture with a kernel around every known movement, tuned on held-out ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.movement.cross_validation import chosen_in_turn

__all__ = ["KernelMixture"]

LEAST = 3


@dataclass(frozen=True, kw_only=True)
class KernelMixture:
    """``bandwidth`` h, ``shrinkage`` λ and ``process`` ν of a mixture over movements.

    Means are drawn to their mean by √(1 − h²), and kernels have h² of the covariance over movements
    (West, *Approximating posterior distributions by mixtures*, 1993), of which independent
    parameters have the share λ; ν is what counts of the stationary residuals. h = 1 is one
    Gaussian, a small h a kernel estimate that stays near the movements known.
    """

    bandwidth: float = 0.3
    shrinkage: float = 0.1
    process: float = 1.0

    grids: ClassVar[Mapping[str, Sequence[float]]]
    judged: ClassVar[int]

    @property
    def shape(self) -> tuple[float, float, float]:
        """h, λ and ν."""
        return self.bandwidth, self.shrinkage, self.process

    def shaped(self, shape: Sequence[float]) -> Self:
        """With h, λ and ν, or as it is where these are not known."""
        if not shape:
            return self
        bandwidth, shrinkage, process = shape
        return replace(self, bandwidth=bandwidth, shrinkage=shrinkage, process=process)

    def centred(self, values: Float[Tensor, "movement *rest"]) -> Float[Tensor, "movement *rest"]:
        """Means of the components around movements' ``values``."""
        centre = values.mean(0)
        return centre + math.sqrt(1 - self.bandwidth**2) * (values - centre)

    def tuned_on(
        self,
        movements: int,
        seen: Sequence[int],
        without: Callable[[int], Self],
        density: Callable[[Self, int, int], Float[Tensor, "time channel"]],
    ) -> Self:
        """The h, λ and ν under which the futures of held-out movements are most probable.

        ``without`` is the mixture of all movements but one, and ``density`` under it that of the
        movement's frames given the first ``seen`` ones. The three are chosen in turn. Fewer than
        three movements leave too little to compare: the defaults stay.
        """
        if movements < LEAST:
            return self
        rows = torch.linspace(0, movements - 1, min(movements, self.judged)).round().long()
        others = {i: without(i) for i in rows.tolist()}

        def score(mixture: Self) -> float:
            total = 0.0
            for i, rest in others.items():
                shaped = rest.shaped(mixture.shape)
                total += sum(float(density(shaped, i, k)[k:].mean()) for k in seen)
            return total

        grids = [*self.grids.items(), ("bandwidth", self.grids["bandwidth"])]
        return chosen_in_turn(self, grids, score)
