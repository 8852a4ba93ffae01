"""Latent dimensions that the posterior leaves at their prior."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from pyro.distributions import ExpandedDistribution, MaskedDistribution
from torch import Tensor
from torch.distributions import Independent

from zoo.errors import PosteriorCollapseWarning
from zoo.inference.elbo import Program, Site, Sites, divergences, sites
from zoo.types import Batch

__all__ = ["collapsed", "warn_of_collapse"]

_NATS = 0.01


@torch.no_grad()
def collapsed(model: Program, guide: Program, batch: Batch) -> dict[str, list[int]]:
    """Sites whose posterior is the prior within 0.01 nats a datum, with the dimensions concerned.

    Sites whose KL is not known dimension by dimension are judged whole and list no dimensions.
    """
    drawn = sites(model, guide, batch)
    found = {name: _dead(drawn, name) for name in drawn.guide if name in drawn.model}
    return {name: dims for name, dims in found.items() if dims is not None}


def warn_of_collapse(model: Program, guide: Program, batch: Batch) -> None:
    """Name the sites and dimensions that carry nothing, in one warning."""
    found = collapsed(model, guide, batch)
    names = ", ".join(f"{name} {dims or ''}".strip() for name, dims in found.items())
    if names:
        warnings.warn(
            f"the posterior equals the prior in {names}: these latent dimensions carry nothing; "
            "try fewer of them, a warm-up of the KL, or a smaller observation noise",
            PosteriorCollapseWarning,
            stacklevel=2,
        )


def _dead(drawn: Sites, name: str) -> list[int] | None:
    q, p = drawn.guide[name], drawn.model[name]
    kl = _elementwise(q, p)
    if kl is None:
        total = divergences(Sites({name: p}, {name: q}))[name] / q["scale"]
        rows = max(1, q["fn"].batch_shape.numel())
        return [] if float(total.abs()) / rows < _NATS else None
    dims: list[int] = torch.nonzero(kl < _NATS).flatten().tolist()
    return dims or None


def _elementwise(q: Site, p: Site) -> Tensor | None:
    """KL of each entry of the last axis: summed over the event's other axes, averaged over rows."""
    base_q, base_p = _base(q["fn"]), _base(p["fn"])
    try:
        kl = torch.distributions.kl_divergence(base_q, base_p)
    except NotImplementedError:
        return None
    shape = q["fn"].batch_shape + q["fn"].event_shape
    if not q["fn"].event_shape or base_q.event_shape:
        return None
    rows = q["fn"].batch_shape.numel()
    each: Tensor = kl.expand(shape).reshape(-1, shape[-1]).sum(0) / max(1, rows)
    return each


def _base(fn: Any) -> Any:
    while isinstance(fn, (Independent, ExpandedDistribution, MaskedDistribution)):
        fn = fn.base_dist
    return fn
