"""The posterior of latent coordinates of single frames, by Laplace's approximation at its mode."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

from zoo.nn.metric import jacobians

__all__ = ["laplace"]

ITERATIONS, DAMPING = 50, 1e-2
ALIKE, ENOUGH = 2.0, 6.0


def laplace(
    decode: Callable[[Tensor], Tensor],
    start: Float[Tensor, "frame latent"],
    x: Float[Tensor, "frame channel"],
    std: Float[Tensor, "*#frame channel"],
    *,
    restarts: int = 16,
    near: bool = True,
) -> MultivariateNormal:
    r"""p(z | x) of z ~ N(0, I), x ~ N(decode(z), diag std²), as a Gaussian at its mode.

    Entries whose ``std`` is infinite count as missing. Modes are sought by Levenberg and
    Marquardt's method from ``start`` and from ``restarts`` draws of the prior. Of those that miss x
    by no more than twice what the best does, or by six standard deviations, the nearest to
    ``start`` is taken: what a decoder maps alike is told apart by that. Without ``near`` it is the
    best. The covariance is (I + JᵀJ/σ²)⁻¹ with the Jacobian J of ``decode`` there (Gauss and
    Newton). An amortised encoder knows only frames like those of the training; this asks the
    decoder itself.

    >>> known = laplace(lambda z: 2 * z, torch.zeros(1, 1), torch.ones(1, 1), torch.ones(1))
    >>> round(float(known.mean), 3), round(float(known.covariance_matrix), 3)
    (0.4, 0.2)
    """
    begin = torch.cat([start[None], torch.randn(restarts, *start.shape).to(start)])
    every = (x.repeat(1 + restarts, 1), std.expand_as(x).repeat(1 + restarts, 1))
    z = _modes(decode, begin.flatten(0, 1), *every)
    losses = _loss(decode, z, *every).view(1 + restarts, -1)
    enough = losses.amin(0)
    if near:
        enough = (ALIKE**2 * enough).clamp(min=ENOUGH**2 * x.shape[-1])
    apart = (z.view(begin.shape) - start).square().sum(-1)
    apart = apart.masked_fill(losses > enough, torch.inf)
    best = apart.argmin(0)[None, :, None].expand(1, *start.shape)
    mode = z.view(begin.shape).gather(0, best)[0]
    return MultivariateNormal(mode.detach(), scale_tril=_root(decode, mode, std).detach())


def _root(
    decode: Callable[[Tensor], Tensor],
    z: Float[Tensor, "frame latent"],
    std: Float[Tensor, "*#frame channel"],
) -> Float[Tensor, "frame latent latent"]:
    """A Cholesky factor of (I + JᵀJ/σ²)⁻¹, in float64 inside: JᵀJ/σ² may be 1e8 and more."""
    J = jacobians(decode, z).double() / std[..., None].double()
    precision = J.mT @ J + torch.eye(z.shape[-1], dtype=J.dtype, device=J.device)
    flipped = torch.linalg.cholesky((precision + precision.mT).flip(-2, -1) / 2)
    upper = flipped.flip(-2, -1)
    eye = torch.eye(z.shape[-1], dtype=J.dtype, device=J.device).expand_as(upper)
    root: Tensor = torch.linalg.solve_triangular(upper.mT, eye, upper=False)
    return root.to(z)


def _modes(
    decode: Callable[[Tensor], Tensor],
    z: Float[Tensor, "frame latent"],
    x: Float[Tensor, "frame channel"],
    std: Float[Tensor, "frame channel"],
) -> Float[Tensor, "frame latent"]:
    damping = z.new_full((len(z), 1, 1), DAMPING)
    eye, loss = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device), _loss(decode, z, x, std)
    for _ in range(ITERATIONS):
        J = jacobians(decode, z) / std[..., None]
        slope = z - (J.mT @ ((x - decode(z)) / std)[..., None])[..., 0]
        curvature = J.mT @ J + eye
        size = curvature.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        step = torch.linalg.solve(curvature + damping * size * eye, slope)
        tried = _loss(decode, z - step, x, std)
        better = tried < loss
        z, loss = torch.where(better[:, None], z - step, z), torch.where(better, tried, loss)
        damping = torch.where(better[:, None, None], damping / 5, damping * 5).clamp(1e-9, 1e6)
    return z


def _loss(decode: Callable[[Tensor], Tensor], z: Tensor, x: Tensor, std: Tensor) -> Tensor:
    return ((x - decode(z)) / std).square().sum(-1) + z.square().sum(-1)
