"""Paths of movements whose duration is not known: a mixture over durations of path priors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from zoo.movement.components import alike
from zoo.movement.paths import Conditioned, PathPrior
from zoo.movement.timing import tempos

__all__ = ["ConditionedPaces", "Paces", "completed", "lengthened", "paced"]

DURATIONS = 48


class Draws(Protocol):
    """Paths given frames, of which joint draws can be made."""

    def sample(self, draws: int) -> Float[Tensor, "sample *batch time latent"]:
        """Joint draws of whole paths."""
        ...


@dataclass(frozen=True)
class ConditionedPaces:
    """Paths after frames were observed, for every duration, weighted by its evidence."""

    parts: list[Conditioned]
    log_prior: Float[Tensor, " duration"]

    @property
    def log_weights(self) -> Float[Tensor, "*batch duration"]:
        """Log p(τ | frames seen)."""
        evidence = torch.stack([p.log_evidence for p in self.parts], -1)
        return (self.log_prior + evidence).log_softmax(-1)

    def sample(self, draws: int) -> Float[Tensor, "sample *batch time latent"]:
        """Joint draws of whole paths, each of one duration."""
        picks = torch.distributions.Categorical(logits=self.log_weights).sample((draws,))
        found: Tensor = self.parts[0].sample(draws)
        for k, part in enumerate(self.parts[1:], 1):
            found = torch.where((picks == k)[..., None, None], part.sample(draws), found)
        return found


@dataclass(frozen=True)
class Paces:
    r"""p(z) = Σ_k p(τ_k) p(z | τ_k): a path prior for each duration that a movement may have.

    All are of the same number of frames; past the end of a short duration its movements stay with
    their attractor. Frames observed weigh the durations by Bayes' rule.
    """

    priors: list[PathPrior]
    log_prior: Float[Tensor, " duration"]

    def condition(
        self,
        seen: Float[Tensor, "*batch time latent"],
        where: Bool[Tensor, " time"],
        extra: Float[Tensor, "*batch time latent latent"] | None = None,
    ) -> ConditionedPaces:
        """p(z_{1:T}, τ | y_t, t where seen)."""
        parts = [p.condition(seen, where, extra) for p in self.priors]
        return ConditionedPaces(parts, self.log_prior)


def paced(prior: Callable[[int], PathPrior], lengths: Int[Tensor, " movement"], seen: int) -> Paces:
    """The prior of a movement that has lasted ``seen`` frames, after movements of these lengths.

    Its durations are equally likely ones of the Gaussian of the logs of those lengths, without
    those that are over already; a movement that is longer than all of them is at its end.
    """
    middle, around = tempos(lengths - 1.0, DURATIONS)
    found = (middle * around).round().long() + 1
    going = found[found >= seen] if bool((found >= seen).any()) else found.new_tensor([seen])
    each, counts = going.unique(return_counts=True)
    return Paces([prior(n) for n in each.tolist()], counts.double().log())


def lengthened(shape: Sequence[float], beyond: float) -> list[float]:
    """h, λ and ν of paths that go on ``beyond`` their end, by a share of their length.

    Residuals end with the movement; the process goes on.

    >>> lengthened([0.3, 0.1, 0.5], 0.2)
    [0.3, 0.1, 0.6]
    """
    return [*shape[:2], *((1 + beyond) * ν for ν in shape[2:])]


def completed(
    prior: PathPrior | Paces,
    seen: Float[Tensor, "sequence seen latent"],
    where: Bool[Tensor, "sequence seen"],
    length: int,
    draws: int,
) -> Float[Tensor, "sample sequence time latent"]:
    """Joint draws of paths of ``length`` frames given their first ones, ``where`` observed."""
    beyond = length - seen.shape[1]
    paths = seen.new_empty(draws, len(seen), length, seen.shape[2])
    values = pad(seen.double(), (0, 0, 0, beyond))
    for rows, frames in alike(pad(where, (0, beyond))):
        given: Draws = prior.condition(values[rows], frames)
        paths[:, rows] = given.sample(draws).to(seen)
    return paths
