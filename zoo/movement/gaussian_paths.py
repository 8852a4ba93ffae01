"""Covariances of Gaussian paths: stationary ones from residuals, blocks of frames, safe factors."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["block_diagonal", "cholesky", "stationary", "stationary_draws"]

JITTER = 1e-8


def stationary(
    residuals: Float[Tensor, "movement frame latent"], time: int | None = None
) -> Float[Tensor, "time latent time latent"]:
    """Covariance of stationary residuals from their correlation at every lag (never indefinite)."""
    count, frames, _ = residuals.shape
    time = frames if time is None else time
    spectrum = torch.fft.rfft(residuals, n=frames + max(frames, time), dim=1)
    power = torch.einsum("mfi,mfj->fij", spectrum.conj(), spectrum)
    size = frames + max(frames, time)
    lags = torch.fft.irfft(power, n=size, dim=0) / (count * frames)
    step = torch.arange(time)
    covariance: Tensor = lags[(step - step[:, None]) % size]
    return covariance.permute(0, 2, 1, 3)


def stationary_draws(
    residuals: Float[Tensor, "movement frame latent"], time: int, shape: tuple[int, ...]
) -> Float[Tensor, "*shape time latent"]:
    """Draws of N(0, :func:`stationary`): white noise in time, folded with the residuals."""
    count, frames, _ = residuals.shape
    size = frames + max(frames, time)
    noise = torch.randn(*shape, count, size, dtype=residuals.dtype, device=residuals.device)
    spectra = torch.fft.rfft(residuals, n=size, dim=1)
    mixed = torch.einsum("...mf,mfi->...fi", torch.fft.rfft(noise, dim=-1), spectra)
    drawn: Tensor = torch.fft.irfft(mixed, n=size, dim=-2)
    return drawn[..., :time, :] / math.sqrt(count * frames)


def block_diagonal(
    block: Float[Tensor, "*block latent latent"], frames: int
) -> Float[Tensor, "*batch path path"]:
    """One block for all frames, or a block for each."""
    latent = block.shape[-1]
    each = block.expand(*block.shape[:-3], frames, latent, latent)
    wide = each.unsqueeze(-2) * torch.eye(frames, dtype=block.dtype)[:, None, :, None]
    return wide.flatten(-2).flatten(-3, -2)


def cholesky(matrix: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Factor of a symmetric matrix whose diagonal is raised by a hundred-millionth."""
    relative = 1 + JITTER * torch.eye(matrix.shape[-1], dtype=matrix.dtype)
    factor: Tensor = torch.linalg.cholesky((matrix + matrix.mT) / 2 * relative)
    return factor
