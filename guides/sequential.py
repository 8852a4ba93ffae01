"""The guide of a filter over any latent state: all noise as one site, recognised step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Protocol

import pyro
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from zoo.contract.settings import Count, Positive, settings
from zoo.guides.recurrence import NoiseNetwork, RecurrentNoise
from zoo.nn.mlp import trunk
from zoo.nn.moments import GaussianHead
from zoo.types import Batch, Layout

__all__ = ["Config", "RecognisedNoise", "SequentialGuide", "StateSpace"]

Step = Callable[[Tensor, Tensor, Tensor | None], Tensor]


class StateSpace(Protocol):
    """A model with a site ``w`` of noise, of which the first makes the first state."""

    latent_dim: int
    begin: nn.Module
    transition: nn.Module

    def actions(self, batch: Batch, steps: int) -> Float[Tensor, "window step control"] | None:
        """Actions of the first ``steps`` frames; None without controls."""
        ...


@settings
class Config:
    """``hidden`` units of both networks; the first state is read from ``memory`` frames."""

    hidden: Count = 200
    memory: Count = 5
    noise_std: Positive = 0.5


class RecognisedNoise(RecurrentNoise):
    """q(w | x, a): w_1 from the first frames, w_{t+1} ~ N(μ, σ²) of (x_{t+1}, z_t, a_t), (79)."""

    def __init__(
        self,
        network: NoiseNetwork,
        features: Float[Tensor, "step window hidden"],
        first: tuple[Float[Tensor, "window latent"], Float[Tensor, "window latent"]],
        begin: Callable[[Tensor], Tensor],
        step: Step,
        actions: Float[Tensor, "window step control"] | None,
    ) -> None:
        """Noise of ``step`` + 1 frames; ``first`` are the moments of w_1."""
        self.network, self.features, self.first = network, features, first
        self.begin, self.step, self.actions = begin, step, actions
        mean = first[0]
        super().__init__(len(features) + 1, mean.shape[0], mean.shape[1], mean)

    def draw(self, η: Float[Tensor, "step window latent"]) -> tuple[Tensor, Tensor]:
        """Noise and state in turn."""
        return self._run(lambda t, mean, std: mean + std * η[t])[::2]

    def moments(
        self, value: Float[Tensor, "window step latent"]
    ) -> tuple[Float[Tensor, "step window latent"], Float[Tensor, "step window latent"]]:
        """Mean and standard deviation along the states of ``value``."""
        return self._run(lambda t, mean, std: value[:, t])[1:]

    def _run(
        self, choose: Callable[[int, Tensor, Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        mean, std = self.first
        w, means, stds = [choose(0, mean, std)], [mean], [std]
        z = self.begin(w[0])
        for t, features in enumerate(self.features):
            mean, std = self.network(features, z)
            w.append(choose(t + 1, mean, std))
            means.append(mean)
            stds.append(std)
            if t + 1 < len(self.features):
                z = self.step(z, w[-1], None if self.actions is None else self.actions[:, t])
        return torch.stack(w), torch.stack(means), torch.stack(stds)


class SequentialGuide(nn.Module):
    """q(w_{1:T} | x_{1:T}, a_{1:T−1}) of windows; every moment is of frames, states and actions.

    w_1 is read from the first frames and the actions at them. Karl, Soelch, Bayer & van der Smagt,
    *Deep variational Bayes filters*, ICLR 2017, eq. 8: q(w_{t+1} | z_t, x_{t+1}, u_t).
    """

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: StateSpace, config: Config) -> None:
        """Networks for ``layout``'s channels and controls and the state of ``model``."""
        super().__init__()
        object.__setattr__(self, "_model", model)
        self.config = config
        latent, self.controls = model.latent_dim, len(layout.inputs)
        inputs = len(layout.channels) + self.controls
        self.trunk = trunk([config.memory * inputs, config.hidden])
        self.first = GaussianHead(config.hidden, latent, initial=config.noise_std)
        self.noise = NoiseNetwork(
            channels=inputs, latent_dim=latent, hidden=config.hidden, initial=config.noise_std
        )

    def forward(self, batch: Batch) -> None:
        """The Pyro program of the one latent site."""
        model: StateSpace = self.__dict__["_model"]
        windows, time = batch.values.shape[:2]
        actions = model.actions(batch, time - 1)
        with pyro.plate("windows", batch.total, subsample=torch.arange(windows)):
            noise = RecognisedNoise(
                self.noise,
                self.noise.features(_beside(batch.values[:, 1:], actions).transpose(0, 1)),
                self.first(self.trunk(self._beginning(batch.values, actions))),
                model.begin,
                model.transition,
                actions,
            )
            pyro.sample("w", noise)

    def encode(
        self,
        values: Float[Tensor, "*batch channel"],
        mask: Bool[Tensor, "*batch channel"] | None = None,
    ) -> torch.distributions.Normal:
        """q(w_1) of frames that stand still under the mean action; missing entries count as 0."""
        seen = values if mask is None else torch.where(mask, values, 0.0)
        known = torch.nn.functional.pad(seen, (0, self.controls))
        repeated = known[..., None, :].expand(*known.shape[:-1], self.config.memory, -1)
        mean, std = self.first(self.trunk(repeated.flatten(-2)))
        return torch.distributions.Normal(mean, std)

    def _beginning(
        self,
        values: Float[Tensor, "window time channel"],
        actions: Float[Tensor, "window step control"] | None,
    ) -> Float[Tensor, "window feature"]:
        """The first frames and their actions side by side; of shorter windows the last repeated.

        The action at a window's last frame is not known, and counts as the mean, 0.
        """
        acted = None if actions is None else torch.nn.functional.pad(actions, (0, 0, 0, 1))
        known = _beside(values, acted)
        frame = torch.arange(self.config.memory, device=values.device)
        return known[:, frame.clamp(max=values.shape[1] - 1)].flatten(1)


def _beside(
    values: Float[Tensor, "window time channel"],
    actions: Float[Tensor, "window time control"] | None,
) -> Float[Tensor, "window time input"]:
    return values if actions is None else torch.cat([values, actions], -1)
