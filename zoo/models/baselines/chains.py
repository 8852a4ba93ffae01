"""Linear chains whose memory grows: their regressions from sums, roll-outs and stability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.movement.cross_validation import splits

__all__ = ["Chain", "chain", "lags_up_to", "sums_of_runs", "unexplained"]


def lags_up_to(order: int) -> tuple[int, ...]:
    """Lags 1, 2, 4, … and ``order``, the longest.

    >>> lags_up_to(2), lags_up_to(6)
    ((1, 2), (1, 2, 4, 6))
    """
    doubling = [2**i for i in range(order.bit_length()) if 2**i < order]
    return (*doubling, order)


@dataclass(frozen=True)
class Chain:
    """x_t = c_j + Σ_{i ≤ j} A_ji x_{t−l_i}, where j of the lags l_1 < l_2 < … reach back from t.

    ``coefficients`` A_ji are 0 for i > j; level 0 is a frame without a past. Leading axes are
    chains side by side.
    """

    lags: tuple[int, ...]
    intercept: Float[Tensor, "*chain level channel"]
    coefficients: Float[Tensor, "*chain level lag channel channel"]

    def level(self, known: int) -> int:
        """How many lags reach into ``known`` frames.

        >>> Chain((1, 4), torch.zeros(3, 1), torch.zeros(3, 2, 1, 1)).level(3)
        1
        """
        return sum(lag <= known for lag in self.lags)

    def first(self, count: int) -> Chain:
        """The chain with its first ``count`` lags."""
        coefficients = self.coefficients[..., : count + 1, :count, :, :]
        return Chain(self.lags[:count], self.intercept[..., : count + 1, :], coefficients)

    def rolled(
        self,
        known: Float[Tensor, "*#sample window time channel"],
        steps: int,
        noise: Float[Tensor, "*#sample window step channel"] | None = None,
    ) -> Float[Tensor, "*#sample window step channel"]:
        """The frames after ``known``, each from those before it and, where given, its noise."""
        moved = known[..., :0, :] if noise is None else noise
        shapes = (self.intercept.shape[:-2], known.shape[:-3], moved.shape[:-3])
        leading = torch.broadcast_shapes(*shapes)
        path = [x.expand(*leading, *x.shape[-2:]) for x in known.unbind(-2)]
        levels = range(len(self.lags) + 1)
        onward = [self.coefficients[..., j, :j, :, :].mT.flatten(-3, -2) for j in levels]
        for step in range(steps):
            j = self.level(len(path))
            x = self.intercept[..., None, j, :]
            if j:
                past = torch.cat([path[-lag] for lag in self.lags[:j]], -1)
                x = x + past @ onward[j]
            path.append(x if noise is None else x + noise[..., step, :])
        return torch.stack([x.expand(*leading, known.shape[-3], -1) for x in path[-steps:]], -2)

    def predicted(
        self, x: Float[Tensor, "window time channel"]
    ) -> Float[Tensor, "window time channel"]:
        """Every frame from those before it, by as many lags as reach back."""
        frames = x.shape[1]
        starts = [min(lag, frames) for lag in (0, *self.lags)]
        parts = []
        for j, (start, stop) in enumerate(zip(starts, [*starts[1:], frames], strict=True)):
            mean = self.intercept[j].expand(len(x), stop - start, -1)
            for lag, A in zip(self.lags[:j], self.coefficients[j], strict=False):
                mean = mean + x[:, start - lag : stop - lag] @ A.mT
            parts.append(mean)
        return torch.cat(parts, 1)

    def responses(self, steps: int) -> Float[Tensor, "step channel channel"]:
        """Ψ_h, what a unit innovation comes to after 0 … ``steps`` − 1 frames, at full memory."""
        Ψ = [_identity(self.intercept.shape[-1], self.intercept)]
        for h in range(1, steps):
            pairs = zip(self.lags, self.coefficients[-1], strict=True)
            Ψ.append(sum((A @ Ψ[h - lag] for lag, A in pairs if lag <= h), 0 * Ψ[0]))
        return torch.stack(Ψ)

    def stable(self) -> Chain:
        """This chain with no growing mode: A_i ρ^{−l_i} where the spectral radius ρ is above 1.

        All eigenvalues are then divided by ρ; what follows frames of 0 stays.
        """
        ρ = float(torch.linalg.eigvals(self._companion()).abs().max())
        if ρ <= 1:
            return self
        shrink = self.intercept.new_tensor([ρ**-lag for lag in self.lags])
        after = self.coefficients.clone()
        after[-1] *= shrink[:, None, None]
        return Chain(self.lags, self.intercept, after)

    def _companion(self) -> Float[Tensor, "state state"]:
        width, longest = self.intercept.shape[-1], self.lags[-1]
        F = _identity(longest * width, self.intercept).roll(width, 0)
        F[:width] = 0
        for lag, A in zip(self.lags, self.coefficients[-1], strict=True):
            F[:width, (lag - 1) * width : lag * width] = A
        return F


def sums_of_runs(
    values: Float[Tensor, "sequence frame channel"],
    mask: Bool[Tensor, "sequence frame channel"],
    lags: Sequence[int],
    fold: Int[Tensor, " sequence"],
    *,
    jointly: bool,
) -> Float[Tensor, "fold block entry entry"]:
    """Σ u uᵀ of every fold with u = (1, x_{t−l_1}, …, x_{t−l_J}, x_t) over all t with u observed.

    A block is all channels, or one channel each unless ``jointly``.
    """
    start, frames = max(lags, default=0), values.shape[1]
    shifts = [slice(start - lag, frames - lag) for lag in (*lags, 0)]
    blocks = 1 if jointly else values.shape[2]
    parts = [values[:, s].unflatten(-1, (blocks, -1)) for s in shifts]
    whole = torch.stack([mask[:, s].unflatten(-1, (blocks, -1)).all(-1) for s in shifts]).all(0)
    u = torch.cat([torch.ones_like(parts[0][..., :1]), *parts], -1) * whole[..., None]
    parts = [u[held].flatten(0, 1).transpose(0, 1) for _, held in splits(fold)]
    return torch.stack([rows.mT @ rows for rows in parts])


def chain(
    sums: Sequence[Float[Tensor, "block _entry _entry"]],
    lags: Sequence[int],
    ridge: Float[Tensor, " ridge"],
) -> Chain:
    """Ridge regressions of every level, one chain for each penalty; ``sums`` are of the levels."""
    found = [_regression(level, j, ridge) for j, level in enumerate(sums)]
    intercept = torch.stack([c for c, _ in found], 1)
    width = intercept.shape[-1]
    coefficients = intercept.new_zeros(len(ridge), len(sums), len(lags), width, width)
    for j, (_, A) in enumerate(found):
        coefficients[:, j, :j] = A
    return Chain(tuple(lags), intercept, coefficients)


def unexplained(
    sums: Sequence[Float[Tensor, "block _entry _entry"]], fitted: Chain
) -> Float[Tensor, "level channel channel"]:
    """Summed outer products of the residuals of every level, of one chain."""
    width = fitted.intercept.shape[-1]
    found = []
    for j, level in enumerate(sums):
        blocks, own = len(level), width // len(level)
        A = fitted.coefficients[j, :j]
        c = fitted.intercept[j].view(blocks, own, 1)
        if blocks > 1:
            A = A.diagonal(dim1=1, dim2=2).T[:, None]
        else:
            A = A.transpose(0, 1).flatten(1)[None]
        residual = torch.cat([-c, -A, _identity(own, c).expand(blocks, -1, -1)], -1)
        square = residual @ level @ residual.mT
        found.append(torch.block_diag(*square))
    return torch.stack(found)


def _regression(
    sums: Float[Tensor, "block entry entry"], lags: int, ridge: Float[Tensor, " ridge"]
) -> tuple[Float[Tensor, "ridge channel"], Float[Tensor, "ridge lag channel channel"]]:
    """c and A of one level; the penalty counts for each run, and not for c."""
    width = (sums.shape[-1] - 1) // (lags + 1)
    inputs = 1 + lags * width
    penalty = sums.new_ones(inputs)
    penalty[0] = 0
    strength = ridge[:, None] * sums[:, 0, 0]
    gram = sums[:, :inputs, :inputs] + strength[..., None, None] * penalty.diag()
    B = torch.linalg.solve(gram, sums[:, :inputs, inputs:].expand(len(ridge), -1, -1, -1))
    A = B[:, :, 1:].unflatten(2, (lags, width)).mT
    full = A[:, 0] if len(sums) == 1 else torch.diag_embed(A[..., 0, 0].transpose(1, 2))
    return B[:, :, 0].flatten(1), full


def _identity(size: int, like: Tensor) -> Float[Tensor, "size size"]:
    return torch.eye(size, dtype=like.dtype, device=like.device)
