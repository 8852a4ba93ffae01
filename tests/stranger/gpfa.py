"""Gaussian-process factor analysis: a model from outside, by public names alone."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import pyro
import pyro.distributions as dist
import torch
from pydantic import Field
from torch import Tensor, nn

import zoo
from zoo.contract.settings import Count, Positive, settings


@settings
class Config:
    """Settings of :class:`GPFA`.

    ``timescale`` is the starting τ as a share of the longest movement; ``innovation`` the share ε
    of white noise in every latent trajectory; ``noise_floor`` the least σ in scaled units.
    """

    latent_dim: Count = 2
    timescale: Positive = 0.2
    innovation: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    noise_floor: Positive = 1e-3


class GPFA(nn.Module):
    """Smooth latent trajectories, each a Gaussian process over time, seen through a linear map.

        z_k ~ GP(0, (1 − ε) exp(−(t − t')²/2τ_k²) + ε δ_tt')
        x_t ~ N(C z_t + d, diag σ²)

    Yu et al., *Gaussian-process factor analysis for low-dimensional single-trial analysis of neural
    population activity*, J. Neurophysiology 102 (2009). Time t is counted in frames. Evidence,
    posterior, forecasts and the conditional of missing entries are exact given C, d, σ and τ, which
    maximise the evidence: their own uncertainty is not in the bands. Cost grows with the cube of
    frames · latent dimensions.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    def __init__(self, layout: zoo.Layout, config: Config) -> None:
        """Parameters for the layout's channels; ``condition`` sets their starting values."""
        super().__init__()
        channels = len(layout.channels)
        if config.latent_dim >= channels:
            raise ValueError(f"latent_dim must be below {channels}; got {config.latent_dim}")
        self.layout, self.config, self.latent_dim = layout, config, config.latent_dim
        self.loading = nn.Parameter(torch.zeros(channels, config.latent_dim, dtype=self.dtype))
        self.offset = nn.Parameter(torch.zeros(channels, dtype=self.dtype))
        self.log_noise = nn.Parameter(torch.zeros(channels, dtype=self.dtype))
        self.log_timescale = nn.Parameter(torch.zeros(config.latent_dim, dtype=self.dtype))
        self._data: tuple[Tensor, Tensor] | None = None

    @property
    def noise(self) -> Tensor:
        """σ of every channel."""
        return self.config.noise_floor + self.log_noise.exp()

    @torch.no_grad()
    def condition(self, data: zoo.Sequences | zoo.Pairs) -> None:
        """Keep the movements; start at their principal components."""
        if not isinstance(data, zoo.Sequences):
            raise TypeError(f"gpfa needs Sequences; got {type(data).__name__}")
        count = data.mask.sum((0, 1))
        if not bool(count.all()):
            name = data.channels[int((count == 0).nonzero()[0])]
            raise ValueError(f"channel {name} is missing in every frame; drop it")
        values = torch.where(data.mask, data.values, 0.0)
        mean = values.sum((0, 1)) / count
        centred = (values - mean) * data.mask
        covariance = centred.flatten(0, 1).mT @ centred.flatten(0, 1) / count.max()
        power, axes = torch.linalg.eigh(covariance)
        start = axes[:, -self.latent_dim :] * power[-self.latent_dim :].clamp_min(1e-6).sqrt()
        left = (covariance - start @ start.mT).diagonal().clamp_min(1e-4)
        self.loading.copy_(start)
        self.offset.copy_(mean)
        self.log_noise.copy_(left.log() / 2)
        self.log_timescale.fill_(math.log(self.config.timescale * values.shape[1]))
        self._data = values, data.mask

    def objective(self) -> Tensor:
        """Minus the log evidence of the movements."""
        if self._data is None:
            raise RuntimeError("the evidence needs movements; call condition(data) first")
        return -self.log_evidence(*self._data).sum()

    def settle(self) -> None:
        """Let go of the movements: the parameters are all that prediction needs."""
        self._data = None

    def log_evidence(self, values: Tensor, mask: Tensor) -> Tensor:
        """log p(x) of the entries seen, for every movement, by the determinant lemma."""
        mean, factor = self._posterior(values, mask)
        left = (values - self.offset - self._latent(mean) @ self.loading.mT) / self.noise
        quadratic = (mask * left.square()).sum((1, 2)) + mean.square().sum(1)
        determinant = 2 * factor.diagonal(dim1=1, dim2=2).log().sum(1)
        constant = (mask * (math.log(2 * math.pi) + 2 * self.noise.log())).sum((1, 2))
        return -0.5 * (constant + determinant + quadratic)

    def forward(self, batch: zoo.Batch) -> Tensor:
        """White noise v of every movement, its latent trajectories z = L v, then x."""
        rows, frames, _ = batch.values.shape
        mask = True if batch.mask is None else batch.mask
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(rows)):
            white = dist.Normal(self.offset.new_zeros(rows, frames * self.latent_dim), 1.0)
            v = pyro.sample("v", white.to_event(1))
            law = dist.Normal(self._latent(v) @ self.loading.mT + self.offset, self.noise)
            x: Tensor = pyro.sample("x", law.mask(mask).to_event(2), obs=batch.given(batch.values))
        return x

    def posterior_sites(self, batch: zoo.Batch) -> zoo.Sites:
        """The exact p(v | x) of every movement."""
        mean, factor = self._posterior(batch.values, _mask(batch))
        v = dist.MultivariateNormal(mean, precision_matrix=factor @ factor.mT)
        return zoo.Sites(plate="windows", size=batch.total, rows=len(batch), of={"v": lambda _: v})

    def represent(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, draws: int
    ) -> zoo.Predictive:
        """p(z_t | x), exact."""
        eye = torch.eye(self.latent_dim, dtype=self.dtype)
        return zoo.Predictive(**self._moments(batch.values, _mask(batch), eye, draws))

    def reconstruct(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, draws: int
    ) -> zoo.Predictive:
        """p(x̂ | x) of a second observation of the same trajectories."""
        return self._observed(batch.values, _mask(batch), draws)

    def impute(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, draws: int
    ) -> zoo.Predictive:
        """p(x_missing | x_seen); seen entries are reconstructed."""
        return self._observed(batch.values, _mask(batch), draws)

    def forecast(
        self, batch: zoo.Batch, posterior: zoo.Posterior | None, *, horizon: int, draws: int
    ) -> zoo.Predictive:
        """The frames to come are missing entries."""
        later = (0, 0, 0, horizon)
        values, mask = (nn.functional.pad(t, later) for t in (batch.values, _mask(batch)))
        return self._observed(values, mask, draws, first=batch.values.shape[1])

    def _observed(self, values: Tensor, mask: Tensor, draws: int, first: int = 0) -> zoo.Predictive:
        found = self._moments(values, mask, self.loading, draws)
        for name in ("location", "draws"):
            found[name] = found[name] + self.offset
        later = {name: part[:, :, first:] for name, part in found.items()}
        return zoo.Predictive(noise=self.noise, **later)

    def _moments(
        self, values: Tensor, mask: Tensor, loading: Tensor, draws: int
    ) -> dict[str, Tensor]:
        """Mean, standard deviation and joint draws of C z_t given what was seen."""
        mean, factor = self._posterior(values, mask)
        rows = torch.einsum("dk,kta->katd", loading, self._root(values.shape[1]))
        half = torch.linalg.solve_triangular(factor, rows.flatten(0, 1).flatten(1), upper=False)
        std = half.square().sum(1).sqrt().unflatten(1, rows.shape[2:])
        noise = torch.randn(draws, *mean.shape, 1, dtype=mean.dtype)
        v = mean + torch.linalg.solve_triangular(factor.mT, noise, upper=True)[..., 0]
        return {
            "location": (self._latent(mean) @ loading.mT)[None],
            "epistemic": std[None],
            "draws": self._latent(v) @ loading.mT,
        }

    def _posterior(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Mean B⁻¹ Lᵀ Cᵀ W (x − d) of v and the lower root of its precision B = I + Lᵀ Cᵀ W C L."""
        weight, root = mask / self.noise.square(), self._root(values.shape[1])
        precision = torch.einsum("std,dk,dl->stkl", weight, self.loading, self.loading)
        inner = torch.einsum("kta,stkl,ltb->skalb", root, precision, root)
        inner = inner.flatten(3, 4).flatten(1, 2)
        factor = torch.linalg.cholesky(inner + torch.eye(inner.shape[1], dtype=inner.dtype))
        pulled = (weight * (values - self.offset)) @ self.loading
        pulled = torch.einsum("kta,stk->ska", root, pulled).flatten(1)
        return torch.cholesky_solve(pulled[..., None], factor)[..., 0], factor

    def _latent(self, v: Tensor) -> Tensor:
        """z = L v, shape (…, time, latent)."""
        each = v.unflatten(-1, (self.latent_dim, -1))
        return torch.einsum("kta,...ka->...tk", self._root(each.shape[-1]), each)

    def _root(self, frames: int) -> Tensor:
        """Lower root L of the covariance of every latent trajectory: (latent, time, time)."""
        t = torch.arange(frames, dtype=self.dtype)
        scaled = (t[:, None] - t) / self.log_timescale.exp()[:, None, None]
        share = self.config.innovation
        kernel = (1 - share) * (-0.5 * scaled.square()).exp() + share * torch.eye(frames)
        return torch.linalg.cholesky(kernel)


def _mask(batch: zoo.Batch) -> Tensor:
    return torch.ones_like(batch.values, dtype=torch.bool) if batch.mask is None else batch.mask
