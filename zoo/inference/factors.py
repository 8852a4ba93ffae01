"""Probabilistic principal components as pure functions: maximum likelihood, posterior, evidence."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["Factors", "closed_form", "expectation_maximisation"]


@dataclass(frozen=True, kw_only=True)
class Factors:
    """p(x | z) = N(Wz + μ, σ²I) with z ~ N(0, I): W is ``loading``, μ ``mean``, σ ``noise``."""

    loading: Float[Tensor, "channel latent"]
    mean: Float[Tensor, " channel"]
    noise: Float[Tensor, ""]

    def posterior(
        self, values: Float[Tensor, "frame channel"], mask: Bool[Tensor, "frame channel"] | None
    ) -> tuple[Float[Tensor, "frame latent"], Float[Tensor, "frame latent latent"]]:
        """Mean and covariance of p(z | x_seen): M = W'W + σ²I over the observed rows, σ²M⁻¹."""
        factor, pattern = self._factor(mask, len(values))
        residual = _seen(values - self.mean, mask) @ self.loading
        mean = torch.cholesky_solve(residual[..., None], factor[pattern])[..., 0]
        covariance = self.noise.square() * torch.cholesky_inverse(factor)
        return mean, covariance[pattern]

    def log_evidence(
        self, values: Float[Tensor, "frame channel"], mask: Bool[Tensor, "frame channel"] | None
    ) -> Float[Tensor, " frame"]:
        """log N(x_seen; μ, WW' + σ²I) of every frame, without a matrix of the channels' size."""
        factor, pattern = self._factor(mask, len(values))
        z, _ = self.posterior(values, mask)
        residual = _seen(values - self.mean - z @ self.loading.T, mask)
        square = (residual / self.noise).square().sum(-1) + z.square().sum(-1)
        count = values.shape[-1] if mask is None else mask.sum(-1).to(values.dtype)
        latent = self.loading.shape[1]
        half_logdet = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[pattern]
        half_logdet = half_logdet + (count - latent) * self.noise.log()
        return -0.5 * (square + count * math.log(2 * math.pi)) - half_logdet

    def _factor(
        self, mask: Tensor | None, frames: int
    ) -> tuple[Float[Tensor, "pattern latent latent"], Tensor]:
        """M's Cholesky factor for every pattern of observed channels, and each frame's pattern."""
        if mask is None:
            patterns = torch.ones_like(self.mean)[None]
            index = torch.zeros(frames, dtype=torch.long, device=self.mean.device)
        else:
            unique, index = torch.unique(mask, dim=0, return_inverse=True)
            patterns = unique.to(self.mean.dtype)
        gram = torch.einsum("pd,di,dj->pij", patterns, self.loading, self.loading)
        identity = torch.eye(self.loading.shape[1], dtype=gram.dtype, device=gram.device)
        return torch.linalg.cholesky(gram + self.noise.square() * identity), index


def closed_form(values: Float[Tensor, "frame channel"], latent: int, floor: float) -> Factors:
    """Maximum likelihood from the eigen-decomposition of the covariance, Tipping & Bishop (7)(8).

    σ² is the mean of the discarded eigenvalues (at least ``floor``²), W = U(Λ − σ²I)^½.
    """
    mean = values.mean(0)
    eigenvalues, vectors = torch.linalg.eigh((values - mean).T @ (values - mean) / len(values))
    variance = eigenvalues[:-latent].mean().clamp(min=floor**2)
    kept = eigenvalues[-latent:].flip(0)
    scale = (kept - variance).clamp(min=0).sqrt()
    loading = _signed(vectors[:, -latent:].flip(1)) * scale
    return Factors(loading=loading, mean=mean, noise=variance.sqrt())


def expectation_maximisation(
    values: Float[Tensor, "frame channel"],
    mask: Bool[Tensor, "frame channel"],
    latent: int,
    floor: float,
    *,
    iterations: int,
    tolerance: float,
) -> Factors:
    """Maximum likelihood from the observed entries, started from the closed form on filled means.

    It ends when the evidence grows by less than ``tolerance`` nats per observed entry, and
    warns where that is not reached within ``iterations``. W is rotated to its principal axes.
    """
    seen = _seen(values, mask)
    mean = seen.sum(0) / mask.sum(0)
    factors = closed_form(torch.where(mask, values, mean), latent, floor)
    before = factors.log_evidence(values, mask).sum()
    for _ in range(iterations):
        factors = _step(factors, values, mask, floor)
        after = factors.log_evidence(values, mask).sum()
        gain, before = (after - before) / mask.sum(), after
        if gain < tolerance:
            return _principal(factors)
    warnings.warn(
        f"EM gained {float(gain):.1e} nats an entry in the last of {iterations} iterations; "
        f"{tolerance:.1e} was asked for (raise em_iterations)",
        stacklevel=2,
    )
    return _principal(factors)


def _step(factors: Factors, values: Tensor, mask: Tensor, floor: float) -> Factors:
    """One iteration: E-step, then W, μ channel by channel by least squares, then σ²."""
    z, covariance = factors.posterior(values, mask)
    seen = mask.to(values.dtype)
    extended = torch.cat([z, torch.ones_like(z[:, :1])], -1)
    second = extended[:, :, None] * extended[:, None, :]
    second[:, :-1, :-1] += covariance
    gram = (seen.T @ second.flatten(1)).unflatten(1, second.shape[1:])
    cross = _seen(values, mask).T @ extended
    weights = torch.linalg.solve(gram, cross)
    loading, mean = weights[:, :-1], weights[:, -1]
    square = _seen(values - extended @ weights.T, mask).square()
    spread = torch.einsum("di,nij,dj->nd", loading, covariance, loading)
    variance = (square + seen * spread).sum() / seen.sum()
    return Factors(loading=loading, mean=mean, noise=variance.clamp(min=floor**2).sqrt())


def _principal(factors: Factors) -> Factors:
    vectors, scale, _ = torch.linalg.svd(factors.loading, full_matrices=False)
    return Factors(loading=_signed(vectors) * scale, mean=factors.mean, noise=factors.noise)


def _signed(vectors: Float[Tensor, "channel latent"]) -> Float[Tensor, "channel latent"]:
    """Axes whose largest entry is positive."""
    largest = vectors.abs().argmax(0, keepdim=True)
    return vectors * vectors.gather(0, largest).sign()


def _seen(values: Tensor, mask: Tensor | None) -> Tensor:
    return values if mask is None else torch.where(mask, values, 0.0)
