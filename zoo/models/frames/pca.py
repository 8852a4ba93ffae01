"""Probabilistic principal component analysis: `pca`."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.contract.settings import Count, Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NotFittedError
from zoo.inference.factors import Factors, closed_form, expectation_maximisation
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior, Sites

__all__ = ["PCA", "Config"]


@settings
class Config:
    """Settings of :class:`PCA`.

    ``noise_floor`` is the least σ in scaled units, for data of lower rank than they have channels;
    ``em_iterations`` and ``em_tolerance`` (nats per observed entry) end EM where entries are
    missing.
    """

    latent_dim: Count = 5
    noise_floor: Positive = 1e-4
    em_iterations: Count = 2000
    em_tolerance: Positive = 1e-7


class PCA(nn.Module):
    """A linear map from a few Gaussian coordinates to every frame, found in closed form.

    z_t ~ N(0, I), x_t ~ N(W z_t + μ, σ²I)

    Thesis §4.3.2 and Table 2; Tipping & Bishop, *Probabilistic principal component analysis*,
    JRSS B 61 (1999). Maximum likelihood comes from the eigen-decomposition of the covariance;
    with missing entries from EM on the entries observed. Frames are independent items. Evidence,
    posterior, reconstruction and the conditional of missing joints given seen ones are exact;
    entries that were observed get their reconstruction. W, μ and σ are point estimates: their own
    uncertainty is not in the bands. It knows nothing of time, so that it gives no forecast, and a
    frame with nothing seen gets the marginal N(μ, WW' + σ²I).

    Defaults: 5 coordinates; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64
    loading: Tensor
    mean: Tensor
    noise: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Placeholders until :meth:`condition`; ``latent_dim`` must be below the channels."""
        super().__init__()
        channels = len(layout.channels)
        if config.latent_dim >= channels:
            raise ValueError(
                f"latent_dim must be below the number of channels, {channels}, so that a "
                f"direction is left for the noise; got {config.latent_dim}"
            )
        self.layout, self.config = layout, config
        self.latent_dim = config.latent_dim
        for name in ("loading", "mean", "noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))

    def condition(self, data: Sequences | Pairs) -> None:
        """Maximum-likelihood W, μ, σ from all frames of ``data``."""
        if not isinstance(data, Sequences):
            raise TypeError(f"pca needs Sequences; got {type(data).__name__}")
        some = data.mask.any(-1)
        values, mask = data.values[some].to(self.dtype), data.mask[some]
        never = ~mask.any(0)
        if never.any():
            name = data.channels[int(never.nonzero()[0])]
            raise ValueError(f"channel {name} is missing in every frame; drop it")
        factors = self._fit(values, mask)
        self.loading, self.mean, self.noise = factors.loading, factors.mean, factors.noise

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: z for every frame of every window, then x."""
        f = self.factors()
        shape = [*batch.values.shape[:2], self.latent_dim]
        mask = True if batch.mask is None else batch.mask
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            prior = dist.Normal(f.mean.new_zeros(()), 1.0).expand(shape).to_event(2)
            z = pyro.sample("z", prior)
            likelihood = dist.Normal(z @ f.loading.T + f.mean, f.noise).mask(mask).to_event(2)
            x: Tensor = pyro.sample("x", likelihood, obs=batch.given(batch.values))
        return x

    def posterior_sites(self, batch: Batch) -> Sites:
        """The exact p(z | x) of the entries observed."""
        z = dist.MultivariateNormal(*self._posterior(batch)).to_event(1)
        return Sites(plate="windows", size=batch.total, rows=len(batch), of={"z": lambda _: z})

    def log_evidence(self, batch: Batch) -> Float[Tensor, ""]:
        """log p(x_seen), summed over all frames of the batch."""
        mask = None if batch.mask is None else batch.mask.flatten(0, 1)
        return self.factors().log_evidence(batch.values.flatten(0, 1), mask).sum()

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(z_t | x_t), exact, shape (sequence, time, latent)."""
        mean, covariance = self._posterior(batch)
        return Predictive(
            location=mean[None],
            epistemic=covariance.diagonal(dim1=-2, dim2=-1).sqrt()[None],
            draws=dist.MultivariateNormal(mean, covariance).sample((draws,)),
        )

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x̂_t | x_t) of a second observation of the same frame, exact."""
        f = self.factors()
        mean, covariance = self._posterior(batch)
        variance = torch.einsum("di,stij,dj->std", f.loading, covariance, f.loading)
        z = dist.MultivariateNormal(mean, covariance).sample((draws,))
        return Predictive(
            location=(mean @ f.loading.T + f.mean)[None],
            noise=f.noise,
            epistemic=variance.sqrt()[None],
            draws=z @ f.loading.T + f.mean,
        )

    def decode(self, z: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z_t)."""
        f = self.factors()
        return Predictive(location=z @ f.loading.T + f.mean, noise=f.noise, joint=True)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x_missing | x_seen), the exact Gaussian conditional; observed entries reconstructed."""
        return self.reconstruct(batch, posterior, draws=draws)

    def _fit(self, values: Tensor, mask: Tensor) -> Factors:
        c = self.config
        if mask.all():
            return closed_form(values, c.latent_dim, c.noise_floor)
        return expectation_maximisation(
            values,
            mask,
            c.latent_dim,
            c.noise_floor,
            iterations=c.em_iterations,
            tolerance=c.em_tolerance,
        )

    def factors(self) -> Factors:
        """W, μ and σ as they were learned."""
        if self.noise.numel() == 0:
            raise NotFittedError("pca has seen no data yet; call zoo.fit or condition first")
        return Factors(loading=self.loading, mean=self.mean, noise=self.noise)

    def _posterior(self, batch: Batch) -> tuple[Tensor, Tensor]:
        mask = None if batch.mask is None else batch.mask.flatten(0, 1)
        mean, covariance = self.factors().posterior(batch.values.flatten(0, 1), mask)
        windows = batch.values.shape[:2]
        return mean.unflatten(0, windows), covariance.unflatten(0, windows)
