r"""Path noise of a movement primitive: a Gauss–Markov process, filtered and smoothed in blocks.

White forces ε through the transformation system, observed with white noise, in units of σ::

    s_{t+1} = A s_t + B ε_t,   s_0 = 0,   n_t = H s_t,   x_t = n_t + √ρ η_t   where observed

A block of frames is one observation of the state at its begin, so that all costs are linear in the
number of frames. With v = x − O a the error of a block, F its covariance and G that of the next
state with it (Durbin & Koopman, *Time series analysis by state space methods*, 2012, §4)::

    a' = Φ a + G F⁻¹ v,   P' = Φ P Φᵀ + Γ Γᵀ − G F⁻¹ Gᵀ
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from zoo.movement.forcing import stationary_variance
from zoo.movement.response import Response, Transformation, transition_matrix

__all__ = ["PathNoise", "Smoother"]

BLOCK = 50


@dataclass(frozen=True)
class PathNoise:
    """n of ``frames`` frames, of unit variance in the long run."""

    system: Transformation
    frames: int

    @property
    def blocks(self) -> int:
        """Number of blocks, all of one length."""
        return math.ceil(self.frames / BLOCK)

    @property
    def block(self) -> int:
        """Frames of a block; those of the last may reach beyond the movement."""
        return max(2, math.ceil(self.frames / self.blocks))

    @cached_property
    def variance(self) -> Float[Tensor, " frame"]:
        """Variance of n without observations."""
        pulse = torch.zeros(self.frames - 1, 1, dtype=torch.float64)
        pulse[0] = 1
        variance: Tensor = self.respond(pulse)[:, 0].square().cumsum(0)
        return variance

    def respond(self, forces: Float[Tensor, "step column"]) -> Float[Tensor, "frame column"]:
        """N ε."""
        still = forces.new_zeros(2, forces.shape[1])
        path = Response.of(self.system, self.frames).product(still, forces)[0]
        return path / self.scale

    def paths(
        self, forces: Float[Tensor, "*batch step channel"]
    ) -> Float[Tensor, "*batch frame channel"]:
        """N ε of many movements."""
        steps = forces.movedim(-2, 0)
        path: Tensor = self.respond(steps.flatten(1)).unflatten(1, steps.shape[1:])
        return path.movedim(0, -2)

    def draw(self, count: int, like: Float[Tensor, "sequence frame channel"]) -> Tensor:
        """``count`` joint draws of n for movements shaped ``like``."""
        sequences, _, channels = like.shape
        shape = (count, sequences, self.frames - 1, channels)
        return self.paths(torch.randn(shape, dtype=like.dtype))

    @cached_property
    def scale(self) -> float:
        """Standard deviation in the long run under forces of unit variance."""
        return math.sqrt(stationary_variance(self.system))


@dataclass(frozen=True)
class Smoother:
    """The moments of all blocks, for any number of patterns of ρ and of observed frames at once.

    ``unroot`` is L⁻¹ of F = L Lᵀ, ``begin`` L⁻¹ O, ``onward`` G L⁻ᵀ, ``state`` P, ``log_root``
    the log diagonal of L of every frame. Frames that are not observed must hold 0.
    """

    noise: PathNoise
    seen: Bool[Tensor, "*#pattern frame"]
    unroot: Float[Tensor, "*#pattern block step step"]
    begin: Float[Tensor, "*#pattern block step 2"]
    onward: Float[Tensor, "*#pattern block 2 step"]
    state: Float[Tensor, "*#pattern block 2 2"]
    log_root: Float[Tensor, "*#pattern frame"]

    @classmethod
    def of(
        cls,
        noise: PathNoise,
        ratio: Float[Tensor, "*#pattern"],
        seen: Bool[Tensor, "*#pattern frame"],
    ) -> Smoother:
        """The moments under noise ratios ρ, of the frames observed; both broadcast."""
        ρ, seen = torch.broadcast_tensors(ratio[..., None], seen)
        ρ = ρ[..., :1]
        free, lagged, power, ends = _parts(noise)
        inner, cross, jump = lagged @ lagged.mT, ends @ lagged.mT, ends @ ends.mT
        eye, state = torch.eye(noise.block, dtype=ρ.dtype), ρ.new_zeros(*ρ.shape[:-1], 2, 2)
        rows = []
        for m in _cut(seen[..., None].to(ρ), noise)[..., 0].unbind(-2):
            path = free @ state @ free.mT + inner
            floor = torch.diag_embed(torch.where(m > 0, ρ, 1.0))
            root = torch.linalg.cholesky(m[..., None] * path * m[..., None, :] + floor)
            unroot = torch.linalg.solve_triangular(root, eye, upper=False)
            begin = unroot @ (m[..., None] * free)
            onward = ((power @ state @ free.mT + cross) * m[..., None, :]) @ unroot.mT
            log_root = root.diagonal(dim1=-2, dim2=-1).log()
            rows.append((unroot, begin, onward, state, log_root))
            state = power @ state @ power.mT + jump - onward @ onward.mT
        *matrices, volumes = zip(*rows, strict=True)
        unroot, begin, onward, state = (torch.stack(m, -3) for m in matrices)
        log_root = torch.stack(volumes, -2).flatten(-2)[..., : noise.frames]
        return cls(noise, seen, unroot, begin, onward, state, log_root)

    def at(self, index: Int[Tensor, " row"]) -> Smoother:
        """The patterns ``index`` of the last pattern axis."""
        axis = self.seen.ndim - 2
        parts = [getattr(self, f.name).index_select(axis, index) for f in fields(self)[1:]]
        return Smoother(self.noise, *parts)

    def whiten(
        self, x: Float[Tensor, "*#pattern frame column"]
    ) -> Float[Tensor, "*#pattern frame column"]:
        """L⁻¹ x: the errors of the predictions of every frame by those before it, of unit size."""
        return _joined(self._errors(x), self.noise.frames)

    def follow(
        self, x: Float[Tensor, "*#pattern frame column"]
    ) -> Float[Tensor, "*#pattern frame column"]:
        """E[n | x]: the path of the mean forces."""
        _, lagged, power, ends = _parts(self.noise)
        errors = self._errors(x)
        shape = (*errors.shape[:-2], 2, errors.shape[-1])
        later = errors.new_zeros(shape)
        for k in reversed(range(self.noise.blocks)):
            error, r = errors.select(-3, k), later.select(-3, k)
            error -= self.onward.select(-3, k).mT @ r
            if k:
                begin = self.begin.select(-3, k)
                later.select(-3, k - 1).copy_(begin.mT @ error + power.mT @ r)
        force = lagged.mT @ (self.unroot.mT @ errors) + ends.mT @ later
        return self.noise.paths(_joined(force, self.noise.frames)[..., :-1, :])

    @cached_property
    def variance(self) -> Float[Tensor, "*#pattern frame"]:
        """Var[n | x] of every frame."""
        free, lagged, power, ends = _parts(self.noise)
        path = free @ self.state @ free.mT + lagged @ lagged.mT
        white = self.unroot @ (_cut(self.seen[..., None].to(path), self.noise) * path)
        next_ = power @ self.state @ free.mT + ends @ lagged.mT - self.onward @ white
        closed = power - self.onward @ self.begin
        gain, later = self.begin.mT @ self.begin, torch.zeros_like(self.state)
        for k in reversed(range(1, self.noise.blocks)):
            move, n = closed.select(-3, k), later.select(-3, k)
            later.select(-3, k - 1).copy_(gain.select(-3, k) + move.mT @ n @ move)
        known = white.square().sum(-2) + (next_ * (later @ next_)).sum(-2)
        found = path.diagonal(dim1=-2, dim2=-1) - known
        return _joined(found[..., None], self.noise.frames)[..., 0].clamp_min(0)

    def _errors(self, x: Tensor) -> Float[Tensor, "*#pattern block step column"]:
        """L⁻¹ (x − O a) of every block."""
        power = _parts(self.noise)[2]
        errors = self._unrooted(_cut(x, self.noise))
        state = errors.new_zeros(*errors.shape[:-3], 2, errors.shape[-1])
        parts = (v.unbind(-3) for v in (errors, self.begin, self.onward))
        for error, begin, onward in zip(*parts, strict=True):
            error -= begin @ state
            state = power @ state + onward @ error
        return errors

    def _unrooted(
        self, blocks: Float[Tensor, "*#pattern block step column"]
    ) -> Float[Tensor, "*#pattern block step column"]:
        """L⁻¹ of every block by itself; all ρ in one product where x is the same for them."""
        if self.unroot.ndim == 4 or blocks.ndim > 4:
            return self.unroot @ blocks
        ratios, size = self.unroot.shape[0], self.unroot.shape[-1]
        rows = self.unroot.movedim(0, -3).flatten(-3, -2)
        both: Tensor = (rows @ blocks).unflatten(-2, (ratios, size))
        return both.movedim(-3, 0)


@lru_cache(maxsize=64)
def _parts(noise: PathNoise) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """O, N, Φ and Γ of a block: its frames and the next state, of its first state and ε."""
    step = Response.of(noise.system, noise.block)
    power = torch.linalg.matrix_power(transition_matrix(noise.system), noise.block)
    free, lagged = step.matrix[0, :, :2], step.matrix[0, :, 2:]
    return free, lagged / noise.scale, power, step.ends / noise.scale


def _cut(x: Tensor, noise: PathNoise) -> Float[Tensor, "*#pattern block step column"]:
    short = noise.blocks * noise.block - noise.frames
    full: Tensor = pad(x, (0, 0, 0, short)) if short else x
    blocks: Tensor = full.unflatten(-2, (noise.blocks, noise.block))
    return blocks


def _joined(x: Tensor, frames: int) -> Float[Tensor, "*#pattern frame column"]:
    whole: Tensor = x.flatten(-3, -2)
    return whole[..., :frames, :]
