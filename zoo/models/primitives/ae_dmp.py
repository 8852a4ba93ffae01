"""Dynamic movement primitives in a deep autoencoder: `ae-dmp` and its relatives."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.readiness import need
from zoo.contract.settings import Count, Layers, Positive, Share, settings
from zoo.models.primitives.encoded_paths import EncodedPaths
from zoo.movement.components import ramp
from zoo.movement.forcing import target_known
from zoo.movement.lengths import check_whole
from zoo.nn.mlp import Activation, mlp, widths
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior, Wishes

__all__ = ["AeDmp", "Config"]

PRIORS = {"normal": dist.Normal, "laplace": dist.Laplace}


@settings
class Config:
    """Settings of :class:`AeDmp`.

    ``hidden`` are the layers from a frame to the latent space, mirrored in the decoder;
    ``penalty`` is λ of (72), forces in units of αβ; ``pretraining`` the share of the training in
    which the autoencoder learns alone, 1 for two stages that are never joined; ``prior`` and
    ``prior_scale`` that of y, whose ``laplace`` has η = 1/``prior_scale`` in (73); ``weight_scale``
    the prior standard deviation of the decoder's weights (None: flat), without which a small y with
    large weights escapes the prior of y; ``chain`` the
    steps k of §5.3.4; ``noise_std`` where σ starts, never below ``noise_floor``, in scaled units.
    """

    latent_dim: Count = 5
    hidden: Layers = (36, 20)
    activation: Activation = "tanh"
    kernels: Annotated[int, Field(ge=2)] = 20
    alpha: Positive | None = None
    penalty: Positive = 1e-3
    pretraining: Share = 0.3
    prior: Literal["normal", "laplace"] = "normal"
    prior_scale: Positive = 1.0
    weight_scale: Positive | None = None
    chain: Count = 4
    noise_std: Positive = 0.3
    noise_floor: Positive = 1e-3


class AeDmp(EncodedPaths):
    r"""Movements that are one DMP each in the latent space of a denoising autoencoder.

    With the encoded path y = enc(x), the roll-out ỹ = R θ of θ = (y₁, ẏ₁, g, w), and β = α/4::

        θ ~ N(0, I),   y_t ~ N(0, 1) or Laplace(0, 1/η)                     (73)
        x_t ~ N(g(ỹ_t), σ²),   f_target,t(y) ~ N(Ψ_t w, σ²/λ)

    Minus the log joint times 2σ² is (72), beside the priors: its second term has the force (59)
    that y needs, in units of αβ. θ is not a free parameter but the ridge regression of the encoded
    path, so that a new demonstration needs no training. A first share of the training is that of
    the autoencoder, x_t ~ N(g(y_t), σ²); ``ae-then-dmp`` ends there and rolls out what it found,
    the non-integrated model of Table 2.

    Thesis §5.2, (72), (73), §5.3.2; N. Chen, J. Bayer, S. Urban, P. van der Smagt, *Efficient
    movement representation by embedding dynamic movement primitives in deep autoencoders*,
    Humanoids 2015. Defaults: layers 50–36–20–5 and back, tanh (the thesis leaves it open),
    20 kernels, λ = 1e-3, data in [−1, 1]. Latent path and networks are points: bands of
    reconstructions and new movements hold the one σ of all channels alone, which is learned, and
    estimated again on movements that the networks were not trained on, where there are any.
    Forecasts and missing sections condition a mixture around the latent paths of the training
    movements on the frames observed (:class:`~zoo.movement.paths.PathPrior`), with draws; after
    training on a single movement it is as wide as that movement's own θ. Missing joints come from
    the chain of §5.3.4, frame by frame, and the primitive nearest to the path it finds, which the
    thesis leaves out. Movements that last unlike long have each their own τ, R and Ψ (see
    :class:`~zoo.models.primitives.imitator.Imitator`); forecasts then are a mixture over durations
    of training movements as well.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32
    label: ClassVar[str] = "ae-dmp"
    phased: ClassVar[bool] = True

    config: Config

    def __init__(self, layout: Layout, config: Config) -> None:
        """A model of the movements of ``layout``, the longest as the unit of time."""
        super().__init__(layout, config.kernels, config.alpha)
        self.layout, self.config = layout, config
        self.latent_dim, self.chain = config.latent_dim, config.chain
        self.noise_floor = config.noise_floor
        sizes = [config.latent_dim, *widths(config.hidden)[::-1], len(layout.channels)]
        self.decoder = mlp(sizes, config.activation)
        self.root = nn.Parameter(torch.tensor(config.noise_std**0.5))
        self.settled = self.integrated = config.pretraining < 1

    @property
    def σ(self) -> Float[Tensor, "*channel"]:
        """The one standard deviation of all channels."""
        return self.root.square() + self.config.noise_floor

    def advance(self, done: float) -> None:
        """Join autoencoder and DMP after the pre-training's share of all steps."""
        joins = self.config.pretraining < 1
        self.integrated = joins and done >= self.config.pretraining
        self.settled = self.integrated or not joins

    def forward(self, batch: Batch) -> None:
        """The generative program of whole movements: (72) as a log joint, or its first stage."""
        (windows, time), lengths = batch.values.shape[:2], self._lengths(batch)
        check_whole(self.label, batch.movements.shape[1], time)
        zero = batch.values.new_zeros(())
        prior = PRIORS[self.config.prior](zero, zero + self.config.prior_scale)
        weights = dist.Normal(zero, zero + 1.0)
        θ_shape = [windows, self.config.kernels + 3, self.latent_dim]
        if self.config.weight_scale is not None:
            pyro.factor("weights", self._weight_prior(self.config.weight_scale))
        with pyro.plate("windows", size=batch.total, subsample=torch.arange(windows)):
            y_t = prior.expand([windows, time, self.latent_dim]).mask(_inside(lengths, time))
            y = pyro.sample("y", y_t.to_event(2))
            θ = pyro.sample("theta", weights.expand(θ_shape).to_event(2))
            path = self.imitator.roll_outs(θ, lengths, time) if self.integrated else y
            x = dist.Normal(self.decoder(path), self.σ).mask(_all(batch.mask))
            pyro.sample("x", x.to_event(2), obs=batch.given(batch.values))
            if self.integrated:
                f, f_target = self.imitator.all_forces(y, θ, lengths)
                force = dist.Normal(f, self.σ / self.config.penalty**0.5)
                if batch.mask is not None:
                    force = force.mask(target_known(batch.mask.any(-1))[..., None])
                pyro.sample("f", force.to_event(2), obs=batch.given(f_target))

    def _weight_prior(self, scale: float) -> Float[Tensor, ""]:
        """log p of the decoder's weights, N(0, ``scale``²) each, up to a constant."""
        weights = [p for p in self.decoder.parameters() if p.ndim == 2]
        return -torch.stack([w.square().sum() for w in weights]).sum() / (2 * scale**2)

    def imitate(
        self,
        path: Float[Tensor, "window time latent"],
        seen: Bool[Tensor, "window time"] | None,
        batch: Batch | None = None,
    ) -> Float[Tensor, "window parameter latent"]:
        """θ of the roll-outs nearest to ``path`` where observed, as long as those of ``batch``."""
        return self.imitator.fits(path, seen, None if batch is None else self._lengths(batch))

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Roll-outs ỹ of the movements in the latent space, without their uncertainty."""
        return Predictive(location=self._rolled(batch, posterior)[None])

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """The movements rolled out by the DMP and decoded, p(x̂ | θ)."""
        return self.decode(self._rolled(batch, posterior)[None])

    def _rolled(
        self, batch: Batch, posterior: Posterior | None
    ) -> Float[Tensor, "sequence time latent"]:
        θ, frames = self._imitated(batch, posterior), self._whole(batch)
        return self.imitator.roll_outs(θ, self._lengths(batch), frames)

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Missing joints by the chain of §5.3.4 and a DMP; missing frames given those seen."""
        y, seen = self._encoded(batch, posterior)
        if bool(seen.all()):
            return self.decode(self._smoothed(y, batch.mask)[None])
        paths = self._completed(y, seen, y.shape[1], draws)
        return self.decode(torch.where(seen[..., None], y, paths))

    def _smoothed(
        self,
        y: Float[Tensor, "sequence time latent"],
        mask: Bool[Tensor, "sequence time channel"] | None,
    ) -> Float[Tensor, "sequence time latent"]:
        """Roll-outs nearest to the paths of whole movements with missing joints."""
        if mask is None or not (self.is_ragged or y.shape[1] == self.frames):
            return y
        own = self._lasting(y.shape[1])
        rolled = own.roll_out(own.fit(y))
        return torch.where(mask.all(-1).all(-1)[:, None, None], y, rolled)

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Roll-outs given the encoded frames observed; phase 0 is the first frame."""
        y, seen = self._encoded(batch, posterior)
        known = y.shape[1]
        return self.decode(self._completed(y, seen, known + horizon, draws)[:, :, known:])

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Goal changes (§5.3.6, in latent space), other durations, and switching (89)."""
        own, duration = self._lasting(self._whole(batch)), wishes.duration
        θ, length = self._imitated(batch, posterior), round((own.frames - 1) * duration) + 1
        if wishes.goal is not None:
            θ = own.aimed(θ, need(posterior).encode(wishes.goal).mean)
        if wishes.onto is None:
            return self.decode((own.design(length, duration=duration).to(θ) @ θ)[None])
        self._whole(wishes.onto)
        η = ramp(length, wishes.start, wishes.steps)
        here = own.design(length, duration=duration, weight=1 - η)
        there = own.design(length, duration=duration, weight=η, begin=False)
        path = here.to(θ) @ θ + there.to(θ) @ self._imitated(wishes.onto, posterior)
        return self.decode(path[None])

    def encode(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """y_t = enc(x_t) of every frame, before the DMP; missing entries count as 0."""
        return Predictive(location=need(posterior).encode(batch.values, batch.mask).mean[None])

    def decode(self, paths: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | y_t), independent of the frames beside."""
        return Predictive(location=self.decoder(paths), noise=self.σ, joint=True)


def _inside(lengths: Tensor | None, time: int) -> Tensor | bool:
    """Frames that are none of the padding."""
    if lengths is None:
        return True
    return (torch.arange(time, device=lengths.device) < lengths[:, None])[..., None]


def _all(mask: Tensor | None) -> Tensor | bool:
    return True if mask is None else mask
