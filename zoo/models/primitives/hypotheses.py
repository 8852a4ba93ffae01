"""Timing and scale of a movement as discrete unknowns, with its parameters exact given these."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.movement.components import resample
from zoo.movement.timing import Timing

__all__ = ["Alike", "Drawn", "Hypotheses", "HypothesisPosterior"]

Drawn = Mapping[str, Tensor]


@dataclass(frozen=True)
class Alike:
    """Movements with the same entries observed."""

    rows: Int[Tensor, " some"]


G = TypeVar("G", bound=Alike)


@dataclass(frozen=True)
class Hypotheses(ABC, Generic[G]):
    """Equally likely timings, and scales s of the deviations from the mean movement."""

    timings: Sequence[Timing]
    scales: Float[Tensor, " scale"]

    @abstractmethod
    def observed_alike(
        self,
        values: Float[Tensor, "sequence time channel"],
        seen: Bool[Tensor, "sequence time channel"],
    ) -> Iterator[G]:
        """What the movements say of their parameters, of those observed alike together."""
        ...

    @abstractmethod
    def evidence(self, part: G) -> Float[Tensor, "timing scale sequence"]:
        """Log p(x_observed) under every timing and scale."""
        ...

    def at_most(self, components: int) -> int:
        """So many components, or one where there is one hypothesis."""
        return 1 if len(self.timings) * len(self.scales) == 1 else components

    def resampled(self, part: G, count: int) -> Iterator[tuple[int, int, Tensor, Tensor]]:
        """``count`` components of each movement: timing, scale, movements, components of these."""
        picks = 0 * part.rows[None]
        if self.at_most(2) > 1:
            picks = resample(self.evidence(part).flatten(0, 1), count)
        for i in picks.unique().tolist():
            some = (picks == i).any(0)
            yield *divmod(i, len(self.scales)), some, picks[:, some] == i


class HypothesisPosterior(Generic[G]):
    """p(timing | x) and p(scale | timing, x) of some movements."""

    def __init__(self, given: Hypotheses[G], x: Tensor, seen: Tensor) -> None:
        """Weigh every timing and scale of every movement."""
        self.parts = list(given.observed_alike(x, seen))
        self.evidence = x.new_empty(len(given.timings), len(given.scales), len(x))
        for part in self.parts:
            self.evidence[..., part.rows] = given.evidence(part)

    def log_evidence(self) -> Float[Tensor, " sequence"]:
        """Log p(x_observed) of every movement, all unknowns integrated out."""
        each = self.evidence.flatten(0, 1)
        total: Tensor = each.logsumexp(0) - math.log(len(each))
        return total

    def timing(self, _: Drawn) -> dist.TorchDistribution:
        """p(timing | x) of every movement."""
        return dist.Categorical(logits=self.evidence.logsumexp(1).mT)

    def scale(self, drawn: Drawn) -> dist.TorchDistribution:
        """p(scale | timing, x) of every movement."""
        timing = drawn["timing"]
        rows = torch.arange(self.evidence.shape[2], device=timing.device).expand_as(timing)
        return dist.Categorical(logits=self.evidence[timing, :, rows])
