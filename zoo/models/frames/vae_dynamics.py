"""The variational autoencoder with linear dynamics in its latent space: `vae-dynamics`."""

from __future__ import annotations

from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from zoo.contract.settings import Count, Layers, Positive, settings
from zoo.errors import NotFittedError
from zoo.nn.mlp import Activation, widths
from zoo.nn.moments import GaussianNetwork, Noise
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["Config", "VAEDynamics"]


@settings
class Config:
    """Settings of :class:`VAEDynamics`.

    ``hidden`` are the layers from a frame to the latent space, mirrored in the decoder; ``noise``
    what σ depends on: the ``state`` z̃ (30), the ``square`` of a map of it, a ``constant`` of each
    channel, or one ``shared`` by all; ``noise_floor`` the least σ in scaled units.
    """

    latent_dim: Count = 5
    hidden: Layers = (512,)
    activation: Activation = "relu"
    noise: Noise = "state"
    noise_floor: Positive = 1e-2


class VAEDynamics(nn.Module):
    """A frame's coordinates and the action taken give the next frame, linearly in latent space.

    z_t ~ N(0, I), z̃_{t+1} = [z_t a_t] W + b, x_{t+1} ~ N(μ(z̃_{t+1}), σ²(z̃_{t+1})); q(z_t | x_t)
    by an encoder — (70)(71)

    Thesis §4.2.1.1 and §4.3.1; after Watter et al., *Embed to control*, NIPS 2015. Networks as in
    ``vae``: d–512–5 and back, the encoder's σ = (Wh + b)² + floor, the decoder's log σ² = Wh + b,
    (30), plus a floor: with the square there, training on the images did not converge. ReLU. W
    starts at the identity for z and 0 for a. ``a_t`` are the data's controls at the frame they
    act from; data without controls have none. The model is one of pairs (x_t, x_{t+1}): it has no
    density for how z̃_{t+1} and z_{t+1} are joined, so that a forecast goes through the frames —
    decode with noise, encode, step — as the model's own Markov chain p(x_{t+1} | x_t, a_t) says.
    Each component of a forecast is one such path; the noise drawn on top is independent of the
    noise that the path went on from. The pixels' noise is independent too, where a disturbance
    moves them together, so that bands of many steps ahead are too narrow until they are
    recalibrated. The first frame of a reconstruction has no predecessor and gets the marginal: z
    from the prior, action 0. Missing entries are left out of the likelihood and are 0 to the
    encoder; a frame with nothing seen is encoded as the prior. It fills no gaps from both sides
    (no impute). The networks are point estimates.

    Defaults: 5 coordinates, hidden 512, σ(z̃) state dependent, windows of 2 frames.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32

    def __init__(self, layout: Layout, config: Config) -> None:
        """A transition for the controls and a decoder for the channels of ``layout``."""
        super().__init__()
        self.layout, self.config = layout, config
        self.latent_dim = config.latent_dim
        self.transition = nn.Linear(config.latent_dim + len(layout.inputs), config.latent_dim)
        nn.init.eye_(self.transition.weight)
        nn.init.zeros_(self.transition.bias)
        self.decoder = GaussianNetwork(
            config.latent_dim,
            widths(config.hidden)[::-1],
            len(layout.channels),
            activation=config.activation,
            noise=config.noise,
            floor=config.noise_floor,
        )

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: z for every frame but the last, then each frame's successor."""
        frames, relevant = self.explained(batch)
        prior = dist.Normal(batch.values.new_zeros(()), 1.0)
        shape = [len(batch), frames, self.latent_dim]
        kept = True if relevant is None else relevant[..., None]
        mask = True if batch.mask is None else batch.mask[:, 1:]
        actions = self._actions(batch, frames)
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(len(batch))):
            z = pyro.sample("z", prior.expand(shape).mask(kept).to_event(2))
            mean, std = self.decoder(self.step(z, actions))
            likelihood = dist.Normal(mean, std).mask(mask).to_event(2)
            x: Tensor = pyro.sample("x", likelihood, obs=batch.given(batch.values[:, 1:]))
        return x

    def explained(self, batch: Batch) -> tuple[int, Bool[Tensor, "window time"] | None]:
        """Leading frames that have a latent state, and those whose successor was observed."""
        frames = batch.values.shape[1]
        if frames < 2:
            raise ValueError(f"vae-dynamics needs windows of at least 2 frames; got {frames}")
        return frames - 1, None if batch.mask is None else batch.mask[:, 1:].any(-1)

    def step(
        self,
        z: Float[Tensor, "*batch latent"],
        action: Float[Tensor, "*row control"] | None,
    ) -> Float[Tensor, "*batch latent"]:
        """z̃_{t+1} = [z_t a_t] W + b, (70)."""
        if action is not None:
            z = torch.cat([z, action.expand(*z.shape[:-1], -1)], -1)
        after: Tensor = self.transition(z)
        return after

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """q(z_t | x_t) of every frame."""
        q = self._encode(batch.values, batch.mask, posterior)
        return Predictive(location=q.mean[None], epistemic=q.stddev[None], draws=q.sample((draws,)))

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """One-step predictions p(x_{t+1} | x_t, a_t) at frame t+1; the marginal at frame 1."""
        frames = batch.values.shape[1]
        z = self._encode(batch.values, batch.mask, posterior).sample((draws,))
        before = torch.cat([torch.randn_like(z[:, :, :1]), z[:, :, :-1]], 2)
        actions = self._actions(batch, frames - 1)
        if actions is not None:
            actions = nn.functional.pad(actions, (0, 0, 1, 0))
        return self.decode(self.step(before, actions))

    def decode(self, z: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z̃_t), of coordinates after the transition."""
        mean, std = self.decoder(z)
        return Predictive(location=mean, noise=std, joint=True)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Paths through the frames: encode, step, decode with noise, encode again.

        ``batch.inputs`` must hold the actions up to the last frame but one of the forecast.
        """
        seen = batch.values.shape[1]
        actions = self._actions(batch, seen + horizon - 1)
        last = None if batch.mask is None else batch.mask[:, -1]
        z = self._encode(batch.values[:, -1], last, posterior).sample((draws,))
        means, stds = [], []
        for t in range(seen - 1, seen + horizon - 1):
            mean, std = self.decoder(self.step(z, None if actions is None else actions[:, t]))
            frame = mean + std * torch.randn_like(std)
            if not bool(frame.isfinite().all()):
                raise FloatingPointError(
                    f"the forecast diverges at frame {t + 2 - seen} of {horizon}: the roll-out "
                    "left what was trained on; try a shorter horizon, longer training or tanh"
                )
            z = self._encode(frame, None, posterior).sample()
            means.append(mean)
            stds.append(std)
        return Predictive(location=torch.stack(means, 2), noise=torch.stack(stds, 2), joint=True)

    def _actions(self, batch: Batch, frames: int) -> Float[Tensor, "window time control"] | None:
        """Actions a_1 … a_frames; None for data without controls."""
        if not self.layout.inputs:
            return None
        known = 0 if batch.inputs is None else batch.inputs.shape[1]
        if batch.inputs is None or known < frames:
            raise ValueError(
                f"vae-dynamics needs the controls ({', '.join(self.layout.inputs)}) of the first "
                f"{frames} frames; got {known}. A forecast needs those of the frames to come too"
            )
        return batch.inputs[:, :frames]

    def _encode(
        self, values: Tensor, mask: Tensor | None, posterior: Posterior | None
    ) -> torch.distributions.Normal:
        """q(z_t | x_t); the prior where nothing was observed."""
        if posterior is None:
            raise NotFittedError("vae-dynamics needs its guide to predict; got no posterior")
        q = posterior.encode(values, mask)
        if mask is None:
            return q
        seen = mask.any(-1, keepdim=True)
        return torch.distributions.Normal(
            torch.where(seen, q.mean, 0.0), torch.where(seen, q.stddev, 1.0)
        )
