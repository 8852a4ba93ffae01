"""The variational autoencoder of single frames: `vae`."""

from __future__ import annotations

from typing import Annotated, ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.settings import Count, Layers, Positive, settings
from zoo.errors import NotFittedError
from zoo.models.frames.denoising import conditional_draws
from zoo.nn.mlp import Activation, widths
from zoo.nn.moments import GaussianNetwork, Noise
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["VAE", "Config"]


@settings
class Config:
    """Settings of :class:`VAE`.

    ``hidden`` are the layers from a frame to the latent space, mirrored in the decoder (() is
    linear); ``noise`` what σ depends on: the ``state`` z (30), the ``square`` of a map of it, a
    ``constant`` of each channel, or one ``shared`` by all; ``noise_floor`` the least σ in scaled
    units. ``chains`` and ``burn_in`` run the Markov chain that fills missing entries.
    """

    latent_dim: Count = 5
    hidden: Layers = (512,)
    activation: Activation = "relu"
    noise: Noise = "state"
    noise_floor: Positive = 1e-2
    chains: Count = 20
    burn_in: Annotated[int, Field(ge=0)] = 20


class VAE(nn.Module):
    """Gaussian coordinates of every frame behind a neural decoder.

    z_t ~ N(0, I), x_t ~ N(μ(z_t), σ²(z_t)); q(z_t | x_t) by an encoder — (30)–(32)

    Thesis §2.1.5.3 and §4.3.1; Kingma & Welling, *Auto-encoding variational Bayes*, ICLR 2014;
    Rezende et al., ICML 2014. Both networks d–512–5; the encoder's σ = (Wh + b)² + floor, since
    the thesis gives its σ output the square as transfer function (read as the standard deviation,
    not the variance); the decoder's log σ² = Wh + b, (30), plus a floor, or constants. The thesis
    leaves the activation open: ReLU here. Frames are independent items. Missing entries are left
    out of the likelihood and are 0 to the encoder; predictions of frames with missing entries
    come from a Markov chain through encoder and decoder, whose Metropolis step corrects the
    encoder. Entries that were observed get their reconstruction. The networks are point estimates.
    It knows nothing of time, so that it gives no forecast, and a frame with nothing seen gets draws
    of the prior.

    Defaults: 5 coordinates, hidden 512, σ(z) of the state (the entry takes a constant for each
    channel, which reconstructs movements far better), 20 chains of 20 steps.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32

    def __init__(self, layout: Layout, config: Config) -> None:
        """A decoder for the channels of ``layout``."""
        super().__init__()
        self.layout, self.config = layout, config
        self.latent_dim = config.latent_dim
        self.decoder = GaussianNetwork(
            config.latent_dim,
            widths(config.hidden)[::-1],
            len(layout.channels),
            activation=config.activation,
            noise=config.noise,
            floor=config.noise_floor,
        )

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: z for every frame of every window, then x."""
        frames, relevant = self.explained(batch)
        prior = dist.Normal(batch.values.new_zeros(()), 1.0)
        shape = [len(batch), frames, self.latent_dim]
        kept = True if relevant is None else relevant[..., None]
        mask = True if batch.mask is None else batch.mask
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            z = pyro.sample("z", prior.expand(shape).mask(kept).to_event(2))
            mean, std = self.decoder(z)
            likelihood = dist.Normal(mean, std).mask(mask).to_event(2)
            x: Tensor = pyro.sample("x", likelihood, obs=batch.given(batch.values))
        return x

    def explained(self, batch: Batch) -> tuple[int, Bool[Tensor, "window time"] | None]:
        """Leading frames that have a latent state, and which of them anything was observed of."""
        seen = None if batch.mask is None else batch.mask.any(-1)
        return batch.values.shape[1], seen

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """q(z_t | x_t); where entries are missing the moments of p(z_t | x_seen) by the chain."""
        z, (mean, std) = self._latents(batch, posterior, draws)
        return Predictive(location=mean[None], epistemic=std[None], draws=z)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x̂_t | x_t) of a second observation of the same frame: a mixture over draws of z."""
        z, _ = self._latents(batch, posterior, draws)
        return self.decode(z)

    def decode(self, z: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z_t)."""
        mean, std = self.decoder(z)
        return Predictive(location=mean, noise=std, joint=True)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x_missing | x_seen) by the Markov chain; entries that were observed reconstructed."""
        return self.reconstruct(batch, posterior, draws=draws)

    def _latents(
        self, batch: Batch, posterior: Posterior | None, draws: int
    ) -> tuple[Float[Tensor, "sample window time latent"], tuple[Tensor, Tensor]]:
        """Draws of z with their moments; by the chain in frames that are not complete."""
        if posterior is None:
            raise NotFittedError("vae needs its guide to predict; got no posterior")
        q = posterior.encode(batch.values, batch.mask)
        z, mean, std = q.sample((draws,)), q.mean, q.stddev
        if batch.mask is None:
            return z, (mean, std)
        holed = ~batch.mask.all(-1)
        z[:, holed] = conditional_draws(
            self.decoder,
            posterior.encode,
            batch.values[holed],
            batch.mask[holed],
            self.latent_dim,
            draws=draws,
            chains=self.config.chains,
            burn_in=self.config.burn_in,
        )
        where = holed[..., None]
        moments = (
            torch.where(where, z.mean(0), mean),
            torch.where(where, z.std(0, unbiased=False), std),
        )
        return z, moments
