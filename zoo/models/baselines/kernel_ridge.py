"""Missing and future entries by kernel ridge regression on those seen: `kernel-ridge`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn.functional import pad

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Count, Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.baselines.analogues import carried, interpolated
from zoo.models.baselines.observation import moments, normal, observe_in_turn
from zoo.models.baselines.ridge_regression import Kernel, Problem, held_out_squares, predicted
from zoo.movement.components import alike
from zoo.movement.demonstrations import movement_groups, movements_of, seen_entries
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "KernelRidge"]

KERNELS = [
    Kernel(w, r) for w, r in product((0.5, 1.0, 2.0, 4.0, 8.0), (1e-5, 1e-4, 1e-3, 0.01, 0.1))
]
EXAMPLES = 3


@settings
class Config:
    """Settings of :class:`KernelRidge`.

    A missing entry is regressed on the entries of ``context`` frames up to its own and of as many
    after it, those nearest that hold something; at most ``places`` training frames, evenly spaced,
    are kept for each regression. ``noise_floor`` is in scaled units.
    """

    context: Count = 5
    places: Annotated[int, Field(ge=10)] = 600
    noise_floor: Positive = 1e-4


@dataclass(frozen=True)
class Pattern:
    """What is asked for at a frame, and the entries it is regressed on, relative to the frame."""

    offsets: tuple[int, ...]
    seen: tuple[tuple[bool, ...], ...]
    asked: tuple[bool, ...]

    @classmethod
    def at(cls, frame: int, mask: Bool[Tensor, "time channel"], context: int) -> Pattern:
        """The nearest ``context`` frames that hold something, up to ``frame`` and after it."""
        some = mask.any(1).nonzero()[:, 0].tolist()
        near = [f for f in some if f <= frame][-context:] + [f for f in some if f > frame][:context]
        rows = tuple(tuple(row) for row in mask[near].tolist())
        return cls(tuple(f - frame for f in near), rows, tuple((~mask[frame]).tolist()))

    @property
    def reach(self) -> tuple[int, int]:
        """Frames needed before and after."""
        return -min(0, *self.offsets, 0), max(0, *self.offsets, 0)

    def inputs(self, values: Tensor, row: Tensor, frame: Tensor) -> Float[Tensor, "place feature"]:
        """The entries observed around frames of movements."""
        near = values[row[:, None], frame[:, None] + torch.tensor(self.offsets, dtype=torch.long)]
        return near[:, torch.tensor(self.seen, dtype=torch.bool).view(near.shape[1:])]

    def line(self) -> Float[Tensor, "feature target"]:
        """The map from entries observed to a line through each channel's nearest two, or one."""
        places = [(i, c) for i, row in enumerate(self.seen) for c, s in enumerate(row) if s]
        asked = [c for c, a in enumerate(self.asked) if a]
        matrix = torch.zeros(len(places), len(asked), dtype=torch.float64)
        for j, channel in enumerate(asked):
            own = [(self.offsets[i], k) for k, (i, c) in enumerate(places) if c == channel]
            ends = [max((o for o in own if o[0] < 0), default=None)]
            ends += [min((o for o in own if o[0] > 0), default=None)]
            known = [e for e in ends if e is not None]
            span = sum(abs(o) for o, _ in known)
            for o, k in known:
                matrix[k, j] = 1.0 if len(known) == 1 else 1 - abs(o) / span
        return matrix


class KernelRidge(nn.Module):
    """Entries that are missing or still to come are regressed on the entries observed around them.

    x_tc ~ N(b_tc + m_c + k(u_t)ᵀ(K + λI)⁻¹(Y − B − m), s_tc²),   k(u, u′) = exp(−‖u − u′‖²/(2ℓ²))

    u_t holds the entries observed in the frames nearest to t; Y and K come from all places of the
    training movements, with the same entries hidden. b_tc is 0, or a line in time through the
    channel's own nearest entries. Each frame of a gap or a forecast has a regression of its own, so
    that errors do not feed on themselves. ℓ, λ and b are those with the least squared error of
    held-out training movements, windows of one movement together, over three of the frames asked
    for; s_tc is the root mean square of these errors. Saunders, Gammerman & Vovk, *Ridge regression
    learning algorithm in dual variables* (1998); errors of held-out groups in closed form from
    (K + λI)⁻¹. It is a baseline, not in the thesis, and it has no guide: there is no latent
    variable.

    Observed entries are returned as they are. Missing training entries are interpolated in time;
    errors leave them out. Bands have the same width wherever a movement lies, and noise is
    independent from frame to frame: joint draws are rough. It asks for training movements that are
    as long as the gap with its context, and solves its regressions when it is asked. The generative
    program scores a movement one step at a time.

    Defaults: 5 frames of context on either side, 600 places; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    memory: Tensor
    seen: Tensor
    lengths: Tensor
    group: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        self.register_buffer("memory", torch.empty(0, dtype=self.dtype))
        self.register_buffer("seen", torch.empty(0, dtype=torch.bool))
        for name in ("lengths", "group"):
            self.register_buffer(name, torch.empty(0, dtype=torch.long))

    def condition(self, data: Sequences | Pairs) -> None:
        """Keep the movements."""
        movements = movements_of("kernel-ridge", data, self.dtype)
        group = movement_groups(movements)
        if len(group.unique()) < 2:
            raise ValueError("kernel-ridge needs at least 2 movements to fit its errors; got 1")
        mean, _, _ = moments(movements.values.flatten(0, 1), movements.mask.flatten(0, 1), 0)
        self.memory = interpolated(movements.values, movements.mask, mean)
        self.seen, self.lengths, self.group = movements.mask, movements.lengths, group

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: every frame from the frames before it."""
        check_fitted("kernel-ridge", self.memory)
        time = torch.arange(batch.values.shape[1])[:, None].expand(batch.values.shape[1:])
        patterns = [Pattern.at(t, time < t, self.config.context) for t in range(len(time))]
        chosen = self._chosen(dict.fromkeys(patterns))

        def step(values: Tensor, seen: Tensor, frames: range) -> TorchDistribution:
            x = torch.stack([carried(v, s) for v, s in zip(values, seen, strict=True)])
            asked: dict[Pattern, list[int]] = {}
            for t in frames:
                asked.setdefault(patterns[t], []).append(t)
            empty = torch.zeros_like(x), torch.zeros_like(x[0])
            mean, noise = self._regressed(asked, x, *empty, chosen)
            deviation = noise.clamp(min=self.config.noise_floor).expand_as(mean)
            return normal(mean[:, frames], deviation[:, frames], seen[:, frames])

        return observe_in_turn(batch, step)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Every frame to come from the last frames observed."""
        known = batch.values.shape[1]
        widen = (0, 0, 0, horizon)
        values, seen = pad(batch.values, widen), pad(seen_entries(batch), widen)
        return self._filled(values, seen, range(known, known + horizon))

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The missing entries from those seen around them; observed entries as they are."""
        return self._filled(batch.values, seen_entries(batch), range(batch.values.shape[1]))

    def _filled(self, values: Tensor, seen: Tensor, frames: range) -> Predictive:
        check_fitted("kernel-ridge", self.memory)
        mean, noise = values.clone(), torch.full_like(values, self.config.noise_floor)
        for rows, mask in alike(seen):
            asked: dict[Pattern, list[int]] = {}
            for t in (t for t in frames if not bool(mask[t].all())):
                asked.setdefault(Pattern.at(t, mask, self.config.context), []).append(t)
            known, floor = values[rows], noise[rows[0]].clone()
            mean[rows], noise[rows] = self._regressed(asked, known, known, floor)
        part = slice(frames.start, frames.stop)
        return Predictive(location=mean[None, :, part], noise=noise[None, :, part], joint=True)

    def _regressed(
        self,
        asked: Mapping[Pattern, list[int]],
        x: Tensor,
        mean: Tensor,
        noise: Tensor,
        chosen: tuple[Kernel, float] | None = None,
    ) -> tuple[Float[Tensor, "sequence time channel"], Float[Tensor, "time channel"]]:
        """``mean`` and ``noise`` with the entries asked for filled in."""
        if not asked:
            return mean, noise
        mean, noise = mean.clone(), noise.clone()
        kernel, lines = self._chosen(asked) if chosen is None else chosen
        for pattern, frames in asked.items():
            row = torch.arange(len(x)).repeat_interleave(len(frames))
            frame = torch.tensor(frames).repeat(len(x))
            u, line = pattern.inputs(x, row, frame), lines * pattern.line()
            found, error = predicted(kernel, self._problem(pattern, line), u)
            target = torch.tensor(pattern.asked).nonzero()[:, 0]
            mean[row[:, None], frame[:, None], target] = found + u @ line
            noise[frame[:, None], target] = error.clamp(min=self.config.noise_floor)
        return mean, noise

    def _chosen(self, asked: Iterable[Pattern]) -> tuple[Kernel, float]:
        """The kernel, and whether outputs are told from a line (1) or from their mean (0)."""
        patterns = list(asked)
        pick = torch.linspace(0, len(patterns) - 1, min(EXAMPLES, len(patterns))).round().long()
        total = torch.zeros(len(KERNELS), 2, dtype=self.dtype)
        for pattern in (patterns[i] for i in pick.tolist()):
            line = pattern.line()
            both = self._problem(pattern, torch.cat([0 * line, line], 1))
            total += held_out_squares(both, KERNELS).unflatten(1, (2, -1)).sum(-1)
        best = int(total.argmin())
        return KERNELS[best // 2], float(best % 2)

    def _problem(self, pattern: Pattern, line: Float[Tensor, "feature column"]) -> Problem:
        """Training places of a pattern; outputs once for every set of columns of ``line``."""
        row, frame = self._places(pattern)
        target = torch.tensor(pattern.asked).nonzero()[:, 0]
        times = line.shape[1] // len(target)
        u = pattern.inputs(self.memory, row, frame)
        y, seen = (v[row, frame][:, target].repeat(1, times) for v in (self.memory, self.seen))
        return Problem(u, y - u @ line, seen, self.group[row])

    def _places(self, pattern: Pattern) -> tuple[Tensor, Tensor]:
        """Movement and frame of all places that have the frames needed, thinned out evenly."""
        before, after = pattern.reach
        time = torch.arange(self.memory.shape[1])
        fits = (time >= before) & (time + after < self.lengths[:, None])
        row, frame = fits.nonzero().unbind(1)
        if len(self.group[row].unique()) < 2:
            raise ValueError(
                f"kernel-ridge needs two training movements of {before + after + 1} frames for "
                f"this gap or horizon; the longest has {int(self.lengths.max())}"
            )
        keep = torch.linspace(0, len(row) - 1, min(self.config.places, len(row))).round().long()
        return row[keep], frame[keep]
