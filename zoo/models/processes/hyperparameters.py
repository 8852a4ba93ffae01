"""Inducing inputs and hyperparameters of a sparse Gaussian process, and where they start."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zoo.datasets.records import Pairs, Sequences
from zoo.models.processes.covariances import learned_shape, stationary
from zoo.models.processes.evidence import pairs_of
from zoo.models.processes.inducing import Config
from zoo.models.processes.kernels import median_distance, squared_distances
from zoo.types import Layout

__all__ = ["InducingInputs"]


class InducingInputs(nn.Module):
    """x̄, l, σ_n²/σ_f² and σ_f², in float64."""

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    inducing: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """One length for all features, or one each."""
        super().__init__()
        self.layout, self.config = layout, config
        lengths = len(layout.inputs) if config.ard else 1
        self.log_length = nn.Parameter(torch.zeros(lengths, dtype=self.dtype))
        self.log_noise = nn.Parameter(torch.zeros((), dtype=self.dtype))
        signal = torch.zeros(len(layout.channels), dtype=self.dtype)
        self.log_signal = nn.Parameter(signal, requires_grad=False)
        self.log_shape = learned_shape(config.kernel)
        self._set_inducing(torch.empty(0, dtype=self.dtype))

    @property
    def length(self) -> Float[Tensor, " feature"]:
        """Length scales l."""
        return self.log_length.exp()

    @property
    def noise(self) -> Float[Tensor, ""]:
        """Noise ratio σ_n²/σ_f²."""
        return self.config.noise_floor + self.log_noise.exp()

    @property
    def signal(self) -> Float[Tensor, " target"]:
        """Signal variance σ_f² of every target."""
        return self.log_signal.exp()

    @property
    def noise_std(self) -> Float[Tensor, " target"]:
        """σ_n of every target."""
        return (self.noise * self.signal).sqrt().detach()

    def _begin(self, data: Sequences | Pairs) -> Pairs:
        """Draw inducing inputs; start at their median distance and the configured noise."""
        data = pairs_of(data)
        known = data.mask.any(1).nonzero()[:, 0]
        order = torch.randperm(len(known), device=known.device)[: self.config.count(len(known))]
        self._set_inducing(data.inputs[known[order]].to(self.dtype))
        inducing = self.inducing.detach()
        among = squared_distances(inducing, inducing).fill_diagonal_(0)
        with torch.no_grad():
            self.log_length.fill_(median_distance(among).log())
            self.log_noise.fill_(self.config.noise - self.config.noise_floor).log_()
            if self.log_shape is not None:
                self.log_shape.zero_()
        return data

    def _set_inducing(self, inputs: Tensor) -> None:
        if self.config.learn_inducing:
            self.inducing = nn.Parameter(inputs.clone())
        else:
            self.register_buffer("inducing", inputs)

    def _jittered(self, k_uu: Tensor) -> Tensor:
        return k_uu + torch.diag(k_uu.new_full((len(k_uu),), self.config.jitter))

    def _kernel(self, a: Tensor, b: Tensor) -> Tensor:
        shape = None if self.log_shape is None else self.log_shape.exp()
        return stationary(self.config.kernel, a, b, self.length, shape)

    @torch.no_grad()
    def _start_at(self, other: InducingInputs) -> None:
        """The hyperparameters of ``other``; its first length scale where both have not as many."""
        self.log_length.copy_(other.log_length[: len(self.log_length)])
        self.log_noise.copy_(other.log_noise)
        if self.log_shape is not None and other.log_shape is not None:
            self.log_shape.copy_(other.log_shape)
