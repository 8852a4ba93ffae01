"""What the process noise ε (79) of a VAE-DMP carries: its divergence, its units, its share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.inference.elbo import sites
from zoo.inference.loader import whole
from zoo.movement.plan import Plan
from zoo.runs.run import Run
from zoo.streams import seeded
from zoo.types import Batch

__all__ = ["NoiseShare", "noise_share"]

ACTIVE = 0.01
DRAWS = 20


@dataclass(frozen=True)
class NoiseShare:
    """Of one movement: KL of ε in nats, its share of the KL of z, ż, goal and ε together (w is a
    point), latent dimensions of ε with more than 0.01 nats a frame, and the share of the path's
    variance over time that vanishes without ε.
    """

    nats: float
    of_divergence: float
    active: int
    of_variance: float


def noise_share(run: Run, data: Sequences, *, seed: int = 0) -> list[NoiseShare]:
    """The share of every movement, given whole, averaged over 20 draws of the guide.

    Raises ValueError for a run without the site ``epsilon``.
    """
    scaled = run.exchange.movements(data)
    with seeded(seed), torch.no_grad():
        return [_share(run, whole(scaled[i : i + 1])) for i in range(len(scaled))]


def _share(run: Run, batch: Batch) -> NoiseShare:
    found = [_drawn(run, batch) for _ in range(DRAWS)]
    noise, rest, path, still = (torch.stack(part).mean(0) for part in zip(*found, strict=True))
    nats = float(noise.sum())
    return NoiseShare(
        nats=nats,
        of_divergence=nats / (nats + float(rest)),
        active=int((noise / path.shape[0] > ACTIVE).sum()),
        of_variance=float((path - still).square().sum() / (path - path.mean(0)).square().sum()),
    )


def _drawn(run: Run, batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """KL of every dimension of ε, that of the other Gaussians, and paths with and without ε."""
    model: Any = run.model
    drawn = sites(model, run.assembly.guide, batch)  # type: ignore[arg-type]
    if "epsilon" not in drawn.guide:
        raise ValueError(f"{run.name} has no process noise: no site epsilon")
    value = {name: site["value"] for name, site in drawn.guide.items()}
    mean, std = drawn.guide["epsilon"]["fn"].kept_moments()
    noise = ((mean.square() + std.square() - 1) / 2 - std.log()).sum((0, 1))
    rest = torch.stack([_divergence(drawn.guide[n], drawn.model[n]) for n in _gaussian(drawn)])
    args = value["z"][:, 0], value["velocity"], Plan.of(value)
    path, still = (model.path(*args, ε, batch)[0] for ε in (value["epsilon"], 0 * value["epsilon"]))
    return noise, rest.sum(), path, still


def _gaussian(drawn: Any) -> list[str]:
    return [n for n in ("z", "velocity", "goal", "start") if n in drawn.guide]


def _divergence(q: Any, p: Any) -> Tensor:
    each: Tensor = torch.distributions.kl_divergence(q["fn"].base_dist, p["fn"].base_dist)
    return each.sum()
