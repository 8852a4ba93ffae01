"""Transitions that are linear around every state: a mixture of matrices, its weights a network."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.nn.mlp import mlp

__all__ = ["LocallyLinear"]

STD = 0.02


class LocallyLinear(nn.Module):
    r"""z_{t+1} = A_t z_t + B_t a_t + C_t w_t with A_t = Σ_i α_i(z_t, a_t) A^(i), likewise B and C.

    α is the softmax of a network; every A^(i) starts near the identity, B^(i) near 0 and C^(i) at
    ``noise_scale`` times the identity. Thesis (85); Karl, Soelch, Bayer & van der Smagt, *Deep
    variational Bayes filters*, ICLR 2017.

    >>> moves = LocallyLinear(3, controls=1, bases=4)
    >>> z, w, a = torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2, 1)
    >>> bool((moves(z, w, a) == 0).all())
    True
    """

    def __init__(
        self,
        latent: int,
        *,
        controls: int = 0,
        bases: int = 16,
        hidden: int = 64,
        noise_scale: float = 0.1,
    ) -> None:
        """Matrices and their weights for ``latent`` coordinates and ``controls`` actions."""
        super().__init__()
        eye = torch.eye(latent).expand(bases, latent, latent)
        self.A = nn.Parameter(eye + STD * torch.randn(bases, latent, latent))
        self.C = nn.Parameter(noise_scale * eye.clone())
        self.controls = controls
        if controls:
            self.B = nn.Parameter(STD * torch.randn(bases, controls, latent))
        self.weights = mlp([latent + controls, hidden, bases], "tanh")

    def forward(
        self,
        z: Float[Tensor, "window latent"],
        w: Float[Tensor, "window latent"],
        action: Float[Tensor, "window control"] | None = None,
    ) -> Float[Tensor, "window latent"]:
        """The next state."""
        known = z if action is None else torch.cat([z, action], -1)
        α = torch.softmax(self.weights(known), -1)
        mixed = (α[:, :, None] * torch.cat([known, w], -1)[:, None]).flatten(1)
        return mixed @ self.matrices

    @property
    def matrices(self) -> Float[Tensor, "basis_and_input latent"]:
        """All A^(i), B^(i) and C^(i), for row vectors (z, a, w)."""
        parts = (self.A, self.B, self.C) if self.controls else (self.A, self.C)
        return torch.cat(parts, 1).flatten(0, 1)

    def path(
        self,
        start: Float[Tensor, "window latent"],
        noise: Float[Tensor, "window step latent"],
        actions: Float[Tensor, "window step control"] | None = None,
    ) -> Float[Tensor, "window time latent"]:
        """z_1 and the states that noise and actions lead to."""
        states = [start]
        for t in range(noise.shape[1]):
            action = None if actions is None else actions[:, t]
            states.append(self(states[-1], noise[:, t], action))
        return torch.stack(states, 1)
