"""Movement primitives of principal components: `pca-dmp`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from pyro import poutine
from torch import Tensor, nn
from torch.distributions.transforms import ReshapeTransform
from torch.nn import functional

from zoo.contract.settings import Count, Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.models.frames import pca
from zoo.models.primitives import dmp
from zoo.models.primitives.learned_dmp import COMPONENTS
from zoo.models.primitives.parameter_hypotheses import ParameterPosterior
from zoo.models.primitives.projected import ProjectedHypotheses, ProjectedLaw
from zoo.models.primitives.projection import Projection
from zoo.movement.components import Components, Paths
from zoo.movement.demonstrations import extremes, seen_entries, seen_movements
from zoo.movement.timing import Timing, duration
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior, Sites, Wishes

__all__ = ["Config", "PcaDmp"]


@settings
class Config:
    """Settings of :class:`PcaDmp`: the components kept, and the primitive of each."""

    latent_dim: Count = 5
    noise_floor: Positive = 1e-4
    kernels: Annotated[int, Field(ge=2)] = 20
    alpha: Positive = 25.0
    goal_scaling: bool = True

    @property
    def pca(self) -> pca.Config:
        """Settings of the components."""
        return pca.Config(latent_dim=self.latent_dim, noise_floor=self.noise_floor)

    @property
    def dmp(self) -> dmp.Config:
        """Settings of the primitives."""
        return dmp.Config(kernels=self.kernels, alpha=self.alpha, goal_scaling=self.goal_scaling)


class PcaDmp(nn.Module):
    r"""Every principal component of the frames is one movement primitive: a joint Gaussian program.

    For every component, with timing, scale and θ drawn as in ``dmp``::

        z_k = R θ_k + σ_k N ε_k + τ_k η_k,   ε, η ~ N(0, I)
        x_t ~ N(W z_t + μ, σ²I)

    Its parameters are point estimates, found in two stages: W, μ and σ by ``pca``, then p(θ) and
    the noise of ``dmp`` from the components' paths; τ² is what their white noise has beyond that
    of x. All else is inference in the one program. The guide is the exact posterior of timing,
    scale and θ, with ε and η integrated out. Reconstructions, filled gaps and forecasts are
    conditionals of the program, of all components together, with or without missing joints.
    As in ``dmp``, an entry counts as ``information`` of an independent one, which tempers the
    posterior; timings and scales are resampled to 16 components; reconstructions
    take the likeliest timing and s = 1. Columns of W are orthogonal: components separate where
    frames are observed whole or not at all, and missing joints couple them. Costs are the cube of
    the frames observed, where coupled times that of the components.

    Approximate are the demonstrations with missing joints that p(θ) is learned from or that are to
    be changed (other goals, durations, switching): they enter by the components' mean given the
    rest of their frame. Bands of changed movements count components as independent. What the
    components leave out is white noise to it, as large along them, where in truth it is smooth and
    beside them. ``noise`` is σ, ``epistemic`` the uncertainty of W z.

    Thesis Table 2, where it is the linear rival of ``ae-dmp``; Bitzer & Vijayakumar, *Latent spaces
    for dynamic movement primitives*, Humanoids 2009, take the two steps apart in the same way.
    Defaults: 5 components, 20 kernels (§5.3.2), α = 25, β = α/4.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    reached: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Both parts without data."""
        super().__init__()
        self.layout, self.config = layout, config
        self.latent_dim = config.latent_dim
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
        least = self._least / self.dmp.noise.square()
        self.dmp.ratio = torch.maximum(self.dmp.ratio, torch.where(least.isfinite(), least, 0.0))

    def forward(self, batch: Batch) -> Float[Tensor, "*sample sequence frame channel"]:
        """The generative program of the whole movements of ``batch``; returns W R θ + μ."""
        seen, view = seen_movements(batch), self._projection
        blank = batch.movements.new_zeros(*seen.shape[:2], self.config.latent_dim)
        with self.dmp.movements(batch):
            law, path = self.dmp.prior(replace(batch, movements=blank, movement_mask=None))
            (timing,) = _whole(seen)
            x = ProjectedLaw(view, self.dmp.primitive, timing, law.θ, seen)
            with poutine.scale(scale=float(self.dmp.information)):
                pyro.sample("x", x, obs=batch.given(batch.movements))
        return view.shown(path)

    def posterior_sites(self, batch: Batch) -> Sites:
        """p(timing, scale, θ | x), exactly."""
        x, seen = batch.movements, seen_movements(batch)
        unknown = self._unknowns(seen, _whole(seen))
        given = ParameterPosterior(unknown, x, seen)

        def private(drawn: Mapping[str, Tensor]) -> dist.TorchDistribution:
            law = given.private(drawn)
            parts = ReshapeTransform(law.event_shape, self.dmp.mean.shape)
            found: dist.TorchDistribution = dist.TransformedDistribution(law, [parts])
            return found

        of = {"timing": given.timing, "scale": given.scale}
        if self.dmp.factors.shape[-1]:
            of["shared"] = given.shared
        of["private"] = private
        return Sites(plate="movements", size=batch.total_sequences, rows=len(x), of=of)

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Roll-outs of the components."""
        seen = seen_entries(batch)
        unknown = self._unknowns(seen, _whole(seen))
        parts = Components.empty(1, batch.values[..., : self.config.latent_dim])
        for rows, which, z in unknown.latent(batch.values, seen, 1, fresh=True):
            variance = z.covariance.diagonal(dim1=-2, dim2=-1).expand_as(z.mean)
            parts.put(rows, which, Paths(z.mean, variance, z.draw))
        return _predictive(parts, None, draws)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Fresh roll-outs of the parameters that the movements have."""
        seen = seen_entries(batch)
        parts = self._shown(batch.values, seen, _whole(seen), 1, fresh=True)
        return _predictive(parts, self.pca.noise, draws)

    def decode(self, z: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z_t), of the components alone."""
        return self.pca.decode(z)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The paths given the entries observed."""
        seen = seen_entries(batch)
        return self._filled(batch.values, seen, _whole(seen), 0, draws)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """The paths given their first frames, after these."""
        pad, known = (0, 0, 0, horizon), batch.values.shape[1]
        seen = functional.pad(seen_entries(batch), pad)
        values = functional.pad(batch.values, pad)
        return self._filled(values, seen, self.dmp.expected.lasting(known), known, draws)

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Other goals, durations and switching in the components; the nearest goal they have."""
        goal, onto = wishes.goal, wishes.onto
        latent = replace(
            wishes,
            goal=None if goal is None else self._components(goal[:, None], None)[0][:, 0],
            onto=None if onto is None else self._latent(onto),
        )
        made = self.dmp.generate(self._latent(batch), None, wishes=latent, draws=draws)
        return self._changed(made)

    @property
    def _least(self) -> Float[Tensor, " latent"]:
        """Variances of the noise of x along the components; infinite where no channel shows one."""
        f = self.pca.factors()
        least: Tensor = (f.noise / torch.linalg.vector_norm(f.loading, dim=0)).square()
        return least

    @property
    def _projection(self) -> Projection:
        """Components as the channels show them."""
        f, force = self.pca.factors(), self.dmp.noise.square()
        white = (force * self.dmp.ratio - self._least).clamp_min(0)
        return Projection(f.loading, f.mean, f.noise, force, white)

    def _unknowns(self, seen: Tensor, timings: list[Timing]) -> ProjectedHypotheses:
        d, information = self.dmp, float(self.dmp.information)
        return ProjectedHypotheses.of(
            self._projection, d.primitive, d.population, information, timings, d.scales, seen
        )

    def _filled(
        self, values: Tensor, seen: Tensor, timings: list[Timing], begin: int, draws: int
    ) -> Predictive:
        """The posterior predictive from frame ``begin`` on."""
        parts = self._shown(values, seen, timings, COMPONENTS, fresh=False)
        return _predictive(parts.after(begin), self.pca.noise, draws)

    def _shown(
        self, values: Tensor, seen: Tensor, timings: list[Timing], count: int, *, fresh: bool
    ) -> Components:
        """W z + μ as a mixture over timings and scales."""
        unknown = self._unknowns(seen, timings)
        count = unknown.at_most(count)
        parts = Components.empty(count, values)
        for rows, which, z in unknown.latent(values, seen, count, fresh=fresh):
            parts.put(rows, which, unknown.projection.paths(z))
        return parts

    def _components(
        self, values: Float[Tensor, "sequence time channel"], mask: Tensor | None
    ) -> tuple[Float[Tensor, "sequence time latent"], Tensor]:
        """Least squares of frames observed whole; 0 and False where nothing was observed.

        Of others the mean of p(z_t | x_seen), as far from 0 as least squares are.
        """
        rows = None if mask is None else mask.flatten(0, 1)
        z, _ = self.pca.factors().posterior(values.flatten(0, 1), rows)
        z = z * (1 + torch.where(self._least.isfinite(), self._least, 0.0))
        seen = torch.ones_like(values[..., :1], dtype=torch.bool)
        if mask is not None:
            seen = mask.any(-1, keepdim=True)
        return z.unflatten(0, values.shape[:2]) * seen, seen.expand(*values.shape[:2], z.shape[-1])

    def _latent(self, batch: Batch) -> Batch:
        z, seen = self._components(batch.values, batch.mask)
        return replace(batch, values=z, mask=None if batch.mask is None else seen)

    def _changed(self, latent: Predictive) -> Predictive:
        """W z + μ of components counted as independent."""
        view = self._projection
        square = view.loading.square().T
        variance = None if latent.epistemic is None else latent.epistemic.square() @ square
        return Predictive(
            location=view.shown(latent.location),
            noise=(view.white @ square + view.noise.square()).sqrt(),
            epistemic=None if variance is None else variance.sqrt(),
            draws=latent.redrawn(view.shown),
        )


def _predictive(parts: Components, noise: Tensor | None, draws: int) -> Predictive:
    return Predictive(
        location=parts.mean,
        noise=noise,
        epistemic=parts.variance.sqrt().expand_as(parts.mean),
        draws=parts.draws(draws),
    )


def _whole(seen: Bool[Tensor, "sequence frame channel"]) -> list[Timing]:
    return [duration(seen.shape[1])]
