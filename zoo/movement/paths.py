"""Gaussian mixtures over whole latent paths, conditioned exactly on the frames observed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.movement.gaussian_paths import block_diagonal, cholesky, stationary
from zoo.movement.kernel_mixture import KernelMixture

__all__ = ["Conditioned", "PathPrior", "Readout"]

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class PathPrior(KernelMixture):
    r"""A mixture over paths z_{1:T} with a component around every known movement.

    p(z) = 1/M Σ_i N(z̄ + √(1−h²)(z_i − z̄), h² ((1−λ) S + λ R) + ν N): S is the covariance of the
    known paths z_i, R that of independent parameters pushed through the same linear response, N
    that of the stationary ``residuals`` which the response leaves. Observed frames are
    y_t ~ N(z_t, E).
    """

    paths: Float[Tensor, "movement time latent"]
    independent: Float[Tensor, "latent time time"]
    residuals: Float[Tensor, "movement time latent"]
    observation: Float[Tensor, "latent latent"]

    grids: ClassVar[Mapping[str, Sequence[float]]] = {
        "bandwidth": (0.1, 0.3, 0.6, 0.8, 1.0),
        "shrinkage": (0.01, 0.1, 0.5),
        "process": (0.03, 0.3, 1.0),
    }
    judged: ClassVar[int] = 8

    @classmethod
    def of_responses(
        cls,
        response: Float[Tensor, "time parameter"],
        parameters: Float[Tensor, "movement parameter latent"],
        variance: Float[Tensor, "parameter latent"],
        residuals: Float[Tensor, "movement time latent"],
        observation: Float[Tensor, "latent latent"],
        shape: Sequence[float] = (),
    ) -> Self:
        """The mixture around linear responses; ``shape`` is h, λ and ν where these are known."""
        independent = torch.einsum("tk,kd,sk->dts", response, variance, response)
        prior = cls(response @ parameters + residuals, independent, residuals, observation)
        return prior.shaped(shape)

    @property
    def means(self) -> Float[Tensor, "movement time latent"]:
        """Means of the components."""
        return self.centred(self.paths)

    @property
    def covariance(self) -> Float[Tensor, "time latent time latent"]:
        """Covariance that all components share."""
        movements = len(self.paths)
        shared = self.shrinkage * torch.einsum(
            "its,ij->tisj", self.independent, _eye(self.observation)
        )
        if movements > 1:
            apart = (self.paths - self.paths.mean(0)) / math.sqrt(movements - 1)
            shared = shared + (1 - self.shrinkage) * torch.einsum("mti,msj->tisj", apart, apart)
        return self.bandwidth**2 * shared + self.process * stationary(self.residuals)

    def condition(
        self,
        seen: Float[Tensor, "*batch time latent"],
        where: Bool[Tensor, " time"],
        extra: Float[Tensor, "*batch time latent latent"] | None = None,
    ) -> Conditioned:
        """p(z_{1:T} | y_t, t where seen): new means, weights and covariance.

        ``extra`` observation noise of some sequences costs a factorisation of each; without it one
        factorisation serves all.
        """
        time, latent = where.shape[0], self.observation.shape[0]
        full = self.covariance.reshape(time * latent, time * latent)
        rows = where.repeat_interleave(latent).nonzero()[:, 0]
        noise = self.observation if extra is None else self.observation + extra[..., where, :, :]
        factor = cholesky(full[rows][:, rows] + block_diagonal(noise, int(where.sum())))
        volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + len(rows) * HALF_LOG_2PI
        half = torch.linalg.solve_triangular(factor, full[rows], upper=False)
        means = self.means.flatten(1)
        apart = seen.flatten(-2)[..., None, rows] - means[:, rows]
        white = torch.linalg.solve_triangular(factor, apart.mT, upper=False).mT
        each = -0.5 * white.square().sum(-1)
        return Conditioned(
            means=(means + white @ half).unflatten(-1, (time, latent)),
            log_weights=torch.log_softmax(-0.5 * white.square().sum(-1), dim=-1),
            prior=full,
            known=half,
            log_evidence=each.logsumexp(-1) - math.log(len(means)) - volume,
        )

    def tuned(self, seen: Sequence[int], readout: Readout, without: Callable[[int], Self]) -> Self:
        """The h, λ and ν with the best density of held-out futures, after ``seen`` frames each.

        Exact densities, frame by frame and channel by channel, are read out along the path.
        """
        time = torch.arange(self.paths.shape[1])

        def density(rest: PathPrior, i: int, k: int) -> Tensor:
            return rest.condition(self.paths[i], time < k).log_density(self.paths[i], readout.of(i))

        return self.tuned_on(len(self.paths), seen, without, density)


@dataclass(frozen=True)
class Readout:
    """What frames show of a path, linear around it: x_t ~ N(J_t (z_t − z_i,t), diag σ²) + x_i,t."""

    jacobian: Float[Tensor, "*movement time channel latent"]
    std: Float[Tensor, " channel"]

    def of(self, movement: int) -> Readout:
        """The read-out along one of the movements."""
        return replace(self, jacobian=self.jacobian[movement])

    def density_of_draws(
        self, apart: Float[Tensor, "sample time latent"]
    ) -> Float[Tensor, "time channel"]:
        """Log density of the truth under draws that lie ``apart`` from its path, as Gaussians."""
        x = torch.einsum("tci,sti->stc", self.jacobian, apart)
        std = (x.var(0) + self.std.square()).sqrt()
        density: Tensor = torch.distributions.Normal(x.mean(0), std).log_prob(torch.zeros_like(std))
        return density


@dataclass(frozen=True)
class Conditioned:
    """A mixture over paths after frames were observed; all components share the covariance.

    That is the ``prior``'s less what is ``known``, knownᵀ known; ``log_evidence`` is the log
    density of the frames observed.
    """

    means: Float[Tensor, "*batch component time latent"]
    log_weights: Float[Tensor, "*batch component"]
    prior: Float[Tensor, "path path"]
    known: Float[Tensor, "*#batch seen path"]
    log_evidence: Float[Tensor, "*batch"]

    @property
    def covariance(self) -> Float[Tensor, "*#batch path path"]:
        """Covariance of whole paths, one for all sequences unless each has noise of its own."""
        covariance: Tensor = self.prior - self.known.mT @ self.known
        return covariance

    @property
    def frame_covariances(self) -> Float[Tensor, "time latent latent"]:
        """Covariance of every frame, of a single sequence."""
        time, latent = self.means.shape[-2:]
        blocks = self.prior.unflatten(-1, (time, latent)).unflatten(-3, (time, latent))
        told = self.known.unflatten(-1, (time, latent))
        own = blocks.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)
        left: Tensor = own - torch.einsum("rti,rtj->tij", told, told)
        return left

    def sample(self, draws: int) -> Float[Tensor, "sample *batch time latent"]:
        """Joint draws of whole paths."""
        time, latent = self.means.shape[-2:]
        picks = torch.distributions.Categorical(logits=self.log_weights).sample((draws,))
        means = self.means.expand(draws, *self.means.shape)
        index = picks[..., None, None, None].expand(*picks.shape, 1, time, latent)
        centre = means.gather(-3, index).squeeze(-3)
        white = torch.randn(*picks.shape, time * latent, dtype=self.prior.dtype)
        moved = white.movedim(0, -2) @ cholesky(self.covariance).mT
        path: Tensor = centre + moved.movedim(-2, 0).unflatten(-1, (time, latent))
        return path

    def log_density(
        self, path: Float[Tensor, "time latent"], readout: Readout
    ) -> Float[Tensor, "time channel"]:
        """Log marginal density of every channel of every frame, read out along a path."""
        J, each = readout.jacobian, self.frame_covariances
        variance = torch.einsum("tci,tij,tcj->tc", J, each, J) + readout.std.square()
        apart = torch.einsum("tci,mti->mtc", J, self.means - path)
        normal = torch.distributions.Normal(torch.zeros_like(apart), variance.sqrt())
        joint: Tensor = normal.log_prob(apart) + self.log_weights[:, None, None]
        return torch.logsumexp(joint, dim=0)


def _eye(matrix: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    return torch.eye(len(matrix), dtype=matrix.dtype)
