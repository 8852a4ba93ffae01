r"""One period of a rhythmic movement as a Fourier series, and the timing at which movements fit it.

T(s) = a_0 + Σ_h a_h cos hs + b_h sin hs,   s_t = φ + 2π e^λ t / P

φ is the phase of a movement at its first frame, λ the log of its tempo over the usual one of a
period of P frames.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.movement.timing import aligned

__all__ = ["ROWS", "fourier", "learn_template", "match"]

HARMONICS = 5
ROWS = 2 * HARMONICS + 1
DIRECTIONS = 16
TEMPOS = (0.0, -0.07, 0.07, -0.14, 0.14, -0.21, 0.21)
FRAMES_A_PERIOD = 24
ROUNDS, NEWTON = 5, 6
TEMPO_STD = 0.1
RIDGE = 1e-6


def fourier(s: Float[Tensor, "*time"], harmonics: int = HARMONICS) -> Float[Tensor, "*time row"]:
    """1, cos hs and sin hs.

    >>> fourier(torch.zeros(2), 1)
    tensor([[1., 1., 0.],
            [1., 1., 0.]])
    """
    turns = s[..., None] * torch.arange(1, harmonics + 1, dtype=s.dtype, device=s.device)
    return torch.cat([torch.ones_like(s)[..., None], turns.cos(), turns.sin()], dim=-1)


def learn_template(
    x: Float[Tensor, "sequence time channel"],
    mask: Bool[Tensor, "sequence time channel"],
    period: float,
) -> Float[Tensor, "row channel"]:
    """T of some movements: of the one with most entries observed first, then of all in turn."""
    first = int(mask.sum((1, 2)).argmax())
    still = x.new_zeros(1, 2)

    def fitted(timing: Tensor) -> Tensor:
        return _fitted(x, mask, timing, period)

    alone = _fitted(x[first, None], mask[first, None], still, period)
    return fitted(aligned(alone, fitted, lambda template: match(x, mask, template, period), ROUNDS))


def match(
    x: Float[Tensor, "sequence time channel"],
    mask: Bool[Tensor, "sequence time channel"] | None,
    template: Float[Tensor, "row channel"],
    period: float,
) -> Float[Tensor, "sequence 2"]:
    """φ and λ of the least squares: the best of a grid, then steps of Gauss and Newton.

    λ has a prior of 0.1, so that a movement far shorter than a period keeps the usual tempo.
    """
    step = max(1, int(period / FRAMES_A_PERIOD))
    x = x[:, ::step]
    seen = torch.ones_like(x) if mask is None else mask[:, ::step].to(x)
    turn = 2 * math.pi / period * step * torch.arange(x.shape[1], dtype=x.dtype, device=x.device)
    φ, λ = _nearest(x * seen, seen, template, turn)
    for _ in range(NEWTON):
        φ, λ = _improved(φ, λ, x, seen, template, turn)
    return torch.stack([torch.remainder(φ + math.pi, 2 * math.pi) - math.pi, λ], dim=1)


def _fitted(x: Tensor, mask: Tensor, timing: Tensor, period: float) -> Float[Tensor, "row channel"]:
    t = torch.arange(x.shape[1], dtype=x.dtype, device=x.device)
    rows = fourier(timing[:, :1] + 2 * math.pi / period * timing[:, 1:].exp() * t)
    gram = torch.einsum("stc,str,stq->crq", mask.to(x), rows, rows)
    eye = torch.eye(gram.shape[1], dtype=x.dtype, device=x.device)
    linear = torch.einsum("stc,str->cr", x * mask, rows)
    template: Tensor = torch.linalg.solve(gram + RIDGE * x.shape[1] * eye, linear[..., None])
    return template[..., 0].T


def _nearest(x: Tensor, seen: Tensor, template: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    φ = torch.arange(DIRECTIONS, dtype=x.dtype, device=x.device) * (2 * math.pi / DIRECTIONS)
    λ = torch.tensor(TEMPOS, dtype=x.dtype, device=x.device)
    s = φ[:, None, None] + λ.exp()[:, None] * turn
    paths = (fourier(s) @ template).flatten(0, 1).flatten(1)
    cost = seen.flatten(1) @ paths.square().T - 2 * x.flatten(1) @ paths.T
    best = cost.argmin(1)
    return φ[best // len(λ)], λ[best % len(λ)]


def _improved(
    φ: Tensor, λ: Tensor, x: Tensor, seen: Tensor, template: Tensor, turn: Tensor
) -> tuple[Tensor, Tensor]:
    """One step towards the least squares, at most about half of the grid's width."""
    along = λ.exp()[:, None] * turn
    rows = fourier(φ[:, None] + along)
    error, slope = seen * (x - rows @ template), seen * (_derivative(rows) @ template)
    weight = torch.stack([torch.ones_like(along), along], dim=-1)
    gram = torch.einsum("st,sti,stj->sij", slope.square().sum(-1), weight, weight)
    pull = torch.einsum("st,sti->si", (slope * error).sum(-1), weight)
    noise = error.square().sum((1, 2)) / seen.sum((1, 2)).clamp(min=1) / TEMPO_STD**2
    gram = gram + torch.diag_embed(torch.stack([RIDGE + 0 * noise, RIDGE + noise], dim=1))
    pull = pull - torch.stack([0 * noise, noise * λ], dim=1)
    move = torch.linalg.solve(gram, pull[..., None])[..., 0]
    half = math.pi / DIRECTIONS
    return φ + move[:, 0].clamp(-half, half), λ + move[:, 1].clamp(-0.05, 0.05)


def _derivative(rows: Float[Tensor, "*time row"]) -> Float[Tensor, "*time row"]:
    """dT/ds has the rows 0, −h sin hs, h cos hs."""
    count = rows.shape[-1] // 2
    h = torch.arange(1, count + 1, dtype=rows.dtype, device=rows.device)
    still, cos, sin = rows.split([1, count, count], dim=-1)
    return torch.cat([torch.zeros_like(still), -h * sin, h * cos], dim=-1)
