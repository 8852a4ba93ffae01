"""The posterior of latent coordinates of single frames, by Laplace's approximation at its mode."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

__all__ = ["laplace"]

ITERATIONS, DAMPING = 50, 1e-2


def laplace(
    decode: Callable[[Tensor], Tensor],
    start: Float[Tensor, "frame latent"],
    x: Float[Tensor, "frame channel"],
    std: Float[Tensor, " channel"],
) -> MultivariateNormal:
    r"""p(z | x) of z ~ N(0, I), x ~ N(decode(z), diag std²), as a Gaussian at its mode.

    The mode is sought from ``start`` by Levenberg and Marquardt's method; the covariance is
    (I + JᵀJ/σ²)⁻¹ with the Jacobian J of ``decode`` there (Gauss–Newton). An amortised encoder
    knows only frames like those of the training; this asks the decoder itself.

    >>> known = laplace(lambda z: 2 * z, torch.zeros(1, 1), torch.ones(1, 1), torch.ones(1))
    >>> round(float(known.mean), 3), round(float(known.covariance_matrix), 3)
    (0.4, 0.2)
    """
    dtype = start.dtype
    jacobian = torch.func.vmap(torch.func.jacfwd(lambda z: decode(z) / std))
    z, damping = start, start.new_full((len(start), 1, 1), DAMPING)
    eye = torch.eye(start.shape[-1], dtype=dtype, device=start.device)
    loss = _loss(decode, z, x, std)
    for _ in range(ITERATIONS):
        J = jacobian(z)
        slope = z - (J.mT @ ((x - decode(z)) / std)[..., None])[..., 0]
        curvature = J.mT @ J + eye
        step = torch.linalg.solve(curvature + damping * curvature.abs().amax() * eye, slope)
        tried = _loss(decode, z - step, x, std)
        better = tried < loss
        z, loss = torch.where(better[:, None], z - step, z), torch.where(better, tried, loss)
        damping = torch.where(better[:, None, None], damping / 5, damping * 5).clamp(1e-9, 1e6)
    J = jacobian(z)
    return MultivariateNormal(z.detach(), precision_matrix=(J.mT @ J + eye).detach())


def _loss(decode: Callable[[Tensor], Tensor], z: Tensor, x: Tensor, std: Tensor) -> Tensor:
    return ((x - decode(z)) / std).square().sum(-1) + z.square().sum(-1)
