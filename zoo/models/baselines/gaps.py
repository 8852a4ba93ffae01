"""Gaps filled in from the places of training movements that look most alike around them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.models.baselines.analogues import alignment_cost
from zoo.models.baselines.re_entry import Library, Places, dips

__all__ = ["Gaps"]


@dataclass(frozen=True)
class Gaps:
    """Frames are compared with weights exp(−distance/``decay``), in frames."""

    library: Library
    decay: float

    def filled(
        self,
        x: Float[Tensor, "time channel"],
        mask: Bool[Tensor, "time channel"],
        allowed: Bool[Tensor, " movement"],
        neighbours: int,
    ) -> Float[Tensor, "2 neighbour time channel"]:
        """For every frame the frames where the movement around it fits best, as they are and moved.

        Moved is by what each place lies below the frames observed around it, near ones first, in
        channels that have gaps and observed entries.
        """
        whole, weight = self.library, self._weight(x)
        cost = alignment_cost(x, mask, whole.values, whole.seen, whole.lengths, weight)
        places = dips(cost.masked_fill(~allowed[:, None], torch.inf), neighbours)
        time = torch.arange(len(x), device=x.device)[:, None]
        lag = places.frame - (len(x) - 1)
        frames = whole.values[places.movement, lag + time]
        moved, some = frames.clone(), mask.any(0) & ~mask.all(0)
        if bool(some.any()):
            lags = Places(places.movement, lag)
            moved[..., some] += self._below(x[:, some], mask[:, some], lags, weight, some)
        return torch.stack([frames, moved]).transpose(1, 2)

    def _below(
        self, x: Tensor, mask: Tensor, lags: Places, weight: Tensor, channels: Tensor
    ) -> Float[Tensor, "time neighbour channel"]:
        partner = lags.frame[..., None] + torch.arange(len(x), device=x.device)
        ends = self.library.lengths[lags.movement][..., None]
        inside = ((partner >= 0) & (partner < ends))[..., None] & mask
        index = torch.minimum(partner.clamp(min=0), ends - 1)
        near = self.library.values[..., channels][lags.movement[..., None], index]
        share = weight[:, None, :, None] * inside
        below = (share * (x - near)).sum(2)
        return below / share.sum(2).clamp(min=torch.finfo(x.dtype).tiny)

    def _weight(self, x: Float[Tensor, "time channel"]) -> Float[Tensor, "time time"]:
        time = torch.arange(len(x), dtype=x.dtype, device=x.device)
        return torch.exp(-(time[:, None] - time).abs() / self.decay)
