"""Sparse Gaussian processes with inducing inputs: FITC and the variational bound of Titsias."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import pyro
import torch
from jaxtyping import Float
from pyro.distributions import LowRankMultivariateNormal
from torch import Tensor, nn

from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NoiseDivergenceWarning
from zoo.inference.collapsed import Collapsed
from zoo.inference.evidence import pairs_of, patterns
from zoo.inference.marginal import evaluator, maximise
from zoo.nn.gaussian import joint_draws
from zoo.nn.kernels import median_distance, squared_distances, squared_exponential
from zoo.prediction import Predictive
from zoo.strategies import MarginalLikelihood
from zoo.types import Batch, Layout

__all__ = ["Config", "SparseGaussianProcess"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Settings of :class:`SparseGaussianProcess`.

    ``inducing``: how many inducing inputs are drawn from the data, or which fraction of it (17 %
    in §3.3.4); ``learn_inducing`` moves them by gradient; ``ard``: a length scale for each feature;
    ``jitter``: variance, in units of σ_f², of the noise with which u observes f at the inducing
    inputs, a part of the model; ``noise_floor``: smallest σ_n²/σ_f²; ``noise``: its starting value;
    ``compare``: fit the other bound beside FITC and warn where the noise standard deviations
    differ by more than the factor ``divergence``; ``joint_items``: up to so many new items are
    drawn jointly.
    """

    bound: Literal["fitc", "vfe"] = "fitc"
    inducing: int | float = 0.17
    learn_inducing: bool = False
    ard: bool = False
    noise: float = 0.1
    noise_floor: float = 1e-6
    jitter: float = 1e-8
    compare: bool = True
    divergence: float = 2.0
    joint_items: int = 512

    def __post_init__(self) -> None:
        """Refuse settings that have no meaning."""
        if self.bound not in ("fitc", "vfe"):
            raise ValueError(f"bound is fitc or vfe; got {self.bound!r}")
        whole = float(self.inducing).is_integer()
        if self.inducing <= 0 or (self.inducing > 1 and not whole):
            raise ValueError(f"inducing is a number or a fraction up to 1; got {self.inducing}")
        if not 0 < self.noise_floor < self.noise:
            raise ValueError(
                f"0 < noise_floor < noise is needed; got {self.noise_floor} and {self.noise}"
            )
        if self.jitter < 0 or self.divergence <= 1:
            raise ValueError(
                f"jitter ≥ 0 and divergence > 1 are needed; got {self.jitter}, {self.divergence}"
            )

    def count(self, items: int) -> int:
        """Number of inducing inputs for a training set of so many items."""
        many = isinstance(self.inducing, int) or self.inducing > 1
        number = int(self.inducing) if many else max(1, round(self.inducing * items))
        if number > items:
            raise ValueError(f"{number} inducing inputs cannot be drawn from {items} items")
        return number


class _Training(NamedTuple):
    """What only training needs: inputs, the bound of their targets, and squared distances."""

    inputs: Tensor
    bound: Collapsed
    among: Tensor
    across: Tensor


class SparseGaussianProcess(nn.Module):
    """A Gaussian process for each target, seen through u = f(x̄) at m inducing inputs x̄.

    ``u ~ N(0, K_uu)``, ``f_p | u`` as the Gaussian process has it, and
    ``y_p ~ N(K_fu K_uu⁻¹ u, diag[K_ff − Q_ff] + σ_n² I)`` with ``Q_ff = K_fu K_uu⁻¹ K_uf`` — what
    (43) means (FITC, Snelson & Ghahramani 2006); ``bound="vfe"`` drops the diagonal K − Q from the
    likelihood and pays tr(K − Q)/2σ_n² instead (Titsias 2009). Both have q(u) in closed form and
    u integrated out. Inducing inputs are drawn from the data (thesis §2.1.6, 17 % in §3.3.4) and
    fixed unless ``learn_inducing``; targets share length scale and noise ratio σ_n²/σ_f², hence
    both Cholesky factors, and each has its own σ_f², profiled out.

    FITC tends to take the noise too small and VFE too large (Bauer et al. 2016): a fit of
    ``fitc`` fits ``vfe`` beside it and warns where they part. Cost grows with items · m²; it gives
    no joint distribution over targets.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    inducing: Tensor
    signal: Tensor
    factor: Tensor
    information: Tensor
    mean: Tensor
    pattern: Tensor
    other_noise: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Hyperparameters for the layout's features; data come by ``condition``."""
        super().__init__()
        self.layout, self.config = layout, config
        lengths = len(layout.inputs) if config.ard else 1
        self.log_length = nn.Parameter(torch.zeros(lengths, dtype=self.dtype))
        self.log_noise = nn.Parameter(torch.zeros((), dtype=self.dtype))
        self._set_inducing(torch.empty(0, dtype=self.dtype))
        for name in ("signal", "factor", "information", "mean", "pattern", "other_noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        self._training: _Training | None = None

    @property
    def length(self) -> Float[Tensor, " feature"]:
        """Length scales l."""
        return self.log_length.exp()

    @property
    def noise(self) -> Float[Tensor, ""]:
        """Noise ratio σ_n²/σ_f²."""
        return self.config.noise_floor + self.log_noise.exp()

    @property
    def noise_std(self) -> Float[Tensor, " target"]:
        """σ_n of every target."""
        return (self.noise * self.signal).sqrt().detach()

    def condition(self, data: Sequences | Pairs) -> None:
        """Take in the training pairs, draw inducing inputs, compute their distances once."""
        data = pairs_of(data)
        known = data.mask.any(1).nonzero()[:, 0]
        order = torch.randperm(len(known), device=known.device)[: self.config.count(len(known))]
        self._set_inducing(data.inputs[known[order]].to(self.dtype))
        self._training = _Training(
            data.inputs,
            Collapsed(data.targets.to(self.dtype), patterns(data.mask), self.config.bound),
            *self._distances(data.inputs),
        )
        with torch.no_grad():
            self.log_length.fill_(median_distance(self._training.among).log())
            self.log_noise.fill_(self.config.noise - self.config.noise_floor).log_()
        if self.config.learn_inducing or self.config.ard:
            self._warm_start()

    def objective(self) -> Float[Tensor, ""]:
        """Minus the collapsed bound on the log evidence, summed over targets."""
        training = self._need_training()
        return training.bound(*self._geometry(training), self.noise)

    def settle(self) -> None:
        """Keep q(u) and σ_f² under the final hyperparameters; compare with the other bound."""
        training = self._need_training()
        self._keep_posterior(training)
        if self.config.bound == "fitc" and self.config.compare:
            self._compare()
        self._training = None

    @torch.no_grad()
    def regress(self, inputs: Float[Tensor, "item feature"], *, draws: int) -> Predictive:
        """Mean, latent and noise spread of every target; joint draws over not too many items."""
        k = self._kernel(self.inducing, inputs)
        v = torch.linalg.solve_triangular(self.factor, k, upper=False)
        mean = v.mT @ self.mean
        variance = torch.empty_like(mean)
        joint = draws > 0 and len(inputs) <= self.config.joint_items
        paths = mean.new_empty(draws, *mean.shape) if joint else None
        for i, information in enumerate(self.information):
            which, w = self.pattern == i, torch.linalg.solve_triangular(information, v, upper=False)
            left = (1 - v.square().sum(0) + w.square().sum(0)).clamp_min(0)
            variance[:, which] = left[:, None] * self.signal[which]
            if paths is not None:
                covariance = self._kernel(inputs, inputs) - v.mT @ v + w.mT @ w
                drawn = joint_draws(mean[:, which], covariance, self.signal[which], draws)
                paths[:, :, which] = drawn
        return Predictive(
            location=mean[None],
            noise=self.noise_std,
            epistemic=variance.sqrt()[None],
            draws=paths,
        )

    def forward(self, batch: Batch) -> None:
        """p(y | x) of a whole training set, u and f integrated out."""
        if batch.inputs is None or len(batch) != batch.total:
            raise ValueError(f"the evidence needs all {batch.total} items with inputs at once")
        y = batch.values.reshape(len(batch), -1)
        mask = torch.ones_like(y, dtype=torch.bool) if batch.mask is None else batch.mask
        factor = torch.linalg.cholesky(self._jittered(self._kernel(self.inducing, self.inducing)))
        k_uf = self._kernel(self.inducing, batch.inputs.reshape(len(batch), -1))
        v = torch.linalg.solve_triangular(factor, k_uf, upper=False)
        left = 1 - v.square().sum(0)
        fitc = self.config.bound == "fitc"
        for p in range(y.shape[1]):
            rows, signal = mask.reshape(y.shape)[:, p], self.signal[p]
            diagonal = left[rows] + self.noise if fitc else self.noise.expand(int(rows.sum()))
            loading = v.mT[rows] * signal.sqrt()
            law = LowRankMultivariateNormal(torch.zeros_like(diagonal), loading, signal * diagonal)
            pyro.sample(f"y_{p}", law, obs=y[rows, p])
            if not fitc:
                pyro.factor(f"trace_{p}", -left[rows].sum() / (2 * self.noise))

    def report(self) -> dict[str, Any]:
        """Hyperparameters in the model's scale, and the noise that the other bound found."""
        return {
            "bound": self.config.bound,
            "inducing": len(self.inducing),
            "jitter": self.config.jitter,
            "length_scale": self.length.tolist(),
            "signal_std": self.signal.sqrt().tolist(),
            "noise_std": self.noise_std.tolist(),
            "noise_std_vfe": self.other_noise.tolist(),
        }

    def _set_inducing(self, inputs: Tensor) -> None:
        if self.config.learn_inducing:
            self.inducing = nn.Parameter(inputs.clone())
        else:
            self.register_buffer("inducing", inputs)

    def _distances(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Squared distances among the inducing inputs and from them to all others."""
        inducing = self.inducing.detach()
        among = squared_distances(inducing, inducing)
        return among.fill_diagonal_(0), squared_distances(inputs, inducing)

    def _need_training(self) -> _Training:
        if self._training is None:
            raise RuntimeError("the evidence needs training data; call condition(data) first")
        return self._training

    def _geometry(self, training: _Training) -> tuple[Tensor, Tensor, Tensor]:
        """K_uu with its jitter, and the distances to all inputs with the length they are over."""
        if self.config.learn_inducing or self.config.ard:
            k_uu = self._kernel(self.inducing, self.inducing)
            inducing = self.inducing / self.length
            across = squared_distances(training.inputs / self.length, inducing)
            return self._jittered(k_uu), across, torch.zeros_like(self.noise)
        k_uu = squared_exponential(training.among, self.log_length[0])
        return self._jittered(k_uu), training.across, self.log_length[0]

    def _jittered(self, k_uu: Tensor) -> Tensor:
        return k_uu + torch.diag(k_uu.new_full((len(k_uu),), self.config.jitter))

    def _kernel(self, a: Tensor, b: Tensor) -> Tensor:
        distances = squared_distances(a / self.length, b / self.length)
        return squared_exponential(distances, distances.new_zeros(()))

    @torch.no_grad()
    def _keep_posterior(self, training: _Training) -> None:
        bound = training.bound
        k_uu, across, log_length = self._geometry(training)
        self.factor = torch.linalg.cholesky(k_uu)
        found = bound.posteriors(bound.project(self.factor, across, log_length), self.noise)
        count = bound.targets.shape[1]
        self.signal, self.pattern = k_uu.new_zeros(count), k_uu.new_zeros(count)
        self.mean = k_uu.new_zeros(len(k_uu), count)
        for i, (q, (observed, targets)) in enumerate(zip(found, bound.groups, strict=True)):
            which = list(targets)
            self.signal[which], self.mean[:, which] = q.quadratic / observed.sum(), q.mean
            self.pattern[which] = float(i)
        self.information = torch.stack([q.factor for q in found])

    def _fixed(self, bound: Literal["fitc", "vfe"], **changes: Any) -> SparseGaussianProcess:
        """The same data and inducing inputs, these held still, optimised from here."""
        training = self._need_training()
        config = replace(self.config, bound=bound, learn_inducing=False, compare=False, **changes)
        other = SparseGaussianProcess(self.layout, config)
        other._set_inducing(self.inducing.detach())
        among, across = training.among, training.across
        if self.config.learn_inducing:
            among, across = other._distances(training.inputs)
        targets, groups = training.bound.targets, training.bound.groups
        other._training = _Training(
            training.inputs, Collapsed(targets, groups, bound), among, across
        )
        with torch.no_grad():
            other.log_length.copy_(self.log_length[: len(other.log_length)])
            other.log_noise.copy_(self.log_noise)
        optimizer: Literal["l-bfgs", "newton"] = "l-bfgs" if config.ard else "newton"
        maximise(other, MarginalLikelihood(optimizer=optimizer), evaluator(other))
        return other

    def _warm_start(self) -> None:
        """Start from the best single length scale over inducing inputs that stay where they are.

        All at once from a poor start, the inputs settle in a far worse optimum.
        """
        other = self._fixed(self.config.bound, ard=False)
        with torch.no_grad():
            self.log_length.copy_(other.log_length.expand_as(self.log_length))
            self.log_noise.copy_(other.log_noise)

    def _compare(self) -> None:
        """Fit the variational bound from here and compare the noise."""
        other = self._fixed("vfe")
        other.settle()
        self.other_noise = other.noise_std
        ratio = torch.maximum(self.noise_std / self.other_noise, self.other_noise / self.noise_std)
        if bool((ratio > self.config.divergence).any()):
            worst = int(ratio.argmax())
            warnings.warn(
                f"{self.layout.channels[worst]}: FITC's noise is {self.noise_std[worst]:.3g}, "
                f"VFE's {self.other_noise[worst]:.3g} (scaled), a factor {ratio[worst]:.1f} apart; "
                "more inducing inputs bring them together",
                NoiseDivergenceWarning,
                stacklevel=2,
            )
