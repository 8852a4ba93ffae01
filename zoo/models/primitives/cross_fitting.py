"""Settings chosen by held-out movements, of which nothing is used before they are judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import StudentT

from zoo.models.primitives.alignment import BasisOf
from zoo.models.primitives.weight_learning import EntryNoise, Single, View
from zoo.models.primitives.weights import Basis, Weights
from zoo.movement.cross_validation import chosen_in_turn, folds_of, splits
from zoo.movement.timing import Expected, Movements

__all__ = ["Prepared", "WeightShrinkage", "choose", "inflation"]

SHARES = (0.5, 0.003, 0.01, 0.03, 0.1, 0.2, 0.35, 0.7, 0.9)
INFORMATIONS = (1.0, 0.1, 0.03, 0.01, 0.003)
LEAST = 16
JUDGED = 2
CANDIDATES = 2
FRAMES = 12


@dataclass(frozen=True)
class WeightShrinkage:
    """The share of the prior in Σ, and what part of an independent observation an entry counts."""

    share: float = SHARES[0]
    information: float = INFORMATIONS[0]


@dataclass(frozen=True)
class Prepared:
    """Some movements as they are learned from: basis, timings and all that follows."""

    basis: BasisOf
    synergies: Float[Tensor, "channel synergy"]
    offset: Float[Tensor, " channel"]
    views: list[View]
    single: Single
    expected: Expected

    def centred(self, values: Tensor, seen: Tensor) -> Tensor:
        """Values about the offset, 0 where nothing was observed."""
        return (values - self.offset) * seen


@dataclass(frozen=True)
class _HeldOut:
    """A held-out movement: its first quarter at a few timings, and some of the later frames."""

    begun: list[View]
    later: list[Basis]
    x: Float[Tensor, "time channel"]
    seen: Tensor


def choose(
    prepare: Callable[[Sequence[int]], Prepared],
    movements: Movements,
    group: Int[Tensor, " sequence"],
    share: float | None,
    information: float | None,
) -> WeightShrinkage:
    """The settings under which held-out movements are most probable after their first quarter.

    ``prepare`` makes everything anew, from the movements that stay, for each of at most four folds
    of groups: alignment, synergies, mean, noise and prior never depend on those held out. These
    are judged by the mean log marginal density of their later entries. The prior counts 16/n
    movements at least. Fewer than three groups leave the first of the settings.
    """
    least = LEAST / (LEAST + len(group.unique()) ** 2)
    shares = tuple(s for s in SHARES if s >= least) if share is None else (share,)
    informations = INFORMATIONS if information is None else (information,)
    start = WeightShrinkage(shares[0], informations[0])
    if len(shares) * len(informations) == 1 or len(group.unique()) < 3:
        return start
    folds = list(_folds(prepare, movements, group))

    def density(shrinkage: WeightShrinkage) -> float:
        return sum(float(_density(*fold, shrinkage)) for fold in folds)

    return chosen_in_turn(start, [("information", informations), ("share", shares)], density)


def inflation(groups: int) -> float:
    """√((1 + 1/n)/(1 − 1/n)): what Σ of n movements about their estimated mean is too small by."""
    n = max(2, groups)
    return float(((n + 1) / (n - 1)) ** 0.5)


def _folds(
    prepare: Callable[[Sequence[int]], Prepared], movements: Movements, group: Tensor
) -> Iterator[tuple[Prepared, int, list[_HeldOut]]]:
    for _, held in splits(folds_of(group)):
        inside, outside = (~held).nonzero()[:, 0], held.nonzero()[:, 0]
        prepared = prepare(inside.tolist())
        judged = [movements[i] for i in outside[:JUDGED].tolist()]
        left = [_held_out(prepared, values, seen) for values, seen in judged]
        yield prepared, len(group[inside].unique()), left


def _held_out(prepared: Prepared, values: Tensor, seen: Tensor) -> _HeldOut:
    """Timings are the nearest ones to the first quarter of all that are expected."""
    frames, begin = len(values), max(2, len(values) // 4)
    if begin >= frames:
        raise ValueError(f"movements of at least 3 frames are needed; one of them has {frames}")
    early = torch.arange(frames)[:, None] < begin
    x = prepared.centred(values, seen)
    template = prepared.single.weights.mean.mean(0)
    bases = [prepared.basis(frames, timing) for timing in prepared.expected.timings]
    paths = torch.stack([Basis(b.phases[:begin], b.synergies).path(template) for b in bases])
    error = ((x[:begin] - paths) * seen[:begin]).square().sum((1, 2))
    near = error.topk(min(CANDIDATES, len(bases)), largest=False).indices.tolist()
    rows, some = torch.zeros(1, dtype=torch.long), torch.linspace(begin, frames - 1, FRAMES)
    later = some.round().long().unique()
    return _HeldOut(
        [View(rows, bases[i], seen & early, (x * early)[None]) for i in near],
        [Basis(bases[i].phases[later], bases[i].synergies) for i in near],
        x[later],
        seen[later],
    )


def _density(
    prepared: Prepared, groups: int, left: list[_HeldOut], shrinkage: WeightShrinkage
) -> Tensor:
    """Mean log density of the later entries under a t of n − 1 degrees of freedom."""
    prior = prepared.single.population(shrinkage.share).scaled(inflation(groups))
    noise = EntryNoise(prepared.single.variance, shrinkage.information)
    scores = [_of_one(prior, noise, movement, groups - 1) for movement in left]
    return torch.stack(scores).sum()


def _of_one(prior: Weights, noise: EntryNoise, movement: _HeldOut, degrees: int) -> Tensor:
    evidence, density = [], []
    for begun, later in zip(movement.begun, movement.later, strict=True):
        evidence.append(begun.log_density(prior, noise)[0, 0])
        mean, variance = begun.posterior(prior, noise).moments(later)
        law = StudentT(float(degrees), mean[0], (variance + noise.variance).sqrt())
        density.append(law.log_prob(movement.x))
    weight = torch.stack(evidence).log_softmax(0)[:, None, None]
    mixed = (weight + torch.stack(density)).logsumexp(0)
    return (mixed * movement.seen).sum() / movement.seen.sum().clamp(min=1)
