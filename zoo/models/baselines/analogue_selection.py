"""How to continue training movements, chosen by cross-validation over groups of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.baselines.analogues import error_sums
from zoo.models.baselines.places import places, starts
from zoo.models.baselines.re_entry import Align, Library, Places, dips
from zoo.movement.cross_validation import splits

__all__ = ["Continuation", "HeldOutAnalogues", "Options", "continued"]


@dataclass(frozen=True)
class Continuation:
    """The last ``context`` frames are compared, and ``neighbours`` places continued."""

    context: int
    neighbours: int
    align: Align
    re_enter: bool


@dataclass(frozen=True)
class Options:
    """What is compared: every combination."""

    contexts: Sequence[int]
    neighbours: Sequence[int]
    alignments: Sequence[Align]
    re_enter: Sequence[bool]


@dataclass(frozen=True)
class HeldOutFutures:
    """Futures of the nearest places of held-out movements, and what was observed."""

    choice: Continuation
    futures: Float[Tensor, "neighbour query time channel"]
    offsets: Float[Tensor, "neighbour query channel"]
    fade: Float[Tensor, "time 1"]
    truth: Float[Tensor, "query time channel"]
    asked: Bool[Tensor, "query time channel"]


@dataclass(frozen=True)
class HeldOutAnalogues:
    """Training movements in folds, continued as one that is not in the library would be."""

    library: Library
    fold: Int[Tensor, " movement"]
    _jumps: dict[int, Places] = field(default_factory=dict, repr=False)

    def chosen(self, options: Options) -> Continuation:
        """The combination with the least squared error of forecasts, begun early and late."""
        frames = self.library.values.shape[1]
        total: dict[Continuation, float] = {}
        for k in starts(frames):
            for held in self._continued(k, options):
                futures, offsets = held.futures.cumsum(0), held.offsets.cumsum(0)
                for n in options.neighbours:
                    mean = (futures[n - 1] + held.fade * offsets[n - 1][:, None]) / n
                    error = ((mean - held.truth) * held.asked).square().sum()
                    one = replace(held.choice, neighbours=n)
                    total[one] = total.get(one, 0.0) + float(error)
        return min(total, key=lambda one: total[one])

    def errors(
        self, choice: Continuation, known: int, count: int
    ) -> Float[Tensor, "3 lead channel"]:
        """Sums of squared errors, of the neighbours' variance, and their number, by lead time.

        Of forecasts from the last ``known`` frames, at ``count`` places of every movement.
        """
        options = Options([known], [choice.neighbours], [choice.align], [choice.re_enter])
        frames, channels = self.library.values.shape[1:]
        sums = self.library.values.new_zeros(3, frames - known, channels)
        for k in places(known, frames - 1, count):
            for held in self._continued(k, options):
                near = held.futures + held.fade * held.offsets[:, :, None]
                sums[:, : frames - k] += error_sums(held.truth - near.mean(0), near, held.asked)
        return sums

    def _continued(self, known: int, options: Options) -> Iterator[HeldOutFutures]:
        """Every fold continued by the others, in every way but the number of neighbours."""
        whole, ahead = self.library, self.library.values.shape[1] - known
        for f, rows in splits(self.fold):
            others = replace(whole, allowed=whole.allowed & ~rows)
            x, mask = whole.values[rows], whole.seen[rows]
            query = x[:, :known], mask[:, :known]
            if True in options.re_enter and f not in self._jumps:
                self._jumps[f] = others.jumps()
            costs = others.costs(*query, options.contexts)
            for (c, cost), again in product(
                zip(options.contexts, costs, strict=True), options.re_enter
            ):
                start = dips(cost, max(options.neighbours))
                futures = others.at(others.onward(start, ahead, self._jumps[f] if again else None))
                for align in options.alignments:
                    yield HeldOutFutures(
                        choice=Continuation(c, len(futures), align, again),
                        futures=futures,
                        offsets=others.offset(*query, start, c, align),
                        fade=others.fade(ahead, c, align),
                        truth=x[:, known:],
                        asked=mask[:, known:],
                    )


def continued(
    library: Library,
    x: Float[Tensor, "query time channel"],
    mask: Bool[Tensor, "query time channel"],
    horizon: int,
    choice: Continuation,
) -> Float[Tensor, "neighbour query step channel"]:
    """The continuations of the nearest places."""
    context = min(choice.context, x.shape[1])
    start: Places = dips(library.costs(x, mask, [context])[0], choice.neighbours)
    path = library.onward(start, horizon, library.jumps() if choice.re_enter else None)
    offset = library.offset(x, mask, start, context, choice.align)
    return library.at(path) + library.fade(horizon, context, choice.align) * offset[:, :, None]
