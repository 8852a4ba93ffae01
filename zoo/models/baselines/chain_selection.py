"""Lags, coupling and ridge of a linear chain by cross-validation of its roll-outs over groups."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.baselines.chains import Chain, chain, lags_up_to, sums_of_runs, unexplained
from zoo.models.baselines.places import places, starts
from zoo.movement.cross_validation import splits

__all__ = ["RIDGES", "ChainSettings", "Course", "HeldOutChains"]

RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True)
class ChainSettings:
    """A linear chain before it is fitted."""

    order: int
    jointly: bool
    ridge: float


@dataclass(frozen=True)
class Course:
    """Squared errors of held-out roll-outs and how many there are, by lead time and channel."""

    squares: Float[Tensor, "lead channel"]
    count: Float[Tensor, "lead channel"]

    def ratios(
        self, variance: Float[Tensor, "lead channel"]
    ) -> tuple[Float[Tensor, " lead"], Float[Tensor, " channel"]]:
        """Root mean square errors over standard deviations: a factor by lead, one by channel."""
        squares = self.squares / variance
        channel = squares.sum(0) / self.count.sum(0).clamp(min=1)
        channel = channel.clamp(min=torch.finfo(channel.dtype).tiny)
        lead = _smooth((squares / channel).sum(1), self.count.sum(1))
        return lead.sqrt(), channel.sqrt()


@dataclass(frozen=True)
class HeldOutChains:
    """Training movements in folds; ``values`` are without gaps, ``mask`` says what was observed."""

    values: Float[Tensor, "sequence frame channel"]
    mask: Bool[Tensor, "sequence frame channel"]
    fold: Int[Tensor, " sequence"]
    _kept: dict[tuple[tuple[int, ...], bool], Tensor] = field(default_factory=dict, repr=False)

    def sums(self, order: int, jointly: bool) -> list[Float[Tensor, "fold block _entry _entry"]]:
        """Sums of runs of every level."""
        lags = lags_up_to(order)
        return [self._level(lags[:j], jointly) for j in range(len(lags) + 1)]

    def _level(self, lags: tuple[int, ...], jointly: bool) -> Tensor:
        if (lags, jointly) not in self._kept:
            x = self.values * self.mask
            found = sums_of_runs(x, self.mask, lags, self.fold, jointly=jointly)
            self._kept[lags, jointly] = found
        return self._kept[lags, jointly]

    def runs(self, order: int, jointly: bool) -> Float[Tensor, " block"]:
        """Complete runs of ``order`` + 1 frames that are left without any one fold."""
        count = self.sums(order, jointly)[-1][..., 0, 0]
        return count.sum(0) - count.max(0).values

    def chosen(self, choices: Sequence[ChainSettings]) -> ChainSettings:
        """The choice with the least mean squared error of held-out roll-outs."""
        groups: dict[tuple[int, bool], list[float]] = {}
        for c in choices:
            groups.setdefault((c.order, c.jointly), []).append(c.ridge)
        best, least = choices[0], torch.inf
        for (order, jointly), ridges in groups.items():
            errors = self._errors(order, jointly, self.values.new_tensor(ridges))
            k = int(errors.argmin())
            if float(errors[k]) < least:
                best, least = ChainSettings(order, jointly, ridges[k]), float(errors[k])
        return best

    def fitted(self, choice: ChainSettings) -> tuple[Chain, Float[Tensor, "level channel channel"]]:
        """The chain of all movements, and the covariance of its innovations from those held out."""
        sums = self.sums(choice.order, choice.jointly)
        whole = self._chain([s.sum(0) for s in sums], choice)
        left = sum(unexplained([s[f] for s in sums], part) for f, part in self._parts(choice))
        width = self.values.shape[2]
        count = torch.stack([s.sum(0)[:, 0, 0].expand(width) for s in sums])
        return whole, left / count[:, :, None].clamp(min=1)

    def part(self, choice: ChainSettings, fold: int) -> Chain:
        """The chain without a fold."""
        return self._chain(
            [s.sum(0) - s[fold] for s in self.sums(choice.order, choice.jointly)], choice
        )

    def course(self, choice: ChainSettings, count: int) -> Course:
        """Errors by lead time of roll-outs from ``count`` places with the whole memory."""
        frames = self.values.shape[1]
        squares = self.values.new_zeros(frames - choice.order, self.values.shape[2])
        number = torch.zeros_like(squares)
        for f, part in self._parts(choice):
            for k in places(choice.order, frames - 1, count):
                error, asked = self._missed(part, f, k)
                squares[: frames - k] += error.square().sum(0)
                number[: frames - k] += asked.sum(0)
        return Course(squares, number)

    def _parts(self, choice: ChainSettings) -> Iterator[tuple[int, Chain]]:
        """Every fold with the chain of the others."""
        for f, _ in splits(self.fold):
            yield f, self.part(choice, f)

    def _chain(self, sums: list[Tensor], choice: ChainSettings) -> Chain:
        lags, ridge = lags_up_to(choice.order), self.values.new_tensor([choice.ridge])
        one = chain(sums, lags, ridge)
        return Chain(one.lags, one.intercept[0], one.coefficients[0])

    def _errors(self, order: int, jointly: bool, ridge: Tensor) -> Float[Tensor, " ridge"]:
        """Mean squared error of roll-outs that begin early and late, for every ridge."""
        frames = self.values.shape[1]
        squares, count = torch.zeros_like(ridge), 0.0
        sums = self.sums(order, jointly)
        for f, _ in splits(self.fold):
            part = chain([s.sum(0) - s[f] for s in sums], lags_up_to(order), ridge)
            for k in starts(frames):
                error, asked = self._missed(part, f, k)
                squares += error.square().flatten(1).sum(1)
                count += float(asked.sum())
        return (squares / count).nan_to_num(nan=torch.inf, posinf=torch.inf)

    def _missed(self, part: Chain, fold: int, known: int) -> tuple[Tensor, Tensor]:
        """Errors of a fold's movements after ``known`` frames, 0 where nothing was observed."""
        rows = self.fold == fold
        x, asked = self.values[rows], self.mask[rows, known:]
        error = part.rolled(x[:, :known], x.shape[1] - known) - x[:, known:]
        return error * asked, asked


def _smooth(sums: Float[Tensor, " lead"], count: Float[Tensor, " lead"]) -> Float[Tensor, " lead"]:
    """Means over the leads within a factor of 1.5 of each."""
    lead = torch.arange(1, len(sums) + 1, device=sums.device)
    low, high = (lead / 1.5).ceil().long() - 1, (lead * 1.5).long().clamp(max=len(sums))
    total, number = (torch.nn.functional.pad(v.cumsum(0), (1, 0)) for v in (sums, count))
    return (total[high] - total[low]) / (number[high] - number[low]).clamp(min=1)
