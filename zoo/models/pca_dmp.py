"""Movement primitives of principal components: `pca-dmp`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.datasets.records import Pairs, Sequences
from zoo.dynamics.alignment import extremes
from zoo.models import dmp, pca
from zoo.prediction import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "PcaDmp"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`PcaDmp`: the components kept, and the primitive of each."""

    latent_dim: int = 5
    noise_floor: float = 1e-4
    kernels: int = 20
    alpha: float = 25.0
    goal_scaling: bool = True

    def __post_init__(self) -> None:
        """Refuse what either part refuses."""
        _ = self.pca, self.dmp

    @property
    def pca(self) -> pca.Config:
        """Settings of the components."""
        return pca.Config(latent_dim=self.latent_dim, noise_floor=self.noise_floor)

    @property
    def dmp(self) -> dmp.Config:
        """Settings of the primitives."""
        return dmp.Config(kernels=self.kernels, alpha=self.alpha, goal_scaling=self.goal_scaling)


class PcaDmp(nn.Module):
    """Every principal component of the frames is one movement primitive, found in two stages.

    z_t ~ one primitive a component, as in ``dmp``;  x_t ~ N(W z_t + μ, σ²I) as in ``pca``

    Thesis Table 2, where it is the linear rival of ``ae-dmp``; Bitzer & Vijayakumar, *Latent spaces
    for dynamic movement primitives*, Humanoids 2009, take the two steps apart in the same way. Both
    parts are those of the zoo and are learned one after the other: the components know nothing of
    time, the primitives nothing of what the components leave out. Each stage is in closed form;
    both together are no exact inference in the joint program, and there is no guide. Forecasts,
    missing sections, goals, durations and switching are those of ``dmp`` in the components, brought
    back by W. Frames with missing joints enter by the mean of p(z_t | x_seen), whose variance is
    not passed on. Draws keep what components have in common; the closed-form variance counts them
    as independent. What the components leave out is white noise to it, where in truth it is smooth.

    Defaults: 5 components, 20 kernels (§5.3.2), α = 25, β = α/4.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    reached: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Both parts without data."""
        super().__init__()
        self.layout, self.config = layout, config
        names = tuple(f"z_{i + 1}" for i in range(config.latent_dim))
        latent = replace(layout, channels=names, units=("",) * len(names))
        self.pca = pca.PCA(layout, config.pca)
        self.dmp = dmp.DMP(latent, config.dmp)
        self.register_buffer("reached", torch.empty(0, dtype=self.dtype))
        self.phased = self.dmp.phased

    def condition(self, data: Sequences | Pairs) -> None:
        """Components of all frames, then the primitives of their paths."""
        if not isinstance(data, Sequences):
            raise TypeError(f"pca-dmp needs Sequences; got {type(data).__name__}")
        self.pca.condition(data)
        self.reached = extremes(data.values, data.mask)
        z, mask = self._components(data.values, data.mask)
        latent = self.dmp.layout
        self.dmp.condition(
            replace(data, values=z, mask=mask, channels=latent.channels, units=latent.units)
        )

    def forward(self, batch: Batch) -> Float[Tensor, "*sample sequence frame channel"]:
        """The generative program of the whole movements of ``batch``."""
        z, mask = self._components(batch.movements, batch.movement_mask)
        latent = replace(batch, movements=z, movement_mask=mask)
        with self.dmp.movements(latent):
            law, _ = self.dmp.prior(latent)
            path = pyro.sample("z", law)
            mean: Tensor = path @ self.pca.loading.T + self.pca.mean
            x = dist.Normal(mean, self.pca.noise)
            if batch.movement_mask is not None:
                x = x.mask(batch.movement_mask)
            pyro.sample("x", x.to_event(2), obs=batch.given(batch.movements))
        return mean

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Roll-outs of the components."""
        return self.dmp.reconstruct(self._latent(batch), None, draws=draws)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Roll-outs of the components, brought back to the channels."""
        return self._observed(self.dmp.reconstruct(self._latent(batch), None, draws=draws))

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Missing joints by the components, missing frames by the primitives."""
        return self._observed(self.dmp.impute(self._latent(batch), None, draws=draws))

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The components' paths given their first frames, brought back."""
        latent = self._latent(batch)
        return self._observed(self.dmp.forecast(latent, None, horizon=horizon, draws=draws))

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        goal: Float[Tensor, "sequence channel"] | None,
        duration: float,
        onto: Batch | None,
        start: int,
        steps: int,
        draws: int,
    ) -> Predictive:
        """Other goals, durations and switching in the components; the nearest goal they have."""
        made = self.dmp.generate(
            self._latent(batch),
            None,
            goal=None if goal is None else self._components(goal[:, None], None)[0][:, 0],
            duration=duration,
            onto=None if onto is None else self._latent(onto),
            start=start,
            steps=steps,
            draws=draws,
        )
        return self._observed(made)

    @property
    def _white(self) -> Float[Tensor, " latent"]:
        """Standard deviation of the primitives' white noise."""
        return self.dmp.noise * self.dmp.ratio.sqrt()

    def _components(
        self, values: Float[Tensor, "sequence time channel"], mask: Tensor | None
    ) -> tuple[Float[Tensor, "sequence time latent"], Tensor]:
        """Mean of p(z_t | x_seen), 0 and False where nothing was seen."""
        rows = None if mask is None else mask.flatten(0, 1)
        z, _ = self.pca.factors().posterior(values.flatten(0, 1), rows)
        seen = torch.ones_like(values[..., :1], dtype=torch.bool)
        if mask is not None:
            seen = mask.any(-1, keepdim=True)
        return z.unflatten(0, values.shape[:2]) * seen, seen.expand(*values.shape[:2], z.shape[-1])

    def _latent(self, batch: Batch) -> Batch:
        z, seen = self._components(batch.values, batch.mask)
        return replace(batch, values=z, mask=None if batch.mask is None else seen)

    def _noise(self, std: Float[Tensor, "*batch latent"]) -> Float[Tensor, "*batch channel"]:
        """σ of the channels whose components have the standard deviations ``std``."""
        return (self._spread(std).square() + self.pca.noise.square()).sqrt()

    def _spread(self, std: Float[Tensor, "*batch latent"]) -> Float[Tensor, "*batch channel"]:
        return (std.square() @ self.pca.loading.square().T).sqrt()

    def _observed(self, latent: Predictive) -> Predictive:
        w, μ = self.pca.loading, self.pca.mean
        return Predictive(
            location=latent.location @ w.T + μ,
            noise=self._noise(self._white),
            epistemic=None if latent.epistemic is None else self._spread(latent.epistemic),
            draws=latent.redrawn(lambda z: z @ w.T + μ, len(w)),
        )
