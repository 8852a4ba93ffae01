"""Gaussian chains with some entries observed: exact moments and joint draws of the others."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.models.baselines.chains import Chain

__all__ = ["Precision", "conditional", "precision"]


@dataclass(frozen=True)
class Precision:
    """Λ and Λ·mean of a chain, in blocks of as many frames as its longest lag.

    Λ is block-tridiagonal: ``diagonal`` and the blocks ``below`` it, time running within a block.
    """

    diagonal: Float[Tensor, "block entry entry"]
    below: Float[Tensor, "link entry entry"]
    shift: Float[Tensor, "block entry"]


def precision(
    chain: Chain, innovation: Float[Tensor, "level channel channel"], frames: int
) -> Precision:
    """Λ of at least ``frames`` frames, x_t − c − Σ A x_{t−l} ~ N(0, Q) at every level."""
    size, width = chain.lags[-1], chain.intercept.shape[-1]
    blocks = -(-frames // size)
    white = torch.linalg.inv(torch.linalg.cholesky(innovation))
    own, before = (white.new_zeros(blocks, size, width, size, width) for _ in range(2))
    offset = white.new_zeros(blocks, size, width)
    for t in range(min(2, blocks) * size):
        k, row, j = t // size, t % size, chain.level(t)
        own[k, row, :, row] = white[j]
        offset[k, row] = white[j] @ chain.intercept[j]
        for lag, A in zip(chain.lags[:j], chain.coefficients[j], strict=False):
            into = own if lag <= row else before
            into[k, row, :, (row - lag) % size] = -white[j] @ A
    for part in (own, before, offset):
        part[2:] = part[1:2]
    R, S = own.flatten(3, 4).flatten(1, 2), before.flatten(3, 4).flatten(1, 2)[1:]
    c = offset.flatten(1)
    diagonal, shift = R.mT @ R, (R.mT @ c[..., None])[..., 0]
    diagonal[:-1] += S.mT @ S
    shift[:-1] += (S.mT @ c[1:, :, None])[..., 0]
    return Precision(diagonal, R[1:].mT @ S, shift)


def conditional(
    Λ: Precision,
    values: Float[Tensor, "window time channel"],
    mask: Bool[Tensor, "time channel"],
    draws: int,
) -> tuple[
    Float[Tensor, "window time channel"],
    Float[Tensor, "time channel"],
    Float[Tensor, "sample window time channel"],
]:
    """Mean, standard deviation and joint draws of all entries, given those of ``mask``."""
    frames, width = mask.shape
    blocks, entries = Λ.shift.shape
    tail = (0, 0, 0, blocks * entries // width - frames)
    pad = torch.nn.functional.pad
    x = pad(values * mask, tail).flatten(1).unflatten(1, (blocks, entries))
    missing = [(~m).nonzero()[:, 0] for m in pad(mask, tail).flatten().view(blocks, entries)]
    mean, unit, variance = _solved(Λ, x, missing, draws)
    std = variance.sqrt()
    shape = (*mean.shape[:1], -1, width)
    path = mean + unit
    return (
        mean.flatten(1).view(shape)[:, :frames],
        std.flatten().view(-1, width)[:frames],
        path.flatten(2).unflatten(2, (-1, width))[:, :, :frames],
    )


def _solved(
    Λ: Precision, x: Tensor, missing: list[Int[Tensor, " _entry"]], draws: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, zero-mean draws and variances, the blocks of the missing entries one after another."""
    roots, links, pulls = _factored(Λ, x, missing)
    mean, variance = x.clone(), torch.zeros_like(x[0])
    unit = x.new_zeros(draws, *x.shape)
    after, noise, Σ = pulls[-1][..., :0], unit[..., 0, :0], x.new_zeros(0, 0)
    for k in reversed(range(len(missing))):
        m, root, link = missing[k], roots[k], links[k]
        white = torch.randn(draws, len(x), len(m), dtype=x.dtype, device=x.device)
        solve = torch.linalg.solve_triangular
        after = solve(root.mT, (pulls[k] - after @ link).mT, upper=True).mT
        noise = solve(root.mT, (white - noise @ link).mT, upper=True).mT
        eye = torch.eye(len(m), dtype=x.dtype, device=x.device)
        inverse = solve(root, eye, upper=False)
        gain = link @ inverse
        Σ = inverse.mT @ inverse + gain.mT @ Σ @ gain
        mean[:, k, m], unit[:, :, k, m], variance[k, m] = after, noise, Σ.diagonal()
    return mean, unit, variance


def _factored(
    Λ: Precision, x: Tensor, missing: list[Tensor]
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Cholesky blocks L_k of missing entries, links L_{k+1,k} below them, and L⁻¹(shift − Λ x)."""
    roots: list[Tensor] = []
    links: list[Tensor] = []
    pulls: list[Tensor] = []
    for k, m in enumerate(missing):
        pull = (Λ.shift[k] - x[:, k] @ Λ.diagonal[k])[:, m]
        block = Λ.diagonal[k][m][:, m]
        if k + 1 < len(missing):
            pull = pull - x[:, k + 1] @ Λ.below[k][:, m]
        if k:
            pull = pull - x[:, k - 1] @ Λ.below[k - 1][m].mT
            link = torch.linalg.solve_triangular(
                roots[-1], Λ.below[k - 1][m][:, missing[k - 1]].mT, upper=False
            ).mT
            block, pull = block - link @ link.mT, pull - pulls[-1] @ link.mT
            links.append(link)
        roots.append(torch.linalg.cholesky(block))
        pulls.append(torch.linalg.solve_triangular(roots[-1], pull.mT, upper=False).mT)
    return roots, [*links, x.new_zeros(0, len(missing[-1]))], pulls
