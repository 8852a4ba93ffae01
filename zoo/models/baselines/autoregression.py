"""A linear autoregression chosen by cross-validation of its forecasts: `ar`."""

from __future__ import annotations

from typing import ClassVar, Literal

import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from zoo.contract.readiness import check_fitted
from zoo.contract.settings import Count, Positive, Share, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.baselines.analogues import interpolated
from zoo.models.baselines.banded import conditional, precision
from zoo.models.baselines.chain_selection import RIDGES, ChainSettings, HeldOutChains
from zoo.models.baselines.chains import Chain
from zoo.models.baselines.observation import moments, observe_in_turn
from zoo.models.baselines.places import places
from zoo.movement.components import alike
from zoo.movement.cross_validation import folds_of
from zoo.movement.demonstrations import movement_groups, movements_of, seen_entries
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Autoregression", "Config"]

ORDERS = (1, 2, 4, 8, 16)
STATE = 1600
RUNS = 5


@settings
class Config:
    """Settings of :class:`Autoregression`; None is chosen by cross-validation.

    ``order`` is the longest lag, in frames; ``coupling`` says whether channels follow from their
    own past alone (``channel``) or from that of all (``vector``); ``ridge`` is the penalty on A
    for each training frame, ``noise_floor`` the least innovation, both in scaled units. Forecasts
    from ``places`` of every held-out movement give the bands. ``shrinkage`` is the share of Q that
    is taken from its diagonal alone.
    """

    order: Count | None = None
    coupling: Literal["channel", "vector"] | None = None
    ridge: Positive | None = None
    places: Count = 8
    shrinkage: Share = 0.1
    noise_floor: Positive = 1e-4


class Autoregression(nn.Module):
    """Every frame is a linear function of frames before it, at lags that double.

    x_t ~ N(c_j + Σ_{i=1}^j A_{ji} x_{t−l_i}, Q_j),  l = 1, 2, 4, …, p

    j counts the lags that reach back from t: the memory grows over the first p frames, so that
    three observed frames are answered as well as a hundred. c_j and A_j by ridge regression over
    all training frames whose j predecessors were observed, with the past of the same channel
    (``coupling="channel"``) or of all (``vector``). p, coupling and ridge are those with the least
    squared error of forecasts of held-out training movements up to their ends, over at most four
    folds of whole movements (the windows of one movement stay together; a single movement is cut
    in two). Q_j is the covariance of held-out innovations, shrunk towards its diagonal. A
    spectral radius above 1 is shrunk to 1. Lütkepohl, *New Introduction to Multiple Time Series
    Analysis* (2005), ch. 3; Hoerl & Kennard, *Ridge regression*, Technometrics 12 (1970).

    A movement is one Gaussian with a banded precision. Conditioning it on what was observed gives
    forecast and imputation with their exact moments and joint draws, missing entries included.
    The bands are these standard deviations times the ratio of held-out errors to them: of forecasts
    by lead time and channel, of imputations by channel, from held-out training movements with the
    same entries hidden. There is no observation noise: observed entries are returned as they are.
    The program leaves out frames with a missing entry, or with one in their past.

    It is a baseline, not in the thesis, and it has no guide: there is no latent variable.

    Defaults: all chosen; p of 1, 2, 4, 8 and 16, as far as p times the channels is at most 1,600;
    data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    lags: Tensor
    intercept: Tensor
    coefficients: Tensor
    innovation: Tensor
    lead_ratio: Tensor
    channel_ratio: Tensor
    memory: Tensor
    seen: Tensor
    fold: Tensor
    jointly: Tensor
    ridge: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        fitted = ("intercept", "coefficients", "innovation", "lead_ratio", "channel_ratio")
        for name in (*fitted, "memory", "ridge"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        for name in ("lags", "fold"):
            self.register_buffer(name, torch.empty(0, dtype=torch.long))
        for name in ("seen", "jointly"):
            self.register_buffer(name, torch.empty(0, dtype=torch.bool))

    def condition(self, data: Sequences | Pairs) -> None:
        """Choose and fit the chain, and measure its forecasts.

        ``intercept`` becomes (level, channel), ``coefficients`` (level, lag, channel, channel),
        ``innovation`` Q (level, channel, channel).
        """
        held_out = self._held_out(movements_of("ar", data, self.dtype))
        self.memory, self.seen, self.fold = held_out.values, held_out.mask, held_out.fold
        choice = held_out.chosen(self._choices(held_out, data.channels))
        self.jointly = torch.tensor([choice.jointly], device=self.seen.device)
        self.ridge = self.memory.new_tensor([choice.ridge])
        fitted, innovation = held_out.fitted(choice)
        fitted = fitted.stable()
        self.lags = torch.tensor(fitted.lags, device=self.fold.device)
        self.intercept, self.coefficients = fitted.intercept, fitted.coefficients
        self.innovation = self._shrunk(innovation)
        course = held_out.course(choice, self.config.places)
        self.lead_ratio, self.channel_ratio = course.ratios(self._variance(len(course.count)))

    def _shrunk(self, innovation: Tensor) -> Float[Tensor, "level channel channel"]:
        share, own = self.config.shrinkage, innovation.diagonal(dim1=1, dim2=2)
        floor = self.config.noise_floor**2
        return (1 - share) * innovation + torch.diag_embed(share * own + floor)

    @property
    def chain(self) -> Chain:
        """The fitted chain."""
        check_fitted("ar", self.innovation)
        return Chain(tuple(self.lags.tolist()), self.intercept, self.coefficients)

    def forward(self, batch: Batch) -> Tensor:
        """The generative program, without frames that miss an entry or whose past does."""
        chain, roots = self.chain, torch.linalg.cholesky(self.innovation)

        def step(x: Tensor, observed: Tensor, frames: range) -> TorchDistribution:
            complete = observed.all(-1)
            whole = complete.clone()
            for lag in chain.lags:
                whole[:, lag:] &= complete[:, :-lag]
            level = torch.tensor([chain.level(t) for t in frames], device=x.device)
            mean = chain.predicted(x)[:, frames]
            now = dist.MultivariateNormal(mean, scale_tril=roots[level])
            masked: TorchDistribution = now.mask(whole[:, frames])
            return masked

        return observe_in_turn(batch, step)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """p(x_{k+1:k+horizon} | x_{1:k}), its standard deviations times the held-out ratios."""
        longest, mask = self.chain.lags[-1], seen_entries(batch)
        if mask.shape[1] >= longest and bool(mask[:, -longest:].all()):
            mean, std, paths = self._ahead(batch.values[:, -longest:], horizon, draws)
        else:
            widen = (0, 0, 0, horizon)
            values, known = (nn.functional.pad(v, widen) for v in (batch.values, mask))
            found = self._conditional(values, known, draws)
            mean, std, paths = (part[..., -horizon:, :] for part in found)
        lead = torch.arange(horizon, device=mean.device).clamp(max=len(self.lead_ratio) - 1)
        ratio = self.lead_ratio[lead, None] * self.channel_ratio
        wider = mean + ratio * (paths - mean)
        return Predictive(location=mean[None], epistemic=ratio * std, draws=wider)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x_missing | x_observed), exact; observed entries are returned as they are."""
        mask = seen_entries(batch)
        mean, std, paths = self._conditional(batch.values, mask, draws)
        patterns, which = torch.unique(mask, dim=0, return_inverse=True)
        count = max(2, self.config.places // len(patterns))
        ratio = torch.stack([self._imputation_ratio(p, count) for p in patterns])[which][:, None]
        rounding = torch.finfo(mean.dtype).eps ** 0.5
        return Predictive(
            location=mean[None],
            epistemic=(ratio * std).clamp(min=rounding),
            draws=mean + ratio * (paths - mean),
        )

    def _imputation_ratio(
        self, pattern: Bool[Tensor, "time channel"], movements: int
    ) -> Float[Tensor, " channel"]:
        """Errors over standard deviations where held-out movements miss what ``pattern`` misses."""
        held_out = HeldOutChains(self.memory, self.seen, self.fold)
        choice = ChainSettings(int(self.lags[-1]), bool(self.jointly), float(self.ridge))
        frames = min(len(pattern), self.memory.shape[1])
        squares = [torch.zeros_like(self.channel_ratio), torch.zeros_like(self.channel_ratio)]
        last = len(self.memory) - 1
        for i in places(0, last, min(movements, last + 1)):
            Λ = precision(held_out.part(choice, int(self.fold[i])), self.innovation, frames)
            x, known = self.memory[i, :frames], self.seen[i, :frames]
            mean, std, _ = conditional(Λ, x[None], pattern[:frames] & known, 0)
            asked = known & ~pattern[:frames]
            ratio = (mean[0] - x) / std.clamp(min=torch.finfo(x.dtype).tiny)
            squares[0] += (ratio.square() * asked).sum(0)
            squares[1] += asked.sum(0)
        known = squares[1] > 0
        return torch.where(known, squares[0] / squares[1].clamp(min=1), 1.0).sqrt()

    def _held_out(self, data: Sequences) -> HeldOutChains:
        """Movements in folds; one alone is cut in two."""
        mean, _, _ = moments(data.values.flatten(0, 1), data.mask.flatten(0, 1), 0)
        values, mask, group = (
            interpolated(data.values, data.mask, mean),
            data.mask,
            movement_groups(data),
        )
        longest, alone = int(data.lengths.max()), len(group.unique()) < 2
        if longest < (6 if alone else 3):
            raise ValueError(
                "ar needs movements of at least 3 frames (6 where there is one alone); "
                f"the longest has {longest}"
            )
        if alone:
            half = longest // 2
            values, mask = (torch.cat([v[:, :half], v[:, half : 2 * half]]) for v in (values, mask))
            group = torch.arange(2, device=values.device).repeat_interleave(len(data))
        return HeldOutChains(values, mask, folds_of(group))

    def _choices(self, held_out: HeldOutChains, channels: tuple[str, ...]) -> list[ChainSettings]:
        """What the settings leave open and the data allow."""
        config, frames = self.config, held_out.values.shape[1]
        most = min((frames - 1) // 2, max(1, STATE // len(channels)))
        orders = [p for p in ORDERS if p <= most] if config.order is None else [config.order]
        couplings = ["channel", "vector"] if config.coupling is None else [config.coupling]
        ridges = RIDGES if config.ridge is None else (config.ridge,)
        pairs = [(p, c == "vector") for p in orders for c in couplings]
        able = [
            (p, j) for p, j in pairs if p < frames and bool((held_out.runs(p, j) >= RUNS).all())
        ]
        if not able:
            self._refuse(held_out, *pairs[0], channels)
        return [ChainSettings(p, j, ridge) for p, j in able for ridge in ridges]

    def _refuse(
        self, held_out: HeldOutChains, order: int, jointly: bool, channels: tuple[str, ...]
    ) -> None:
        frames = held_out.values.shape[1]
        runs = held_out.runs(order, jointly) if order < frames else held_out.values.new_zeros(1)
        worst = int(runs.argmin())
        which = f"channel {channels[worst]}" if len(runs) > 1 else "all channels together"
        raise ValueError(
            f"ar of order {order} needs {RUNS} runs of {order + 1} frames without a missing entry "
            f"outside every fold; {which} leave {int(runs[worst])}"
        )

    def _variance(self, steps: int) -> Float[Tensor, "step channel"]:
        """Of every frame after a whole memory."""
        Ψ = self.chain.responses(steps)
        return (Ψ @ self.innovation[-1] * Ψ).sum(-1).cumsum(0)

    def _ahead(self, known: Tensor, horizon: int, draws: int) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, standard deviation and joint draws after frames that reach as far as the lags."""
        mean = self.chain.rolled(known, horizon)
        root = torch.linalg.cholesky(self.innovation[-1])
        noise = torch.randn(draws, *mean.shape, dtype=mean.dtype, device=mean.device) @ root.mT
        paths = self.chain.rolled(known, horizon, noise)
        return mean, self._variance(horizon).sqrt().expand_as(mean), paths

    def _conditional(
        self,
        values: Float[Tensor, "window time channel"],
        mask: Bool[Tensor, "window time channel"],
        draws: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, standard deviation and joint draws of all entries, given those observed."""
        Λ = precision(self.chain, self.innovation, values.shape[1])
        mean, std = values.clone(), torch.zeros_like(values)
        paths = values.repeat(draws, 1, 1, 1)
        for rows, pattern in alike(mask):
            mean[rows], std[rows], paths[:, rows] = conditional(Λ, values[rows], pattern, draws)
        return mean, std, paths
