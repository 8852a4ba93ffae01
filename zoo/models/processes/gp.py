"""Exact Gaussian process regression with a stationary covariance."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from zoo.contract.settings import Positive, settings
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NotFittedError, TooManyItemsError
from zoo.models.processes.covariances import Name, learned_shape, stationary
from zoo.models.processes.evidence import dense, pairs_of, patterns
from zoo.models.processes.gaussian import joint_draws, white_posterior
from zoo.models.processes.kernels import median_distance, squared_distances, squared_exponential
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Sites

__all__ = ["Config", "GaussianProcess"]

SHARE = 1e-2
HELD, HELD_A_KERNEL = 10, 4


@settings
class Config:
    """Settings of :class:`GaussianProcess`.

    ``kernel``: the covariance, with a learned α where it is the rational quadratic;
    ``shared``: one length scale and noise ratio for all targets, hence one factorisation; ``ard``:
    a length scale for each feature; ``noise_floor``: smallest σ_n²/σ_f²; ``noise``: its starting
    value; ``joint_items``: up to so many new items are drawn jointly; ``memory``: what the matrices
    of items × items may take in GB. Some 14 are held at once for one target: 8 GB are 8,400 items.
    """

    kernel: Name = "squared-exponential"
    shared: bool = False
    ard: bool = False
    noise: Positive = 0.1
    noise_floor: Positive = 1e-6
    joint_items: Annotated[int, Field(ge=0)] = 512
    memory: Positive = 8.0

    def __post_init__(self) -> None:
        """Refuse a floor above the noise."""
        if not self.noise_floor < self.noise:
            raise ValueError(
                f"noise_floor must be below noise; got {self.noise_floor} and {self.noise}"
            )


class _Group(NamedTuple):
    """Targets with the same observed items and hyperparameters: they share a factorisation."""

    items: Tensor
    targets: list[int]
    kernel: int


class GaussianProcess(nn.Module):
    """A Gaussian process for each target, with its posterior in closed form.

    ``f_p ~ GP(0, σ_f² exp(−‖x − x'‖²/2l²))``, ``y_p ~ N(f_p, σ_n²)`` — (35), (36); the posterior is
    (39), (40). ``kernel`` takes a Matérn kernel of smoothness 1/2, 3/2 or 5/2 of gpytorch for the
    squared exponential, or the rational quadratic (1 + ‖x − x'‖²/2αl²)^−α. Length scale l (of every
    feature with ``ard``), noise σ_n, signal σ_f and α maximise the evidence (41) with the gradient
    (42); σ_f² is profiled out. Each target has its own hyperparameters unless ``shared``. Missing
    targets are left out, target by target. Thesis §2.1.6 and §3.2.3, with the squared distance that
    (35) means; Rasmussen & Williams (2006).

    The posterior of f is exact given l, σ_n and σ_f, which are point estimates: their uncertainty
    is not in the bands. The Pyro program draws f at the inputs and y given f; 1 % of
    ``noise_floor`` is counted to f there, so that its covariance has a factor: p(y) stays the same.

    Cost grows with the cube of the items: up to some 3000; ``fitc`` goes beyond. It gives no
    joint distribution over targets, which are independent in this model.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    inputs: Tensor
    targets: Tensor
    observed: Tensor
    signal: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Hyperparameters for the layout's features and targets; data come by ``condition``."""
        super().__init__()
        self.layout, self.config = layout, config
        kernels = 1 if config.shared else len(layout.channels)
        lengths = len(layout.inputs) if config.ard else 1
        self.log_length = nn.Parameter(torch.zeros(kernels, lengths, dtype=self.dtype))
        self.log_noise = nn.Parameter(torch.zeros(kernels, dtype=self.dtype))
        self.log_shape = learned_shape(config.kernel, kernels)
        for name in ("inputs", "targets", "observed", "signal"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        self._distances: Tensor | None = None
        self._factors: list[Tensor] = []

    @property
    def length(self) -> Float[Tensor, "kernel feature"]:
        """Length scales l."""
        return self.log_length.exp()

    @property
    def noise(self) -> Float[Tensor, " kernel"]:
        """Noise ratio σ_n²/σ_f²."""
        return self.config.noise_floor + self.log_noise.exp()

    def condition(self, data: Sequences | Pairs) -> None:
        """Take in the training pairs; start at the median distance and the configured noise."""
        data = pairs_of(data)
        self._check_size(len(data))
        self.inputs, self.targets = data.inputs.to(self.dtype), data.targets.to(self.dtype)
        self.observed = data.mask.to(self.dtype)
        distances = squared_distances(self.inputs, self.inputs)
        fast = self.config.kernel == "squared-exponential"
        self._distances, self._factors = distances if fast else None, []
        with torch.no_grad():
            self.log_length.fill_(median_distance(distances).log())
            self.log_noise.fill_(self.config.noise - self.config.noise_floor).log_()
            if self.log_shape is not None:
                self.log_shape.zero_()

    def objective(self) -> Float[Tensor, ""]:
        """Minus the log evidence (41), summed over targets."""
        terms = [dense(self._covariance(g), self._observed_targets(g)) for g in self._groups()]
        return torch.stack(terms).sum()

    @torch.no_grad()
    def settle(self) -> None:
        """Keep σ_f² of every target under the final hyperparameters."""
        signal = torch.zeros_like(self.targets[0])
        for group in self._groups():
            y = self._observed_targets(group)
            alpha = torch.cholesky_solve(y, torch.linalg.cholesky(self._covariance(group)))
            signal[group.targets] = (y * alpha).mean(0)
        self.signal = signal
        self._distances, self._factors = None, []

    @torch.no_grad()
    def regress(self, inputs: Float[Tensor, "item feature"], *, draws: int) -> Predictive:
        """Posterior (39), (40) of every target, with joint draws over not too many items."""
        mean = inputs.new_empty(len(inputs), len(self.signal))
        variance = torch.empty_like(mean)
        joint = draws > 0 and len(inputs) <= self.config.joint_items
        paths = mean.new_empty(draws, *mean.shape) if joint else None
        for group, factor in zip(self._groups(), self._factorised(), strict=True):
            which, signal = group.targets, self.signal[group.targets]
            cross = self._kernel(group.kernel, self.inputs[group.items], inputs)
            alpha = torch.cholesky_solve(self._observed_targets(group), factor)
            explained = torch.linalg.solve_triangular(factor, cross, upper=False)
            mean[:, which] = cross.mT @ alpha
            left = (1 - explained.square().sum(0)).clamp_min(0)
            variance[:, which] = left[:, None] * signal
            if paths is not None:
                covariance = self._kernel(group.kernel, inputs, inputs) - explained.mT @ explained
                paths[:, :, which] = joint_draws(mean[:, which], covariance, signal, draws)
        return Predictive(
            location=mean[None],
            noise=self._noise_variance().sqrt(),
            epistemic=variance.sqrt()[None],
            draws=paths,
        )

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: f of every target at the inputs, then y."""
        y, mask = self._observations(batch)
        std = (self.signal * self._rest).sqrt()
        with pyro.plate("targets", len(y)):
            root = self.signal.sqrt()[:, None, None] * self._root(batch)
            f = pyro.sample("f", dist.MultivariateNormal(torch.zeros_like(y), scale_tril=root))
            law = dist.Normal(f, std[:, None]).mask(mask).to_event(1)
            drawn: Tensor = pyro.sample("y", law, obs=batch.given(y))
        return drawn

    def posterior_sites(self, batch: Batch) -> Sites:
        """The exact p(f | y) at the inputs of ``batch``, its hyperparameters point estimates."""
        y, mask = self._observations(batch)
        root = self._root(batch)
        mean, narrow = white_posterior(root.mT, mask / self._rest[:, None], y)
        f = dist.MultivariateNormal(
            (root @ mean[..., None])[..., 0],
            scale_tril=self.signal.sqrt()[:, None, None] * (root @ narrow),
        )
        return Sites(plate="targets", size=len(y), rows=len(y), of={"f": lambda _: f})

    def report(self) -> dict[str, Any]:
        """Hyperparameters in the model's scale."""
        return {
            "length_scale": self.length.tolist(),
            "signal_std": self.signal.sqrt().tolist(),
            "noise_std": self._noise_variance().sqrt().tolist(),
        }

    @property
    def _rest(self) -> Float[Tensor, " target"]:
        """σ_n²/σ_f² of every target without the share of the noise that f takes over."""
        return (self.noise - self._share).expand(len(self.signal))

    @property
    def _share(self) -> float:
        return SHARE * self.config.noise_floor

    def _root(self, batch: Batch) -> Float[Tensor, "kernel item item"]:
        """Lower roots of κ at the inputs, with a share of the noise so that they exist."""
        if batch.inputs is None or len(batch) != batch.total:
            raise ValueError(f"f needs all {batch.total} items with inputs at once")
        x = batch.inputs.flatten(1)
        kernels = range(len(self.log_noise))
        covariance = torch.stack([self._kernel(k, x, x) for k in kernels])
        share = covariance.new_full((len(x),), self._share)
        root: Tensor = torch.linalg.cholesky(covariance + torch.diag(share))
        return root

    def _observations(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Targets of all items, and which of them were observed, shape (target, item)."""
        if self.signal.numel() == 0:
            raise NotFittedError("gp has no signal variance yet; call zoo.fit first")
        y = batch.values.flatten(1).mT
        if batch.mask is None:
            return y, torch.ones_like(y, dtype=torch.bool)
        return y, batch.mask.flatten(1).mT

    def _check_size(self, items: int) -> None:
        """Refuse before the first matrix is made what would not fit."""
        needed = 8e-9 * items**2 * (HELD + HELD_A_KERNEL * len(self.log_noise))
        if needed > self.config.memory:
            raise TooManyItemsError(
                f"gp is exact and holds matrices of items × items: {items} items need some "
                f"{needed:.1f} GB, and memory={self.config.memory:g} GB is allowed; take 'fitc' or "
                "'vfe', whose cost grows with the items alone, a subset of the items, or a larger "
                "memory"
            )

    def _groups(self) -> list[_Group]:
        found = []
        for observed, targets in patterns(self.observed.bool()):
            items = observed.nonzero()[:, 0]
            split = [targets] if self.config.shared else [(t,) for t in targets]
            found += [_Group(items, list(t), 0 if self.config.shared else t[0]) for t in split]
        return found

    def _observed_targets(self, group: _Group) -> Tensor:
        return self.targets[group.items][:, group.targets]

    def _covariance(self, group: _Group) -> Tensor:
        """κ + ρI over the observed items."""
        items = group.items
        if self._distances is None or self.config.ard:
            inputs = self.inputs[items]
            covariance = self._kernel(group.kernel, inputs, inputs)
        else:
            distances = self._distances[items][:, items]
            covariance = squared_exponential(distances, self.log_length[group.kernel, 0])
        noise = self.noise[group.kernel].expand(len(items))
        return covariance + torch.diag(noise)

    def _kernel(self, kernel: int, a: Tensor, b: Tensor) -> Tensor:
        shape = None if self.log_shape is None else self.log_shape[kernel].exp()
        return stationary(self.config.kernel, a, b, self.length[kernel], shape)

    def _factorised(self) -> list[Tensor]:
        if not self._factors:
            self._factors = [torch.linalg.cholesky(self._covariance(g)) for g in self._groups()]
        return self._factors

    def _noise_variance(self) -> Float[Tensor, " target"]:
        return (self.noise * self.signal).detach()
