"""Networks and constants of VAE-DMP, the densities of its weights and its decoder."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar

import pyro.distributions as dist
import torch
from jaxtyping import Float, Int
from pydantic import Field
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from zoo.contract.settings import Count, Positive, settings
from zoo.movement.durations import lengths_of, moves, pace, windows_of
from zoo.movement.lengths import check_whole, checked_span
from zoo.movement.plan import Latents, Plan
from zoo.movement.response import Transformation, critical_system, discrete_basis
from zoo.nn.metric import jacobians
from zoo.nn.mlp import Activation, mlp
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout

__all__ = ["Config", "LatentDmp"]

BEYOND = 0.1


@settings
class Config:
    """``latent_dim`` d', ``hidden`` decoder units of ``activation``, ``kernels``, α (β = α/4).

    None for α is 25 a movement, or 0.4 a frame for movements under 64 frames, whose Euler steps
    would else be unstable. ``w_scale`` and ``velocity_scale`` are the prior standard deviations of
    w and ż_1, in units of the acceleration αβ and of the movement's length; ``noise_scale`` is
    where w_ε starts, in the same unit as w, and stays where ``fixed_noise``; ``output_std`` where
    the constant σ starts, in scaled units, never below ``output_floor``.

    ``goal_scaling`` multiplies the forcing term by z^goal − z_0, the first frame, as §6.3.2 does:
    w then says how a movement goes to its goal, wherever that is. ``common_forcing`` is the
    standard deviation of w about one w̄ of all movements and dimensions, which is learned: paths
    are straight in latent space, and the decoder has to bend them; None: 1, about 0.

    ``flatness`` is the weight η of a prior p(g) ∝ exp(−η (‖J‖²/c² − 1)²) on the decoder, J = dx/dz
    and c² its mean square, at points all over the box that the paths of a batch span, and a tenth
    beyond: equal steps in latent space are then equal movements, also between the movements known
    (after Chen et al., *Learning flat latent manifolds with VAEs*, ICML 2020). It needs a smooth
    ``activation``.
    """

    latent_dim: Count = 5
    hidden: Count = 200
    activation: Activation = "relu"
    kernels: Annotated[int, Field(ge=2)] = 50
    alpha: Positive | None = None
    transition_hidden: Count = 32
    w_scale: Positive = 3.0
    velocity_scale: Positive = 10.0
    noise_scale: Positive = 0.3
    fixed_noise: bool = False
    output_std: Positive = 0.3
    output_floor: Positive = 1e-3
    goal_scaling: bool = False
    common_forcing: Positive | None = None
    flatness: Annotated[float, Field(ge=0)] = 0.0

    def __post_init__(self) -> None:
        """Refuse a penalty on the slopes of a decoder that is piecewise linear."""
        if self.flatness and self.activation == "relu":
            raise ValueError("flatness needs a smooth activation, such as softplus; got relu")


class LatentDmp(nn.Module):
    """Networks, constants and densities' parameters of ``VaeDmp``."""

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float32
    label: ClassVar[str] = "vae-dmp"
    phased: ClassVar[bool] = True

    w_noise: Tensor
    basis: Tensor
    step_matrix: Tensor
    step_input: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """A model of the movements of ``layout``, the longest as the unit of time."""
        super().__init__()
        shortest, self.frames = checked_span(self.label, layout)
        self.config, self.is_ragged = config, shortest < self.frames
        self.latent_dim, self.kernels = config.latent_dim, config.kernels
        self.goal_scaling = config.goal_scaling
        channels, latent = len(layout.channels), config.latent_dim
        self.system = critical_system(config.alpha, self.frames, shortest)
        self.decoder = mlp([latent, config.hidden, channels], config.activation)
        self.g = mlp([latent, config.transition_hidden, latent], "tanh")
        nn.init.zeros_(self.g[-1].weight)  # type: ignore[arg-type]
        if config.common_forcing is not None:
            self.w_common = nn.Parameter(torch.zeros(config.kernels, 1))
        w_noise = config.noise_scale * torch.eye(latent)
        if config.fixed_noise:
            self.register_buffer("w_noise", w_noise)
        else:
            self.w_noise = nn.Parameter(w_noise)
        self.output_root = nn.Parameter(torch.full((channels,), config.output_std**0.5))
        self.register_buffer("basis", self.kernels_at(self.frames - 1).to(self.w_noise))
        step_matrix, step_input = moves(self.system, latent)
        self.register_buffer("step_matrix", step_matrix.to(self.w_noise))
        self.register_buffer("step_input", step_input.to(self.w_noise))

    @property
    def output_std(self) -> Float[Tensor, " channel"]:
        """The constant standard deviation of every channel, (83)."""
        return self.output_root.square() + self.config.output_floor

    def lengths(self, batch: Batch) -> Int[Tensor, " sequence"] | None:
        """Frames of every movement; None where all have τ = 1."""
        return lengths_of(batch, self.frames)

    def pace(self, frames: int) -> float:
        """τ of a movement of ``frames`` frames, too few of which are refused."""
        return pace(self.label, self.system, frames, self.frames)

    def lasting(self, frames: int) -> Transformation:
        """The system of a movement of ``frames`` frames: its τ is its share of the longest."""
        return replace(self.system, tau=self.pace(frames))

    def _whole(self, batch: Batch) -> int:
        """Frames of whole movements, of which this model can roll out as many."""
        frames = batch.values.shape[1]
        check_whole(self.label, self.frames, frames, self.is_ragged)
        self.pace(frames)
        return frames

    def transition(self, batch: Batch) -> Float[Tensor, "*window state state"]:
        """A of (76) for row vectors (z*, ż), of every window where movements differ in τ."""
        return self._moves(batch)[0]

    def _moves(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """A and the input's rows, shared or of every window."""
        lengths = self.lengths(batch)
        if lengths is None:
            return self.step_matrix, self.step_input
        each, which = windows_of(batch, lengths).unique(return_inverse=True)
        found = [moves(self.lasting(n), self.latent_dim) for n in each.tolist()]
        step, push = (torch.stack(part).to(self.w_noise) for part in zip(*found, strict=True))
        return step[which], push[which]

    def embed(self, z: Float[Tensor, "*batch latent"]) -> Float[Tensor, "*batch latent"]:
        """z* = g(z)."""
        moved: Tensor = z + self.g(z)
        return moved

    def forcing_prior(self, rows: int) -> TorchDistribution:
        """p(w) of ``rows`` movements."""
        shape = [rows, self.kernels, self.latent_dim]
        zero, std = self.basis.new_zeros(()), self.config.common_forcing
        mean = zero if std is None else self.w_common
        prior = dist.Normal(mean, zero + (1.0 if std is None else std), validate_args=False)
        normal: TorchDistribution = prior.expand(shape).to_event(2)
        return normal

    def scaled(
        self,
        w: Float[Tensor, "*sequence kernel latent"],
        goal: Float[Tensor, "*sequence latent"],
        start: Float[Tensor, "*sequence latent"] | None,
    ) -> Float[Tensor, "*sequence kernel latent"]:
        """w (z^goal − z_0), in the space of z*, where there is a ``start``: goal scaling."""
        return w if start is None else w * (goal - start).unsqueeze(-2)

    def flatness_prior(self, path: Float[Tensor, "window time latent"]) -> Float[Tensor, " window"]:
        """log p(g) up to a constant, −η (‖J‖²/c² − 1)² at a random point for each window."""
        low, high = (edge(path.detach(), (0, 1)) for edge in (torch.amin, torch.amax))
        share = (1 + 2 * BEYOND) * torch.rand(len(path), self.latent_dim).to(path) - BEYOND
        points = torch.lerp(low, high, share)
        size = jacobians(self.decoder, points).square().sum((-1, -2))
        return -self.config.flatness * (size / size.mean() - 1).square()

    def _latents(self, drawn: dict[str, Tensor]) -> Latents:
        start = self.embed(drawn["start"]) if self.goal_scaling else None
        goal = self.embed(drawn["goal"])
        return Latents(
            w=self.scaled(drawn["w"], goal, start),
            plan=Plan.of(drawn),
            goal=goal,
            position=self.embed(drawn["z"][:, :, 0]),
            velocity=self.config.velocity_scale * drawn["velocity"],
        )

    def decode(self, paths: Float[Tensor, "sample sequence time latent"]) -> Predictive:
        """p(x_t | z*_t)."""
        location = self.decoder(paths.to(self.output_root))
        return Predictive(location=location, noise=self.output_std, joint=True)

    def kernels_at(self, steps: int, duration: float = 1.0) -> Float[Tensor, "step kernel"]:
        """Ψ of the first ``steps`` steps of a movement ``duration`` times as long, in float64."""
        time = torch.arange(steps, dtype=torch.float64)
        whole = (self.frames - 1) * duration
        return discrete_basis(time, kernels=self.kernels, duration=whole)
