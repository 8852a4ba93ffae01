"""The most similar places of the training movements are continued: `nearest-neighbour`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Count, Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.baselines.analogue_selection import (
    Continuation,
    HeldOutAnalogues,
    Options,
    continued,
)
from zoo.models.baselines.analogues import carried, error_sums, interpolated
from zoo.models.baselines.gaps import Gaps
from zoo.models.baselines.observation import moments, normal, observe_in_turn
from zoo.models.baselines.places import places
from zoo.models.baselines.re_entry import ALIGNMENTS, Align, Library
from zoo.movement.cross_validation import folds_of
from zoo.movement.demonstrations import movement_groups, movements_of, seen_entries
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "NearestNeighbour"]

CONTEXTS = (1, 3, 10, 30)
NEIGHBOURS = (1, 2, 4, 8, 16)
DECAYS = (2.0, 6.0, 20.0)


@settings
class Config:
    """Settings of :class:`NearestNeighbour`; None is chosen by cross-validation.

    The last ``context`` frames are compared, ``neighbours`` places are kept. ``align`` shifts what
    they say to meet what was observed: ``none``, by the ``last`` frame, by the ``mean`` over the
    context, or by the last frame, ``fading`` with the lead time; a gap is shifted or not.
    ``re_enter`` goes on from the most similar place where a movement ends, else its last frame is
    held. Imputation weighs frames by exp(−distance/``decay``), in frames. ``leave_out`` is the
    group column that is kept whole by cross-validation (None: single movements), which forecasts
    from ``positions`` places of every movement to fit the bands. ``noise_floor`` is in scaled
    units.
    """

    neighbours: Count | None = None
    context: Count | None = None
    align: Align | None = None
    re_enter: bool | None = None
    decay: Positive | None = None
    leave_out: str | None = None
    positions: Count = 8
    noise_floor: Positive = 1e-4


class NearestNeighbour(nn.Module):
    """What came next wherever the training movements looked most alike is what comes next.

    x_{k+h} ~ 1/K Σ_{i=1}^K N(y_i(t_i + h) + e^{−h/τ} (x_k − y_i(t_i)), s_h²)

    y_i(t_i) is a place of a training movement, any frame of it, whose last frames are nearest to
    the last frames observed (mean squared distance over the entries observed in both, a local
    minimum along the movement); the K nearest places are kept. Where a movement ends, it goes on
    from the place most like its end. K, the number of frames compared, the shift (none, kept, or
    fading with τ) and whether a movement is entered again are those with the least squared error
    of forecasts of held-out training movements, over at most four folds of whole movements. s_h
    makes the mixture's variance that of the errors of the same forecasts (and is at least half of
    their root mean square); it is fitted for fewer observed frames, too.

    Imputation compares frame by frame, near frames counting most, and takes the missing entries
    from the nearest places, shifted by what they lie below the frames observed if that helps: its
    settings and its s are fitted when it is asked, on held-out training movements with the same
    entries hidden. Fix & Hodges (1951); Lorenz, *Atmospheric predictability as revealed by
    naturally occurring analogues*, J. Atmos. Sci. 26 (1969).

    Missing entries of the training movements are interpolated in time where a neighbour is
    continued; distances and errors leave them out. Noise is independent from frame to frame.
    The generative program scores a movement one step at a time by the mixture's moments. It is a
    baseline, not in the thesis, and it has no guide: there is no latent variable.

    Defaults: all chosen; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    memory: Tensor
    seen: Tensor
    lengths: Tensor
    group: Tensor
    noise: Tensor
    contexts: Tensor
    chosen: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        for name in ("memory", "noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        for name in ("lengths", "group", "contexts", "chosen"):
            self.register_buffer(name, torch.empty(0, dtype=torch.long))
        self.register_buffer("seen", torch.empty(0, dtype=torch.bool))

    def condition(self, data: Sequences | Pairs) -> None:
        """Keep the movements, choose how to continue them, and fit s_h on those held out."""
        movements = movements_of("nearest-neighbour", data, self.dtype)
        shortest, longest = 1 + (self.config.context or 1), int(movements.lengths.max())
        if longest < shortest:
            raise ValueError(
                f"nearest-neighbour needs movements of at least {shortest} frames; "
                f"the longest has {longest}"
            )
        self.seen, self.lengths = movements.mask, movements.lengths
        self.group = self._groups(movements)
        mean, _, _ = moments(movements.values.flatten(0, 1), self.seen.flatten(0, 1), 0)
        self.memory = interpolated(movements.values, self.seen, mean)
        held_out = HeldOutAnalogues(self.library, folds_of(self.group))
        choice = held_out.chosen(self._options())
        kind = ALIGNMENTS.index(choice.align)
        kept = [choice.context, choice.neighbours, kind, int(choice.re_enter)]
        self.chosen = self.lengths.new_tensor(kept)
        levels = [c for c in CONTEXTS if c < choice.context] + [choice.context]
        self.contexts = self.lengths.new_tensor(levels)
        self.noise = torch.stack([self._forecast_noise(held_out, choice, c) for c in levels])

    @property
    def library(self) -> Library:
        """The training movements."""
        check_fitted("nearest-neighbour", self.memory)
        everybody = torch.ones_like(self.lengths, dtype=torch.bool)
        return Library(self.memory, self.seen, self.lengths, everybody)

    @property
    def choice(self) -> Continuation:
        """How they are continued."""
        check_fitted("nearest-neighbour", self.noise)
        context, neighbours, align, again = self.chosen.tolist()
        return Continuation(context, neighbours, ALIGNMENTS[align], bool(again))

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every frame after the first from the frames before it."""
        check_fitted("nearest-neighbour", self.noise)
        return observe_in_turn(batch, self._step)

    def _step(self, x: Tensor, seen: Tensor, frames: range) -> TorchDistribution:
        """``frames`` given the frames before them."""
        mean, deviation, _ = moments(self.memory.flatten(0, 1), self.seen.flatten(0, 1), 0)
        first = mean.expand_as(x[:, 0]), deviation.square().expand_as(x[:, 0])
        steps = [first if t == 0 else self._next(x[:, :t], seen[:, :t]) for t in frames]
        location, variance = (torch.stack(each, 1) for each in zip(*steps, strict=True))
        deviation = variance.sqrt().clamp(min=self.config.noise_floor)
        return normal(location, deviation, seen[:, frames])

    def _next(self, x: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        step = continued(self.library, x, seen, 1, self.choice)[:, :, 0]
        noise = self._noise(x.shape[1], 1)[0]
        return step.mean(0), step.var(0, unbiased=False) + noise.square()

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The continuations of the nearest places, one component each."""
        mask = seen_entries(batch)
        location = continued(self.library, batch.values, mask, horizon, self.choice)
        noise = self._noise(batch.values.shape[1], horizon)
        return Predictive(location=location, noise=noise, joint=True)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The frames of the nearest places, one component each."""
        check_fitted("nearest-neighbour", self.noise)
        mask = seen_entries(batch)
        location, noise = [batch.values[:0]] * len(mask), torch.zeros_like(batch.values[:, :1])
        patterns, which = torch.unique(mask, dim=0, return_inverse=True)
        for p, pattern in enumerate(patterns):
            gaps, neighbours, align, s = self._tuned(pattern, max(2, 20 // len(patterns)))
            for i in (which == p).nonzero()[:, 0].tolist():
                everybody = torch.ones_like(self.lengths, dtype=torch.bool)
                filled = gaps.filled(batch.values[i], mask[i], everybody, neighbours)
                location[i], noise[i] = filled[int(align)], s
        most = max(map(len, location))
        every = [part[torch.arange(most, device=mask.device) % len(part)] for part in location]
        return Predictive(location=torch.stack(every, 1), noise=noise, joint=True)

    def _groups(self, data: Sequences) -> Int[Tensor, " movement"]:
        column = self.config.leave_out
        if column is not None and column not in data.groups:
            raise ValueError(f"no group column {column!r}; there are {', '.join(data.groups)}")
        labels = movement_groups(data).tolist() if column is None else list(data.groups[column])
        order = list(dict.fromkeys(labels))
        if len(order) < 2:
            raise ValueError(
                "nearest-neighbour needs at least 2 "
                f"{'movements' if column is None else column + ' groups'}, to choose its settings "
                "and bands on those held out; got 1"
            )
        return self.lengths.new_tensor([order.index(label) for label in labels])

    def _options(self) -> Options:
        """What the settings leave open and the movements allow."""
        config, half = self.config, int(self.lengths.max()) // 2
        contexts = [c for c in CONTEXTS if c <= max(1, half)]
        return Options(
            contexts=contexts if config.context is None else [config.context],
            neighbours=NEIGHBOURS if config.neighbours is None else [config.neighbours],
            alignments=ALIGNMENTS if config.align is None else [config.align],
            re_enter=(True, False) if config.re_enter is None else [config.re_enter],
        )

    def _forecast_noise(
        self, held_out: HeldOutAnalogues, choice: Continuation, known: int
    ) -> Float[Tensor, "lead channel"]:
        """s_h after ``known`` frames, as many leads for all; unknown ones as the last known."""
        wrong, variance, count = held_out.errors(choice, known, self.config.positions)
        number = count.clamp(min=1)
        s = carried(self._unexplained(wrong / number, variance / number), count > 0)
        index = torch.arange(self.memory.shape[1] - 1, device=s.device).clamp(max=len(s) - 1)
        longer: Tensor = s[index]
        return longer

    def _noise(self, known: int, horizon: int) -> Float[Tensor, "lead channel"]:
        """s_h of a forecast from ``known`` frames."""
        level = int((self.contexts <= known).sum().clamp(min=1)) - 1
        lead = torch.arange(horizon, device=self.noise.device)
        noise: Tensor = self.noise[level, lead.clamp(max=self.noise.shape[1] - 1)]
        return noise

    def _tuned(
        self, pattern: Bool[Tensor, "time channel"], movements: int
    ) -> tuple[Gaps, int, bool, Float[Tensor, " channel"]]:
        """Decay, neighbours, shift and s where held-out movements miss what ``pattern`` misses."""
        config = self.config
        decays = DECAYS if config.decay is None else (config.decay,)
        sizes: Sequence[int] = NEIGHBOURS if config.neighbours is None else (config.neighbours,)
        shifts = [False, True] if config.align is None else [config.align != "none"]
        every = [Gaps(self.library, decay) for decay in decays]
        sums = torch.stack([self._left_out(gaps, pattern, movements, sizes) for gaps in every])
        gappy = ~pattern.all(0)
        error = sums[..., 0, :][..., gappy].sum(-1)[:, [int(s) for s in shifts]]
        d, a, n = (int(v) for v in torch.unravel_index(error.argmin(), error.shape))
        wrong, variance, count = sums[d, int(shifts[a]), n]
        s = self._unexplained(wrong / count.clamp(min=1), variance / count.clamp(min=1))
        return every[d], sizes[n], shifts[a], s

    def _left_out(
        self, gaps: Gaps, pattern: Tensor, movements: int, sizes: Sequence[int]
    ) -> Float[Tensor, "shift size 3 channel"]:
        last = len(self.memory) - 1
        rows = places(0, last, min(movements, last + 1))
        every: Tensor = torch.stack([self._filled(gaps, i, pattern, sizes) for i in rows]).sum(0)
        return every

    def _filled(
        self, gaps: Gaps, i: int, pattern: Tensor, sizes: Sequence[int]
    ) -> Float[Tensor, "shift size 3 channel"]:
        """Error sums of a movement filled in by those of other groups."""
        frames = min(len(pattern), int(self.lengths[i]))
        x, seen, pattern = self.memory[i, :frames], self.seen[i, :frames], pattern[:frames]
        asked = seen & (~pattern | pattern.all(0))
        both = gaps.filled(x, seen & pattern, self.group != self.group[i], max(sizes))
        sums = [error_sums(x - y[:n].mean(0), y[:n], asked) for y in both for n in sizes]
        each: Tensor = torch.stack(sums).unflatten(0, (2, len(sizes)))
        return each

    def _unexplained(self, error: Tensor, between: Tensor) -> Tensor:
        """s from the mean squared error and the neighbours' variance, at least half the error."""
        variance = torch.maximum(error - between, error / 4)
        return variance.clamp(min=self.config.noise_floor**2).sqrt()
