"""Gaussian paths of single movements, gathered into a mixture with equal weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.prediction.predictive import Deferred

__all__ = ["Components", "Draw", "Paths", "alike", "minimum_jerk", "ramp", "resample"]

Draw = Callable[[int], Tensor]


@dataclass(frozen=True)
class Paths:
    """Mean and variance of the path at every time; ``draw`` gives so many joint draws of it."""

    mean: Float[Tensor, "sequence time channel"]
    variance: Float[Tensor, "*#sequence time channel"]
    draw: Draw


@dataclass(frozen=True)
class Components:
    """Moments of every component; draws are of all in turn, or of some from first to last."""

    mean: Float[Tensor, "component sequence time channel"]
    variance: Float[Tensor, "component #sequence time channel"]
    pieces: list[tuple[int, Tensor, Tensor, Draw]] = field(default_factory=list)
    begin: int = 0

    @classmethod
    def empty(cls, count: int, like: Float[Tensor, "sequence time channel"]) -> Components:
        """Room for ``count`` components of movements shaped ``like``."""
        mean = like.new_zeros(count, *like.shape)
        return cls(mean, torch.zeros_like(mean))

    @classmethod
    def alone(cls, paths: Paths) -> Components:
        """One component, ``paths`` of all movements."""
        every = torch.ones(len(paths.mean), dtype=torch.bool)
        piece = (0, torch.arange(len(every)), every, paths.draw)
        frames, channels = paths.variance.shape[-2:]
        variance = paths.variance.reshape(1, -1, frames, channels)
        return cls(paths.mean[None], variance, [piece])

    @classmethod
    def of(cls, parts: list[Paths]) -> Components:
        """One component, the movements of ``parts`` one after the other."""
        whole = cls.empty(1, torch.cat([p.mean for p in parts]))
        for i, part in enumerate(parts):
            whole.put(torch.tensor([i]), torch.ones(1, 1, dtype=torch.bool), part)
        return whole

    def put(
        self,
        rows: Int[Tensor, " some"],
        chosen: Bool[Tensor, "component some"],
        paths: Paths,
    ) -> None:
        """Fill in ``paths`` of the movements ``rows`` where they are the component chosen."""
        variance = paths.variance.expand_as(paths.mean)
        for component, here in enumerate(chosen):
            self.mean[component, rows[here]] = paths.mean[here]
            self.variance[component, rows[here]] = variance[here]
            if bool(here.any()):
                self.pieces.append((component, rows[here], here, paths.draw))

    def after(self, frames: int) -> Components:
        """Without the first ``frames`` frames."""
        mean, variance = self.mean[:, :, frames:], self.variance[:, :, frames:]
        return replace(self, mean=mean, variance=variance, begin=self.begin + frames)

    def draws(self, count: int) -> Deferred:
        """Joint draws of the mixture, made when they are asked for."""

        def make() -> Tensor:
            draws = self.mean.new_zeros(count, *self.mean.shape[1:])
            owner = _owners(count, len(self.mean))
            for component, rows, here, draw in self.pieces:
                mine = (owner == component).nonzero()
                if len(mine):
                    draws[mine, rows] = draw(len(mine))[:, here, self.begin :]
            return draws

        return Deferred((count, *self.mean.shape[1:]), make)


def _owners(count: int, components: int) -> Int[Tensor, " draw"]:
    """Which component each draw is of: all in turn, or evenly spaced ones where draws are fewer."""
    if count >= components:
        return torch.arange(count) % components
    return (torch.arange(count) * components + components // 2) // count


def resample(
    log_weight: Float[Tensor, "hypothesis sequence"], count: int
) -> Int[Tensor, "count sequence"]:
    """Indices of ``count`` equally weighted hypotheses; the likeliest one alone if ``count`` is 1.

    >>> resample(torch.tensor([[0.0], [0.0], [-50.0]]), 4).flatten().tolist()
    [0, 0, 1, 1]
    """
    if count == 1:
        return log_weight.argmax(0, keepdim=True)
    below = log_weight.softmax(0).cumsum(0).T.contiguous()
    points = (torch.arange(count, dtype=below.dtype, device=below.device) + 0.5) / count
    found = torch.searchsorted(below, points.expand(len(below), -1).contiguous())
    return found.clamp(max=len(log_weight) - 1).T


def alike(seen: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows of the movements that have the same entries, with these."""
    if bool((seen == seen[:1]).all()):
        yield torch.arange(len(seen)), seen[0]
        return
    patterns, index = torch.unique(seen.flatten(1), dim=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        yield (index == i).nonzero()[:, 0], pattern.view(seen.shape[1:])


def ramp(frames: int, start: int, steps: int) -> Float[Tensor, " step"]:
    """Share of the movement switched to: 0 until ``start``, 1 from ``start + steps``."""
    if start < 0 or steps < 1 or start + steps > frames - 1:
        raise ValueError(
            f"switching from frame {start} over {steps} frames does not fit in {frames} frames"
        )
    time = torch.arange(frames - 1, dtype=torch.float64)
    return ((time - start) / steps).clamp(0, 1)


def minimum_jerk(frames: int, start: int = 0) -> Float[Tensor, " frame"]:
    """A way from 0 at frame ``start`` to 1 at the last, at rest at both ends.

    Flash & Hogan, *The coordination of arm movements*, Journal of Neuroscience 5 (1985).

    >>> minimum_jerk(5).tolist()
    [0.0, 0.103515625, 0.5, 0.896484375, 1.0]
    """
    time = torch.arange(frames, dtype=torch.float64)
    s = ((time - start) / (frames - 1 - start)).clamp(0, 1)
    way: Tensor = s**3 * (10 - 15 * s + 6 * s**2)
    return way
