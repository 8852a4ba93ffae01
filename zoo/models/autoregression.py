"""A linear autoregression with its exact conditional Gaussian: `ar`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.datasets.records import Pairs, Sequences
from zoo.models.baseline import check_fitted, movements_of, seen_entries
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Autoregression", "Config"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`Autoregression`.

    ``order`` is p; ``coupling`` says whether channels follow from their own past alone
    (``channel``) or from that of all (``vector``); ``ridge`` is the penalty on A for each
    training frame, in scaled units; ``noise_floor`` the least innovation, in scaled units.
    """

    order: int = 2
    coupling: Literal["channel", "vector"] = "channel"
    ridge: float = 1e-6
    noise_floor: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse settings without a meaning."""
        if self.order < 1:
            raise ValueError(f"order must be at least 1; got {self.order}")
        if self.coupling not in ("channel", "vector"):
            raise ValueError(f"coupling must be channel or vector; got {self.coupling!r}")
        if not (self.ridge >= 0 and self.noise_floor > 0):
            raise ValueError(
                "ridge must not be negative and noise_floor must be positive; "
                f"got {self.ridge}, {self.noise_floor}"
            )


class Autoregression(nn.Module):
    """Every frame is a linear function of the p frames before it: the textbook's AR(p).

    x_{1:p} ~ N(μ, S), x_t ~ N(c + Σ_{i=1}^p A_i x_{t−i}, Q)

    A and c by ridge regression over all training frames whose p predecessors were seen, Q from
    the residuals, μ and S from all runs of p frames. With ``coupling="channel"`` each channel is
    an own AR(p); with ``vector`` they are one, and Q is full. Lütkepohl, *New Introduction to
    Multiple Time Series Analysis* (2005), ch. 3.

    A movement is one Gaussian with a banded precision. Conditioning it on what was seen gives
    forecast and imputation with their exact moments and joint draws, missing entries among the
    frames seen included. All spread is of the path: there is no observation noise, so that seen
    entries are returned as they are. The uncertainty of A, c and Q is not in the bands.

    Defaults: p = 2, own past only; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    intercept: Tensor
    coefficients: Tensor
    innovation: Tensor
    start_mean: Tensor
    start_covariance: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`."""
        super().__init__()
        self.layout, self.config = layout, config
        channels = len(layout.channels)
        self.width = channels if config.coupling == "vector" else 1
        self.blocks = channels // self.width
        names = ("intercept", "coefficients", "innovation", "start_mean", "start_covariance")
        for name in names:
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    def condition(self, data: Sequences | Pairs) -> None:
        """Regress every frame on its p predecessors.

        ``coefficients`` become (lag, block, width, width), ``intercept`` (block, width),
        ``innovation`` Q (block, width, width); a block is a channel or all channels.
        """
        movements = movements_of("ar", data, self.dtype)
        values, mask = self._blocked(movements.values), self._blocked(movements.mask)
        p = self.config.order
        runs, whole = self._runs(values, mask)
        self._check_enough(whole.sum((0, 1)), movements)
        past, now = runs.split([p * self.width, self.width], -1)
        beta, self.innovation = self._regress(past, now, whole[..., None].to(past))
        self.intercept = beta[:, 0]
        lags = beta[:, 1:].unflatten(1, (p, self.width)).flip(1)
        self.coefficients = lags.permute(1, 0, 3, 2).contiguous()
        self.start_mean, self.start_covariance = self._start(past, whole[..., None].to(past))

    def forward(self, batch: Batch) -> Tensor:
        """The generative program; a term with a missing entry in its p + 1 frames is left out."""
        check_fitted("ar", self.innovation)
        p, frames = self.config.order, batch.values.shape[1]
        if frames <= p:
            raise ValueError(f"windows have {frames} frames; ar of order {p} needs {p + 1}")
        values, mask = self._blocked(batch.values), self._blocked(seen_entries(batch))
        runs, whole = self._runs(values, mask)
        past, now = runs.split([p * self.width, self.width], -1)
        first_seen = mask[:, :p].all(1).all(-1)
        start = dist.MultivariateNormal(self.start_mean, self.start_covariance)
        step = dist.MultivariateNormal(self._next(past), self.innovation)
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            pyro.sample("x_start", start.mask(first_seen).to_event(1), obs=past[:, 0])
            x: Tensor = pyro.sample("x", step.mask(whole).to_event(2), obs=now)
        return x.flatten(2)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """p(x_{k+1:k+horizon} | x_{1:k}), exact; the last p frames suffice where they are seen."""
        check_fitted("ar", self.innovation)
        p, mask = self.config.order, seen_entries(batch)
        kept = p if bool(mask[:, -p:].all()) else batch.values.shape[1]
        seen, mask = batch.values[:, -kept:], mask[:, -kept:]
        kept = seen.shape[1]
        ahead = max(horizon, p - kept)
        values = torch.cat([seen, seen.new_zeros(len(seen), ahead, seen.shape[2])], 1)
        mask = torch.cat([mask, mask.new_zeros(len(seen), ahead, seen.shape[2])], 1)
        mean, spread, paths = self._conditional(values, mask, draws)
        future = slice(kept, kept + horizon)
        return Predictive(
            location=mean[None, :, future],
            epistemic=spread[:, future],
            draws=paths[:, :, future],
        )

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x_missing | x_seen), exact; seen entries are returned with no more than rounding."""
        check_fitted("ar", self.innovation)
        p, frames = self.config.order, batch.values.shape[1]
        if frames < p:
            raise ValueError(f"movements have {frames} frames; ar of order {p} needs {p}")
        mean, spread, paths = self._conditional(batch.values, seen_entries(batch), draws)
        return Predictive(location=mean[None], epistemic=spread, draws=paths)

    def _blocked(self, x: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch block width"]:
        blocks: Tensor = x.unflatten(-1, (self.blocks, self.width))
        return blocks

    def _runs(
        self, values: Tensor, mask: Tensor
    ) -> tuple[Float[Tensor, "window run block value"], Float[Tensor, "window run block"]]:
        """All runs of p + 1 frames, the oldest first, and whether they were seen in full."""
        length = self.config.order + 1
        runs = values.unfold(1, length, 1).movedim(-1, -2).flatten(-2)
        whole = mask.unfold(1, length, 1).movedim(-1, -2).flatten(-2).all(-1)
        return runs, whole

    def _check_enough(self, count: Tensor, data: Sequences) -> None:
        need = 2 + self.config.order * self.width
        short = int(count.argmin())
        if count[short] < need:
            raise ValueError(
                f"ar of order {self.config.order} needs {need} runs of {self.config.order + 1} "
                f"frames without a missing entry; channel {data.channels[short * self.width]} "
                f"has {int(count[short])}"
            )

    def _regress(self, past: Tensor, now: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Ridge estimate (block, 1 + lags, width) with the intercept first, and Q."""
        x = torch.cat([torch.ones_like(past[..., :1]), past], -1)
        count = weight.sum((0, 1))[..., None]
        penalty = x.new_full((x.shape[-1],), self.config.ridge)
        penalty[0] = 0
        gram = torch.einsum("stbf,stbg->bfg", weight * x, x) + count * penalty.diag()
        beta = torch.linalg.solve(gram, torch.einsum("stbf,stbw->bfw", weight * x, now))
        residual = weight * (now - torch.einsum("stbf,bfw->stbw", x, beta))
        innovation = torch.einsum("stbv,stbw->bvw", residual, residual) / (count - x.shape[-1])
        return beta, innovation + self._floor(innovation)

    def _start(self, past: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        count = weight.sum((0, 1))
        mean = (past * weight).sum((0, 1)) / count
        off = (past - mean) * weight
        covariance = torch.einsum("stbv,stbw->bvw", off, off) / (count - 1)[..., None]
        return mean, covariance + self._floor(covariance)

    def _floor(self, like: Float[Tensor, "block width width"]) -> Float[Tensor, "width width"]:
        return self.config.noise_floor**2 * _identity(like)

    def _next(self, past: Float[Tensor, "window run block value"]) -> Tensor:
        lags = past.unflatten(-1, (self.config.order, self.width)).flip(-2)
        follows: Tensor = torch.einsum("ibvw,ntbiw->ntbv", self.coefficients, lags)
        return self.intercept + follows

    def _precision(self, frames: int) -> tuple[Tensor, Tensor]:
        """Λ (block, m, m) and h = Λ·mean (block, m) of a whole movement, m = frames × width."""
        p, w = self.config.order, self.width
        white = torch.linalg.inv(torch.linalg.cholesky(self.innovation))
        start = torch.linalg.inv(torch.linalg.cholesky(self.start_covariance))
        rows = self.innovation.new_zeros(frames, frames, self.blocks, w, w)
        t = torch.arange(p, frames, device=rows.device)
        rows[t, t] = white
        for i in range(1, p + 1):
            rows[t, t - i] = -white @ self.coefficients[i - 1]
        rows[:p, :p] = start.unflatten(2, (p, w)).unflatten(1, (p, w)).permute(1, 3, 0, 2, 4)
        root = rows.permute(2, 0, 3, 1, 4).flatten(3, 4).flatten(1, 2)
        first = (start @ self.start_mean[..., None]).squeeze(-1)
        later = (white @ self.intercept[..., None]).squeeze(-1).repeat(1, frames - p)
        offset = torch.cat([first, later], 1)
        return root.mT @ root, (root.mT @ offset[..., None]).squeeze(-1)

    def _conditional(
        self, values: Tensor, mask: Tensor, draws: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, standard deviation and joint draws of all entries, given those seen."""
        precision, shift = self._precision(values.shape[1])
        x, seen = (self._stacked(self._blocked(v)) for v in (values, mask))
        if bool((seen == seen[:1]).all()):
            seen = seen[:1]
        missing = (~seen).to(x)
        x = x * seen
        held = missing[..., None] * precision * missing[..., None, :] + torch.diag_embed(
            1 - missing
        )
        root = torch.linalg.cholesky(held)
        pull = missing * (shift - (precision @ x[..., None]).squeeze(-1))
        mean = x + missing * torch.cholesky_solve(pull[..., None], root).squeeze(-1)
        inverse = torch.linalg.solve_triangular(root, _identity(root), upper=False)
        rounding = torch.finfo(x.dtype).eps ** 0.5
        spread = (missing * inverse.square().sum(-2).sqrt()).clamp(min=rounding).expand_as(mean)
        unit = torch.randn(draws, *mean.shape, dtype=x.dtype, device=x.device)
        paths = mean + missing * torch.einsum("nbij,snbi->snbj", inverse, unit)
        return self._framed(mean), self._framed(spread), self._framed(paths)

    def _stacked(self, x: Float[Tensor, "window time block width"]) -> Tensor:
        return x.transpose(1, 2).flatten(2)

    def _framed(self, x: Float[Tensor, "*sample window block value"]) -> Tensor:
        frames: Tensor = x.unflatten(-1, (-1, self.width)).transpose(-3, -2)
        return frames.flatten(-2)


def _identity(like: Float[Tensor, "*batch n n"]) -> Float[Tensor, "n n"]:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
