r"""Movement primitives of components, seen through a linear map of them.

A movement has one primitive a component, and channels that are linear in the components::

    z = R θ + n,   n_k = σ_k N ε_k + τ_k η_k,   x_t = W z_t + μ + σ e_t,   ε, η, e ~ N(0, I)

The entries of a frame say as much of z_t as there are components. With the rows of W that are
observed W_M = Q U, where UᵀU = W_MᵀW_M::

    x̃_t = Qᵀ(x_t − μ) = U z_t + σ e,

and what is left of x_t is white whatever z is. Columns of W are orthogonal: as long as frames are
observed whole or not at all, U is diagonal and every component a *block* of its own. Frames with
some channels missing couple components; all are then one block. Both are exact, by a Cholesky
decomposition of the size of a block's x̃.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.models.primitives.kalman import PathNoise
from zoo.models.primitives.population import Population
from zoo.models.primitives.sufficient_statistics import Sums
from zoo.movement.components import Draw, Paths

__all__ = ["ComponentPaths", "GivenEntries", "Projection", "joined"]


@dataclass(frozen=True)
class ComponentPaths:
    """Moments of components at every time; ``draw`` gives so many joint draws of their paths."""

    mean: Float[Tensor, "sequence time latent"]
    covariance: Float[Tensor, "#sequence time latent latent"]
    draw: Draw


@dataclass(frozen=True)
class Projection:
    """W, μ and σ of the channels; variances of the path noise and the white noise of components.

    Columns of ``loading`` are orthogonal; one of zeros is a component that no channel shows.
    """

    loading: Float[Tensor, "channel latent"]
    mean: Float[Tensor, " channel"]
    noise: Float[Tensor, ""]
    force: Float[Tensor, " latent"]
    white: Float[Tensor, " latent"]

    def blocks(self, seen: Bool[Tensor, "*sequence time channel"]) -> int:
        """Number of blocks that components fall into: one, or each by itself."""
        partly = seen.any(-1) & ~seen.all(-1)
        return 1 if bool(partly.any()) else len(self.force)

    def shown(self, z: Float[Tensor, "*batch latent"]) -> Float[Tensor, "*batch channel"]:
        """W z + μ."""
        x: Tensor = z @ self.loading.T + self.mean
        return x

    def paths(self, z: ComponentPaths) -> Paths:
        """Moments and draws of W z + μ."""
        w, mean = self.loading, self.shown(z.mean)
        variance = torch.einsum("dk,stkj,dj->std", w, z.covariance, w).clamp_min(0)
        return Paths(mean, variance.expand_as(mean), lambda count: self.shown(z.draw(count)))

    def draw(
        self, noise: PathNoise, count: int, like: Float[Tensor, "sequence time latent"]
    ) -> Float[Tensor, "sample sequence time latent"]:
        """``count`` draws of n for components shaped ``like``."""
        path = self.force.sqrt() * noise.draw(count, like)
        return path + self.white.sqrt() * torch.randn_like(path)


@dataclass(frozen=True)
class GivenEntries:
    """z of movements given the entries ``seen``, at one timing, by blocks of components."""

    projection: Projection
    noise: PathNoise
    design: Float[Tensor, "time parameter"]
    seen: Bool[Tensor, "time channel"]
    blocks: int

    def sums(self, x: Float[Tensor, "sequence time channel"]) -> Sums:
        """What x − μ, 0 where not observed, says of θ: each block as one channel, in units of 1."""
        σ, own = self.projection.noise, self._observed(x)
        errors = torch.linalg.solve_triangular(self._root, own, upper=False)
        rest = (x.square().sum((1, 2)) - own.square().sum((0, 1))) / σ.square()
        known = float(self.seen.sum())
        spare = (known - own.shape[:2].numel()) * σ.log()
        volume = self._root.diagonal(dim1=-2, dim2=-1).log().sum(-1) + spare / self.blocks
        linear = (self._white.mT @ errors).movedim(-1, 0)
        square = errors.square().sum(1).T + rest[:, None] / self.blocks
        count = torch.full_like(square, known / self.blocks)
        precision = (self._white.mT @ self._white)[None]
        return Sums(precision, linear, square, count, volume.expand_as(square))

    def paths(self, x: Float[Tensor, "sequence time channel"], p: Population) -> ComponentPaths:
        """Moments and draws of z given x − μ, with θ of the distribution ``p`` given x."""
        follow = self._gain @ self._observed(x)
        mean = self._unfolded(self._moved(p.mean) + follow.movedim(-1, 0))

        def draw(count: int) -> Tensor:
            fresh = self.projection.draw(self.noise, count, mean)
            white = torch.randn(*fresh.shape[:-1], x.shape[-1], dtype=x.dtype)
            pseudo = fresh @ self.projection.loading.T + self.projection.noise * white
            seen = self._observed((pseudo * self.seen).flatten(0, 1))
            pull = self._unfolded((follow.repeat(1, 1, count) - self._gain @ seen).movedim(-1, 0))
            moved = self._unfolded(self._moved(p.sample(count)))
            return fresh + moved + pull.reshape(fresh.shape)

        return ComponentPaths(mean, self._covariance(p), draw)

    def _moved(
        self, θ: Float[Tensor, "*batch block parameter"]
    ) -> Float[Tensor, "*batch block path"]:
        return torch.einsum("bzp,...bp->...bz", self._given, θ)

    def _covariance(self, p: Population) -> Float[Tensor, "#sequence time latent latent"]:
        """Of all components at every time."""
        together = self._unfolded((self._given @ p.loadings).movedim(-1, 0))
        shared = torch.einsum("f...tk,f...tj->...tkj", together, together)
        alone = (self._given @ p.private).unflatten(-2, (-1, self.noise.frames))
        within = torch.einsum("...bktq,...bjtq->...btkj", alone, alone)
        gain = self._gain.unflatten(1, (-1, self.noise.frames))
        known = torch.einsum("bktn,bjtn->btkj", gain, self._cross)
        prior = torch.diag_embed(self._process.diagonal(dim1=-2, dim2=-1).mT)
        block = within + prior - known
        eye = torch.eye(self.blocks, dtype=block.dtype)
        apart = torch.einsum("...btkj,bc->...tbkcj", block, eye)
        total: Tensor = shared + apart.flatten(-4, -3).flatten(-2)
        return total if total.ndim == 4 else total[None]

    @cached_property
    def _map(self) -> tuple[Float[Tensor, "some channel latent"], Tensor]:
        """Q and, by blocks, U of the frames where anything is observed."""
        w, known = self.projection.loading, self.seen[self._frames]
        if self.blocks == 1:
            axes, root = torch.linalg.qr(w * known[..., None])
            return axes, root[None]
        size = torch.linalg.vector_norm(w, dim=0)
        axes = w / torch.where(size > 0, size, 1.0)
        root = size[:, None, None, None].expand(-1, len(known), 1, 1)
        return axes.expand(len(known), *w.shape), root

    @property
    def _frames(self) -> Bool[Tensor, " time"]:
        return self.seen.any(-1)

    def _observed(
        self, x: Float[Tensor, "sequence time channel"]
    ) -> Float[Tensor, "block row sequence"]:
        """x̃ of every block."""
        own = torch.einsum("std,tdk->tks", x[:, self._frames], self._map[0])
        parts: Tensor = own.unflatten(1, (self.blocks, -1)).movedim(1, 0).flatten(1, 2)
        return parts

    def _unfolded(
        self, z: Float[Tensor, "*batch block row"]
    ) -> Float[Tensor, "*batch time latent"]:
        """Blocks side by side."""
        components: Tensor = z.unflatten(-1, (-1, self.noise.frames)).flatten(-3, -2)
        return components.mT

    @cached_property
    def _process(self) -> Float[Tensor, "block part time time"]:
        """Covariance of n."""
        frames, p = self.noise.frames, self.projection
        path = self.noise.respond(torch.eye(frames - 1, dtype=p.force.dtype))
        white = p.white[:, None, None] * torch.eye(frames, dtype=p.force.dtype)
        each: Tensor = p.force[:, None, None] * (path @ path.mT) + white
        blocks: Tensor = each.unflatten(0, (self.blocks, -1))
        return blocks

    @cached_property
    def _cross(self) -> Float[Tensor, "block part time row"]:
        """Covariance of z and x̃."""
        own = self._process[..., self._frames]
        cross: Tensor = torch.einsum("bkts,bsjk->bktsj", own, self._map[1]).flatten(-2)
        return cross

    @cached_property
    def _root(self) -> Float[Tensor, "block row row"]:
        """L of the covariance L Lᵀ of x̃ given θ."""
        own = self._cross[:, :, self._frames]
        total = torch.einsum("btik,bktn->btin", self._map[1], own).flatten(1, 2)
        eye = torch.eye(total.shape[-1], dtype=total.dtype)
        root: Tensor = torch.linalg.cholesky(total + self.projection.noise.square() * eye)
        return root

    @cached_property
    def _seen_design(self) -> Float[Tensor, "block row parameter"]:
        """What x̃ is of θ."""
        own = self.design[self._frames]
        rows: Tensor = torch.einsum("btik,tp->btikp", self._map[1], own).flatten(-2).flatten(1, 2)
        return rows

    @cached_property
    def _white(self) -> Float[Tensor, "block row parameter"]:
        white: Tensor = torch.linalg.solve_triangular(self._root, self._seen_design, upper=False)
        return white

    @cached_property
    def _gain(self) -> Float[Tensor, "block path row"]:
        """Of x̃ in z."""
        return torch.cholesky_solve(self._cross.flatten(1, 2).mT, self._root).mT

    @cached_property
    def _given(self) -> Float[Tensor, "block path parameter"]:
        """What θ adds to E[z | θ, x]."""
        eye = torch.eye(self._process.shape[1], dtype=self.design.dtype)
        own = torch.einsum("kl,tp->ktlp", eye, self.design).flatten(2).flatten(0, 1)
        return own - self._gain @ self._seen_design


def joined(p: Population) -> Population:
    """The same distribution, with all channels as one."""
    private = torch.block_diag(*p.private)
    return Population(p.mean.flatten()[None], p.loadings.flatten(0, 1)[None], private[None])
