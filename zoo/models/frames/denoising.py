"""Latent states of frames with missing entries: a Markov chain through encoder and decoder."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.distributions import Normal

__all__ = ["Decode", "Encode", "conditional_draws"]

Decode = Callable[[Tensor], tuple[Tensor, Tensor]]
Encode = Callable[[Tensor], Normal]


def conditional_draws(
    decode: Decode,
    encode: Encode,
    values: Float[Tensor, "item channel"],
    mask: Bool[Tensor, "item channel"],
    latent: int,
    *,
    draws: int,
    chains: int,
    burn_in: int,
) -> Float[Tensor, "sample item latent"]:
    """Draws of p(z | x_seen) for z ~ N(0, I), x ~ N(μ(z), σ²(z)) given by ``decode``.

    Every chain starts at a draw of the prior and alternates z ~ q(z | x_seen, x_missing) with
    x_missing ~ p(x_missing | z) (Rezende et al. 2014, appendix F). After half of ``burn_in`` the
    draw of z is a Metropolis proposal, so that what the encoder gets wrong is put right (Mattei &
    Frellsen 2018). Kept are the steps after ``burn_in``, one draw of each chain a step; the
    chains differ by at least what the posterior spreads, since they start wider than it.
    """
    for name, number, least in (
        ("draws", draws, 1),
        ("chains", chains, 1),
        ("burn_in", burn_in, 0),
    ):
        if number < least:
            raise ValueError(f"{name} must be at least {least}; got {number}")
    chains = min(chains, draws)
    z = values.new_empty(chains, len(values), latent).normal_()
    moments = decode(z)
    kept: list[Tensor] = []
    for step in range(burn_in + -(-draws // chains)):
        x = torch.where(mask, values, Normal(*moments).sample())
        q = encode(x)
        proposal = q.sample()
        proposed = decode(proposal)
        if step >= burn_in // 2:
            gain = _weight(x, proposal, proposed, q) - _weight(x, z, moments, q)
            accepted = gain.exp() > torch.rand_like(gain)
            proposal = torch.where(accepted[..., None], proposal, z)
            proposed = _choose(accepted, proposed, moments)
        z, moments = proposal, proposed
        if step >= burn_in:
            kept.append(z)
    return torch.cat(kept)[:draws]


def _weight(x: Tensor, z: Tensor, moments: tuple[Tensor, Tensor], q: Normal) -> Tensor:
    """log p(x, z) − log q(z | x) of every item."""
    log_likelihood = Normal(*moments).log_prob(x).sum(-1)
    log_prior = Normal(torch.zeros_like(z), 1.0).log_prob(z).sum(-1)
    weight: Tensor = log_likelihood + log_prior - q.log_prob(z).sum(-1)
    return weight


def _choose(
    accepted: Tensor, new: tuple[Tensor, Tensor], old: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    pick = accepted[..., None]
    return torch.where(pick, new[0], old[0]), torch.where(pick, new[1], old[1])
