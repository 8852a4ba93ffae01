"""How far a decoder moves its output for a step in latent space: Jacobians and their metric."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["jacobians", "pullback_metric", "sensitivity"]

BLOCK = 2048


def jacobians(
    decode: Callable[[Tensor], Tensor], z: Float[Tensor, "point latent"]
) -> Float[Tensor, "point channel latent"]:
    """J = dx/dz at every point, one forward derivative for each latent dimension, batched.

    >>> jacobians(lambda z: z @ torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 3.0]]), torch.zeros(1, 2))
    tensor([[[1., 0.],
             [2., 0.],
             [0., 3.]]])
    """
    each: Tensor = torch.func.vmap(torch.func.jacfwd(decode))(z)
    return each


def pullback_metric(
    decode: Callable[[Tensor], Tensor], z: Float[Tensor, "point latent"]
) -> Float[Tensor, "point latent latent"]:
    """G = JᵀJ: ‖dx‖² = dzᵀ G dz.

    Arvanitidis, Hansen & Hauberg, *Latent space oddity*, ICLR 2018.

    >>> pullback_metric(lambda z: 3 * z, torch.zeros(1, 2))
    tensor([[[9., 0.],
             [0., 9.]]])
    """
    J = jacobians(decode, z)
    return J.mT @ J


def sensitivity(
    decode: Callable[[Tensor], Tensor], z: Float[Tensor, "*grid latent"]
) -> Float[Tensor, "*grid"]:
    """‖dx/dz‖, the Frobenius norm of the Jacobian, at every point of a grid (§6.3.1.2, Fig. 49).

    >>> sensitivity(lambda z: 3 * z, torch.zeros(2, 2, 1))
    tensor([[3., 3.],
            [3., 3.]])
    """
    with torch.no_grad():
        parts = z.flatten(0, -2).split(BLOCK)
        norms = [torch.linalg.matrix_norm(jacobians(decode, part)) for part in parts]
    return torch.cat(norms).view(z.shape[:-1])
