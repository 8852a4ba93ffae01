"""The guide of deep variational Bayes filters over a linear latent state."""

from __future__ import annotations

from typing import ClassVar, Literal, Protocol

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from zoo.contract.settings import Count, Positive, settings
from zoo.guides.recurrence import FilteringNoise, NoiseNetwork, Stacked
from zoo.movement.durations import stretched
from zoo.movement.plan import Plan
from zoo.nn.mlp import trunk
from zoo.nn.moments import GaussianHead
from zoo.types import Batch, Layout

__all__ = ["Config", "FilteringGuide", "LatentDynamics", "normal"]

ROOT_SCALE = 0.1


class LatentDynamics(Protocol):
    """A latent state s = (z*, ż) with linear steps s_{t+1} = s_t A + drive_t + ε̂_{t+1} G."""

    frames: int
    latent_dim: int
    kernels: int
    goal_scaling: bool

    def lengths(self, batch: Batch) -> Int[Tensor, " sequence"] | None:
        """Frames of every movement; None where all have as many as the model was made for."""
        ...

    def transition(self, batch: Batch) -> Float[Tensor, "*window state state"]:
        """A of (76), for row vectors: shared, or of every window."""
        ...

    def noise_gain(self, batch: Batch) -> Float[Tensor, "*window latent state"]:
        """G: how the noise ε̂ enters the next state, (77)."""
        ...

    def initial_state(
        self,
        z: Float[Tensor, "window latent"],
        velocity: Float[Tensor, "window latent"],
        batch: Batch,
    ) -> Float[Tensor, "window state"]:
        """State of a window's first frame."""
        ...

    def drive(self, plan: Plan, batch: Batch) -> Float[Tensor, "step window state"]:
        """What goal and forcing term add in every step of every window."""
        ...


@settings
class Config:
    """``hidden`` units in every layer, ``features`` h of g_1, and q(w): a point or a Gaussian."""

    hidden: Count = 200
    features: Count = 10
    weights: Literal["point", "gaussian"] = "point"
    encoder_std: Positive = 0.3
    noise_std: Positive = 0.3


class FilteringGuide(nn.Module):
    """q of a filter over a linear latent state: z_t, ż_1, ε̂_{2:T} of windows; w, goal of movements.

    q(z_t | x_t) encodes every frame (80), the first as the window's initial state and a movement's
    last as its goal (78); the velocity is encoded from the first two frames (§6.2.1.4, m = 2);
    w = g_2(g_1(x_1), …, g_1(x_n)) (88), with g_1 at n equal phases of movements that last longer or
    shorter than n frames; ε̂ is recognised from (x_{t+1}, z_t) (79). What belongs to a movement is
    computed once, however many of its windows a batch holds.
    """

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: LatentDynamics, config: Config) -> None:
        """Networks for ``layout``'s channels and the latent state of ``model``."""
        super().__init__()
        object.__setattr__(self, "_model", model)
        self.config = config
        channels, latent, weights = len(layout.channels), model.latent_dim, model.kernels
        self.trunk = trunk([channels, config.hidden])
        self.encoder = _head(config.hidden, latent, config.encoder_std)
        self.velocity = _head(2 * config.hidden, latent, config.encoder_std)
        self.noise = NoiseNetwork(
            channels=channels, latent_dim=latent, hidden=config.hidden, initial=config.noise_std
        )
        self.g_1 = nn.Sequential(nn.Linear(channels, config.features), nn.Softmax(dim=-1))
        width = 1 if config.weights == "point" else 2
        self.g_2 = nn.Linear(self.places * config.features, width * weights * latent)

    def forward(self, batch: Batch) -> None:
        """The Pyro program of all latent sites."""
        model = self._dynamics
        rows, windows = torch.arange(len(batch.movements)), len(batch)
        with pyro.plate("movements", batch.total_sequences, subsample=rows):
            plan = self.plan(batch)
        h = self.trunk(batch.values)
        with pyro.plate("windows", batch.total, subsample=torch.arange(windows)):
            z = pyro.sample("z", normal(self.encoder(h), 2))
            velocity = pyro.sample("velocity", normal(self._velocity(h), 1))
            features = self.noise.features(batch.values.transpose(0, 1)[1:])
            first = z.reshape(-1, *z.shape[-3:])[:, :, 0]
            speed = velocity.reshape(-1, *velocity.shape[-2:])
            parts = [
                FilteringNoise(
                    self.noise,
                    features,
                    model.initial_state(z_1, v, batch),
                    model.drive(each, batch),
                    model.transition(batch),
                    model.noise_gain(batch),
                )
                for z_1, v, each in zip(first, speed, plan.draws(), strict=True)
            ]
            pyro.sample("epsilon", parts[0] if z.ndim == 3 else Stacked(parts, z.shape[:-3]))

    def plan(self, batch: Batch) -> Plan:
        """What is recognised of whole movements."""
        x, lengths = batch.movements, self._dynamics.lengths(batch)
        w = pyro.sample("w", self.weights(x, lengths))
        goal = pyro.sample("goal", normal(self._encode(_last(x, lengths)), 1))
        start = None
        if self._dynamics.goal_scaling:
            start = pyro.sample("start", normal(self._encode(x[:, 0]), 1))
        return Plan(w=w, goal=goal, start=start)

    @property
    def places(self) -> int:
        """Number of places of a movement whose features make w."""
        return self._dynamics.frames

    def weights(
        self,
        movements: Float[Tensor, "sequence frame channel"],
        lengths: Int[Tensor, " sequence"] | None = None,
    ) -> TorchDistribution:
        """q(w | x_{1:n}) of (88), of features at equal phases where movements differ in length."""
        return self.forcing(stretched(self.g_1(movements), lengths, self.places))

    def forcing(self, features: Float[Tensor, "sequence place feature"]) -> TorchDistribution:
        """q(w) of features g_1: MLP_w and, for a Gaussian, its standard deviations."""
        g = self.g_2(features.flatten(1))
        shape = (len(features), -1, self._dynamics.latent_dim)
        if self.config.weights == "point":
            point: TorchDistribution = dist.Delta(g.view(shape)).to_event(2)
            return point
        mean, root = g.chunk(2, dim=1)
        return normal((mean.view(shape), (root.view(shape) + ROOT_SCALE).square() + 1e-3), 2)

    def encode(
        self,
        values: Float[Tensor, "*batch channel"],
        mask: Bool[Tensor, "*batch channel"] | None = None,
    ) -> torch.distributions.Normal:
        """q(z_t | x_t) of single frames; missing entries count as the training mean, 0."""
        seen = values if mask is None else torch.where(mask, values, 0.0)
        mean, std = self._encode(seen)
        return torch.distributions.Normal(mean, std)

    @property
    def _dynamics(self) -> LatentDynamics:
        model: LatentDynamics = self.__dict__["_model"]
        return model

    def _encode(self, values: Tensor) -> tuple[Tensor, Tensor]:
        moments: tuple[Tensor, Tensor] = self.encoder(self.trunk(values))
        return moments

    def _velocity(self, h: Float[Tensor, "window time hidden"]) -> tuple[Tensor, Tensor]:
        moments: tuple[Tensor, Tensor] = self.velocity(h[:, :2].flatten(1))
        return moments


def _last(
    movements: Float[Tensor, "sequence frame channel"], lengths: Int[Tensor, " sequence"] | None
) -> Float[Tensor, "sequence channel"]:
    if lengths is None:
        return movements[:, -1]
    return movements[torch.arange(len(movements), device=movements.device), lengths - 1]


def _head(inputs: int, outputs: int, std: float) -> GaussianHead:
    head = GaussianHead(inputs, outputs, initial=std)
    with torch.no_grad():
        head.root.weight *= ROOT_SCALE
    return head


def normal(moments: tuple[Tensor, Tensor], events: int) -> TorchDistribution:
    """Independent Gaussians whose last ``events`` axes belong together."""
    found: TorchDistribution = dist.Normal(*moments, validate_args=False).to_event(events)
    return found
