r"""Gaussian mixtures over latent limit cycles of unknown timing, given the frames observed.

    z = Φ(τ) u + r,   r ~ GP(0, ν N),   y_t ~ N(z_t, E)
    τ ~ equally likely timings,   u ~ 1/M Σ_i N(ū + √(1−h²)(u_i − ū), B)
    B = h² ((1−λ) Cov(u) + λ diag Var(u))

Φ is the response of the transformation system, long settled, to forcing weights and goal; N the
stationary covariance of what such cycles leave of the movements known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.movement.components import resample
from zoo.movement.gaussian_paths import block_diagonal, cholesky, stationary, stationary_draws
from zoo.movement.kernel_mixture import KernelMixture
from zoo.movement.paths import Readout

__all__ = ["Cycle", "CyclePrior", "Cycles", "Glimpse"]

DRAWS = 64
ROWS = 16


@dataclass(frozen=True)
class CyclePrior(KernelMixture):
    """The mixture: one component for every timing and every known movement's parameters u_i."""

    designs: Float[Tensor, "timing time row"]
    parameters: Float[Tensor, "movement row latent"]
    residuals: Float[Tensor, "recording frame latent"]
    observation: Float[Tensor, "latent latent"]

    grids: ClassVar[Mapping[str, Sequence[float]]] = {
        "bandwidth": (0.1, 0.3, 0.6, 1.0),
        "shrinkage": (0.01, 0.1, 0.5),
        "process": (0.1, 0.3, 1.0),
    }
    judged: ClassVar[int] = 4

    @property
    def means(self) -> Float[Tensor, "movement parameter"]:
        """Means of u."""
        return self.centred(self.parameters.flatten(1))

    @property
    def root(self) -> Float[Tensor, "parameter parameter"]:
        """A Cholesky factor of B; weights of all kernels have one variance."""
        u = self.parameters
        apart = u - u.mean(0) if len(u) > 1 else u
        size = apart.square().mean(0)
        size[:-1] = size[:-1].mean(0)
        independent = torch.diag(size.flatten())
        shared = apart.flatten(1).mT @ apart.flatten(1) / max(1, len(u) - 1)
        mixed = torch.lerp(shared, independent, self.shrinkage if len(u) > 1 else 1.0)
        return self.bandwidth * cholesky(mixed)

    def glimpse(
        self, where: Bool[Tensor, " time"], extra: Float[Tensor, "time latent latent"] | None = None
    ) -> Glimpse:
        """What the frames ``where`` can tell, whatever they show; ``extra`` observation noise."""
        return Glimpse.of(self, where, extra)

    def condition(
        self,
        seen: Float[Tensor, "sequence time latent"],
        where: Bool[Tensor, " time"],
        extra: Float[Tensor, "sequence time latent latent"] | None = None,
    ) -> Cycles:
        """p(z_{1:T} | y_t, t where seen); ``extra`` noise costs a factorisation a sequence."""
        if extra is None:
            shared = self.glimpse(where)
            return Cycles([self.given(shared, part) for part in seen.split(ROWS)])
        each = zip(seen, extra, strict=True)
        return Cycles([self.given(self.glimpse(where, e), y[None]) for y, e in each])

    def given(self, glimpse: Glimpse, seen: Float[Tensor, "sequence time latent"]) -> Cycle:
        """Weights of all components and their posteriors."""
        y, m, root = glimpse.white(seen), self.means, self.root
        G, b = glimpse.gram, torch.einsum("jap,na->njp", glimpse.designs, y)
        eye = torch.eye(len(root), dtype=root.dtype, device=root.device)
        inner = torch.linalg.cholesky(eye + root.mT @ G @ root)
        against = torch.einsum("jpq,mq->jmp", G, m)
        apart = b.unsqueeze(2) - against
        told = torch.linalg.solve_triangular(inner, root.mT @ apart.mT, upper=False)
        size = (m * against).sum(-1) - 2 * torch.einsum("njp,mp->njm", b, m)
        volume = inner.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Cycle(
            prior=self,
            glimpse=glimpse,
            seen=seen,
            inner=inner,
            told=told,
            log_weights=(told.square().sum(2) - size) / 2 - volume[:, None],
        )

    def tuned(
        self,
        paths: Float[Tensor, "movement time latent"],
        seen: Sequence[int],
        readout: Readout,
        without: Callable[[int], Self],
    ) -> Self:
        """The h, λ and ν under which held-out ``paths`` are forecast best, after ``seen`` frames.

        ``readout`` judges draws frame by frame and channel by channel, as Gaussians. What depends
        on the movement, ν and the frames observed alone is kept.
        """
        time = torch.arange(paths.shape[1])
        known = dict[tuple[int, float, int], Glimpse]()

        def density(rest: CyclePrior, i: int, k: int) -> Tensor:
            at = (i, rest.process, k)
            known[at] = known[at] if at in known else rest.glimpse(time < k)
            drawn = rest.given(known[at], paths[i][None]).sample(DRAWS)[:, 0]
            return readout.of(i).density_of_draws(drawn - paths[i])

        return self.tuned_on(len(paths), seen, without, density)


@dataclass(frozen=True)
class Glimpse:
    """The frames observed, whitened by C = ν N + E: designs, and how r elsewhere follows."""

    rows: Int[Tensor, " seen"]
    unroot: Float[Tensor, "seen seen"]
    designs: Float[Tensor, "timing seen parameter"]
    gram: Float[Tensor, "timing parameter parameter"]
    follow: Float[Tensor, "seen path"]
    noise_root: Float[Tensor, "seen seen"]

    @classmethod
    def of(cls, prior: CyclePrior, where: Tensor, extra: Tensor | None) -> Self:
        """Factors of the covariance; the designs of every timing are whitened at once."""
        latent, time, count = len(prior.observation), len(where), int(where.sum())
        N = prior.process * stationary(prior.residuals, time).flatten(2).flatten(0, 1)
        rows = where.repeat_interleave(latent).nonzero()[:, 0]
        noise = prior.observation if extra is None else prior.observation + extra[where]
        factor = cholesky(N[rows][:, rows] + block_diagonal(noise, count))
        eye = torch.eye(len(rows), dtype=N.dtype, device=N.device)
        unroot = torch.linalg.solve_triangular(factor, eye, upper=False)
        split = unroot.unflatten(1, (-1, latent))
        white = torch.einsum("atl,jtr->jarl", split, prior.designs[:, where]).flatten(2)
        noise_root = block_diagonal(cholesky(noise), count)
        return cls(rows, unroot, white, white.mT @ white, unroot @ N[rows], noise_root)

    def white(self, y: Float[Tensor, "*batch time latent"]) -> Float[Tensor, "*batch seen"]:
        """What was observed, whitened."""
        whitened: Tensor = y.flatten(-2)[..., self.rows] @ self.unroot.mT
        return whitened


@dataclass(frozen=True)
class Cycle:
    """The mixture after some sequences were observed in the same frames."""

    prior: CyclePrior
    glimpse: Glimpse
    seen: Float[Tensor, "sequence time latent"]
    inner: Float[Tensor, "timing parameter parameter"]
    told: Float[Tensor, "sequence timing parameter movement"]
    log_weights: Float[Tensor, "sequence timing movement"]

    def sample(self, draws: int) -> Float[Tensor, "sample sequence time latent"]:
        """Joint draws of whole paths; r is drawn, then corrected by what was observed."""
        path, prior = self._cycles(draws), self.prior
        r = stationary_draws(prior.residuals, path.shape[2], (draws, len(self.seen)))
        path = path + prior.process**0.5 * r
        e = torch.randn(draws, len(self.seen), len(self.glimpse.rows), dtype=path.dtype)
        e = e @ (self.glimpse.unroot @ self.glimpse.noise_root).mT
        left = self.glimpse.white(self.seen - path) - e
        corrected: Tensor = path + (left @ self.glimpse.follow).view_as(path)
        return corrected

    def _cycles(self, draws: int) -> Float[Tensor, "sample sequence time latent"]:
        """Φ(τ) u."""
        movements = self.told.shape[3]
        picks = resample(self.log_weights.flatten(1).mT, draws)[torch.randperm(draws)]
        timing, movement = picks // movements, picks % movements
        row = torch.arange(len(self.seen)).expand_as(picks)
        told = self.told[row, timing, :, movement]
        white = (told + torch.randn_like(told))[..., None]
        back = torch.linalg.solve_triangular(self.inner.mT[timing], white, upper=True)[..., 0]
        u = self.prior.means[movement] + back @ self.prior.root.mT
        cycles: Tensor = self.prior.designs[timing] @ u.unflatten(-1, (-1, self.seen.shape[-1]))
        return cycles


@dataclass(frozen=True)
class Cycles:
    """Sequences one after the other."""

    parts: list[Cycle]

    def sample(self, draws: int) -> Float[Tensor, "sample sequence time latent"]:
        """Joint draws of whole paths."""
        return torch.cat([part.sample(draws) for part in self.parts], dim=1)
