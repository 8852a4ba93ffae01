"""The deep variational Bayes filter with a locally linear transition: `dvbf`."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.contract.settings import Count, Positive, settings
from zoo.errors import NotFittedError
from zoo.models.filters.locally_linear import LocallyLinear
from zoo.nn.mlp import Activation, mlp
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "Dvbf"]


@settings
class Config:
    """Settings of :class:`Dvbf`.

    ``bases`` matrices A^(i), B^(i), C^(i), weighed by a network of ``transition_hidden`` units;
    ``noise_scale`` is where C starts; ``output_std`` where the constant σ starts, in
    scaled units, never below ``output_floor``.
    """

    latent_dim: Count = 8
    hidden: Count = 200
    activation: Activation = "relu"
    bases: Count = 16
    transition_hidden: Count = 64
    noise_scale: Positive = 0.1
    output_std: Positive = 0.3
    output_floor: Positive = 1e-3


class Dvbf(nn.Module):
    r"""A latent state with locally linear steps, driven by noise and, where there are any, actions.

    w_t ~ N(0, I),  z_1 = h(w_1),  z_{t+1} = A_t z_t + B_t a_t + C_t w_{t+1},
    A_t = Σ_i α_i(z_t, a_t) A^(i), B_t and C_t likewise,  x_t ~ N(μ(z_t), diag σ²)   — (85)

    Thesis §6.2.1; Karl, Soelch, Bayer & van der Smagt, *Deep variational Bayes filters*, ICLR 2017:
    the reconstruction goes through the transition, so that the state has to hold all that the
    future needs. ``a_t`` are the data's controls at the frame they act from; data without controls
    have none. A forecast filters the frames observed and goes on with noise from the prior; it
    needs the actions to come. Missing entries are left out of the likelihood and are 0, the
    training mean, to the guide. It has no goal and fills no gaps from both sides (no generate, no
    impute); the matrices and all networks are point estimates (Karl et al. have q(v) over the
    matrices), and w_1 is recognised from five frames, not by a smoother over the whole window:
    bands want calibration.

    Defaults: 8 coordinates, 16 bases, 200 hidden units, σ constant in time; data standardised.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32

    def __init__(self, layout: Layout, config: Config) -> None:
        """A transition for the controls and a decoder for the channels of ``layout``."""
        super().__init__()
        self.layout, self.config = layout, config
        self.latent_dim = latent = config.latent_dim
        self.begin = mlp([latent, config.transition_hidden, latent], "tanh")
        self.transition = LocallyLinear(
            latent,
            controls=len(layout.inputs),
            bases=config.bases,
            hidden=config.transition_hidden,
            noise_scale=config.noise_scale,
        )
        channels = len(layout.channels)
        self.decoder = mlp([latent, config.hidden, channels], config.activation)
        self.output_root = nn.Parameter(torch.full((channels,), config.output_std**0.5))

    @property
    def output_std(self) -> Float[Tensor, " channel"]:
        """The constant standard deviation of every channel."""
        return self.output_root.square() + self.config.output_floor

    def forward(self, batch: Batch) -> None:
        """The Pyro program: all noise as one site, the path it leads to, and the frames."""
        windows, time = batch.values.shape[:2]
        unit = dist.Normal(batch.values.new_zeros(()), 1.0)
        actions = self.actions(batch, time - 1)
        mask = True if batch.mask is None else batch.mask
        with pyro.plate("windows", batch.total, subsample=torch.arange(windows)):
            w = pyro.sample("w", unit.expand([windows, time, self.latent_dim]).to_event(2))
            paths = [self.path(each, actions) for each in w.reshape(-1, *w.shape[-3:])]
            mean = self.decoder(torch.stack(paths).reshape(w.shape))
            x = dist.Normal(mean, self.output_std, validate_args=False).mask(mask)
            pyro.sample("x", x.to_event(2), obs=batch.given(batch.values))

    def path(
        self,
        w: Float[Tensor, "window time latent"],
        actions: Float[Tensor, "window step control"] | None,
    ) -> Float[Tensor, "window time latent"]:
        """z_{1:T} of noise and actions."""
        return self.transition.path(self.begin(w[:, 0]), w[:, 1:], actions)

    def actions(self, batch: Batch, steps: int) -> Float[Tensor, "window step control"] | None:
        """Actions of the first ``steps`` frames; None for data without controls."""
        if not self.layout.inputs:
            return None
        known = 0 if batch.inputs is None else batch.inputs.shape[1]
        if batch.inputs is None or known < steps:
            raise ValueError(
                f"dvbf needs the controls ({', '.join(self.layout.inputs)}) of the first "
                f"{steps} frames; got {known}. A forecast needs those of the frames to come too"
            )
        return batch.inputs[:, :steps]

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Filtered paths z_{1:T}."""
        return Predictive(location=self._paths(batch, posterior, 0, draws), joint=True)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Movements through the transition, with the recognised noise."""
        return self.decode(self._paths(batch, posterior, 0, draws))

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Joint draws of the future: the frames observed are filtered, later noise is the prior's.

        ``batch.inputs`` must hold the actions up to the last frame but one of the forecast.
        """
        paths = self._paths(batch, posterior, horizon, draws)
        if not bool(paths.isfinite().all()):
            raise FloatingPointError(
                f"the forecast diverges within {horizon} frames: the roll-out left what was "
                "trained on; try a shorter horizon, longer windows or longer training"
            )
        return self.decode(paths[:, :, batch.values.shape[1] :])

    def _paths(
        self, batch: Batch, posterior: Posterior | None, horizon: int, draws: int
    ) -> Float[Tensor, "sample sequence time latent"]:
        if posterior is None:
            raise NotFittedError("dvbf needs its guide to predict; got no posterior")
        w = posterior.draw(batch, draws)["w"]
        ahead = torch.randn(*w.shape[:2], horizon, w.shape[3]).to(w)
        noise = torch.cat([w, ahead], 2).flatten(0, 1)
        actions = self.actions(batch, noise.shape[1] - 1)
        every = None if actions is None else actions.repeat(draws, 1, 1)
        paths: Tensor = self.path(noise, every).unflatten(0, (draws, len(batch)))
        return paths

    def decode(self, paths: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z_t)."""
        return Predictive(location=self.decoder(paths), noise=self.output_std, joint=True)
