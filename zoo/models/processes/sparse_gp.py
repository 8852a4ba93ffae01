"""Sparse Gaussian processes with inducing inputs: FITC and the variational bound of Titsias."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor

from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NotFittedError
from zoo.inference.marginal import evaluator, maximise
from zoo.models.processes.collapsed import Collapsed
from zoo.models.processes.evidence import patterns
from zoo.models.processes.gaussian import joint_draws, white_posterior
from zoo.models.processes.hyperparameters import InducingInputs
from zoo.models.processes.inducing import Config, ProjectedItems, Training, warn_of_divergence
from zoo.models.processes.kernels import squared_distances, squared_exponential
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Sites

__all__ = ["Config", "SparseGaussianProcess"]


class SparseGaussianProcess(InducingInputs):
    """A Gaussian process for each target, seen through u = f(x̄) at m inducing inputs x̄.

    ``u ~ N(0, K_uu)``, ``f_p | u`` as the Gaussian process has it, and
    ``y_p ~ N(K_fu K_uu⁻¹ u, diag[K_ff − Q_ff] + σ_n² I)`` with ``Q_ff = K_fu K_uu⁻¹ K_uf`` — what
    (43) means (FITC, Snelson & Ghahramani 2006); ``bound="vfe"`` drops the diagonal K − Q from the
    likelihood and pays tr(K − Q)/2σ_n² instead (Titsias 2009). Both have q(u) in closed form and
    u integrated out. Inducing inputs are drawn from the data (thesis §2.1.6, 17 % in §3.3.4) and
    fixed unless ``learn_inducing``; targets share length scale and noise ratio σ_n²/σ_f², hence
    both Cholesky factors, and each has its own σ_f², profiled out. q(u) is exact given these, which
    are point estimates: their uncertainty is not in the bands. ``kernel`` takes a Matérn kernel or
    the rational quadratic of gpytorch for the squared exponential.

    The Pyro program draws v ~ N(0, I), u = σ_f L v with K_uu = L Lᵀ, then y. Items are independent
    given u, so that an automatic guide learns q(v) and the hyperparameters from minibatches
    (``guide="auto-normal"``; Hensman et al. 2013 for VFE).

    FITC tends to take the noise too small and VFE too large (Bauer et al. 2016): a fit of
    ``fitc`` fits ``vfe`` beside it and warns where they part. Cost grows with items · m²; it gives
    no joint distribution over targets.
    """

    global_sites: ClassVar[tuple[str, ...]] = ("v",)

    factor: Tensor
    root: Tensor
    mean: Tensor
    pattern: Tensor
    other_noise: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """Hyperparameters for the layout's features; data come by ``condition``."""
        super().__init__(layout, config)
        for name in ("factor", "root", "mean", "pattern", "other_noise"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        self._training: Training | None = None

    def condition(self, data: Sequences | Pairs) -> None:
        """Take in the training pairs, draw inducing inputs, compute their distances once."""
        data = self._begin(data)
        targets = data.targets.to(self.dtype)
        bound = Collapsed(targets, patterns(data.mask), self.config.bound)
        self._training = Training.of(data.inputs, bound, self.inducing.detach())
        if self.config.learn_inducing or self.config.ard:
            self._warm_start()

    def prepare(self, data: Sequences | Pairs) -> None:
        """Inducing inputs and starting values for steps of the bound, which learn σ_f² as well."""
        data = self._begin(data)
        square = (data.targets.square() * data.mask).sum(0) / data.mask.sum(0)
        with torch.no_grad():
            self.log_signal.copy_(square.log())
        self.log_signal.requires_grad_(True)

    @torch.no_grad()
    def adopt(self, found: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Predict from a Gaussian q(v): its mean and a root of its covariance, for every target."""
        mean, self.root = found["v"]
        self.mean = (self.signal.sqrt()[:, None] * mean).mT
        self.pattern = torch.arange(len(mean)).to(mean)
        k_uu = self._kernel(self.inducing, self.inducing)
        self.factor = torch.linalg.cholesky(self._jittered(k_uu))

    def objective(self) -> Float[Tensor, ""]:
        """Minus the collapsed bound on the log evidence, summed over targets."""
        training = self._need_training()
        if self.config.kernel == "squared-exponential":
            return training.bound(*self._geometry(training), self.noise)
        return training.bound.of(*self._covariances(training), self.noise)

    def settle(self) -> None:
        """Keep q(u) and σ_f² under the final hyperparameters; compare with the other bound."""
        training = self._need_training()
        self._keep_posterior(training)
        if self.config.bound == "fitc" and self.config.compare:
            self._compare()
        self._training = None

    @torch.no_grad()
    def regress(self, inputs: Float[Tensor, "item feature"], *, draws: int) -> Predictive:
        """Mean and standard deviations of every target; joint draws over not too many items."""
        k = self._kernel(self.inducing, inputs)
        v = torch.linalg.solve_triangular(self.factor, k, upper=False)
        mean = v.mT @ self.mean
        variance = torch.empty_like(mean)
        joint = draws > 0 and len(inputs) <= self.config.joint_items
        paths = mean.new_empty(draws, *mean.shape) if joint else None
        for i, root in enumerate(self.root):
            which, w = self.pattern == i, root.mT @ v
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

    def forward(self, batch: Batch) -> Tensor:
        """The generative program: u = σ_f L v of every target, then y; a minibatch stands for all.

        With ``bound="vfe"`` the factor −tr(K − Q)/2σ_n² belongs to it.
        """
        items, scale = self._items(batch), self.signal.sqrt()[:, None]
        unit = dist.Normal(torch.zeros_like(scale), 1.0)
        with pyro.plate("targets", len(scale)):
            v = pyro.sample("v", unit.expand([len(scale), len(items.factor)]).to_event(1))
            pyro.deterministic("u", scale * (v @ items.factor.mT), event_dim=1)
            law = dist.Normal(scale * (v @ items.projection), scale * items.diagonal.sqrt())
            with pyro.poutine.scale(scale=batch.total / len(batch)):
                site = law.mask(items.mask).to_event(1)
                y: Tensor = pyro.sample("y", site, obs=batch.given(items.y))
                if self.config.bound == "vfe":
                    trace = (items.left * items.mask).sum(-1) / (2 * self.noise)
                    pyro.factor("trace", -trace)
        return y

    def posterior_sites(self, batch: Batch) -> Sites:
        """The best q(v) of all items: p(v | y) of FITC, the optimum of VFE's bound."""
        if len(batch) != batch.total:
            raise ValueError(f"q(u) needs all {batch.total} items at once; got {len(batch)}")
        items = self._items(batch)
        y = items.y / self.signal.sqrt()[:, None]
        mean, root = white_posterior(items.projection, items.mask / items.diagonal, y)
        v = dist.MultivariateNormal(mean, scale_tril=root)
        return Sites(plate="targets", size=len(y), rows=len(y), of={"v": lambda _: v})

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

    def _items(self, batch: Batch) -> ProjectedItems:
        if self.inducing.numel() == 0:
            raise NotFittedError("there are no inducing inputs yet; call zoo.fit first")
        if batch.inputs is None:
            raise ValueError("a Gaussian process needs items with inputs; got none")
        k_uu = self._jittered(self._kernel(self.inducing, self.inducing))
        k_uf = self._kernel(self.inducing, batch.inputs.flatten(1))
        return ProjectedItems.of(batch, k_uu, k_uf, self.noise, self.config.bound)

    def _need_training(self) -> Training:
        if self._training is None:
            raise RuntimeError("the evidence needs training data; call condition(data) first")
        return self._training

    def _geometry(self, training: Training) -> tuple[Tensor, Tensor, Tensor]:
        """K_uu with its jitter, and the distances to all inputs with the length they are over."""
        if self.config.learn_inducing or self.config.ard:
            k_uu = self._kernel(self.inducing, self.inducing)
            inducing = self.inducing / self.length
            across = squared_distances(training.inputs / self.length, inducing)
            return self._jittered(k_uu), across, torch.zeros_like(self.noise)
        k_uu = squared_exponential(training.among, self.log_length[0])
        return self._jittered(k_uu), training.across, self.log_length[0]

    def _covariances(self, training: Training) -> tuple[Tensor, Tensor]:
        """K_uu with its jitter, and K_fu."""
        k_uu = self._kernel(self.inducing, self.inducing)
        return self._jittered(k_uu), self._kernel(training.inputs, self.inducing)

    def _projected(self, training: Training) -> tuple[Tensor, Tensor]:
        """L of K_uu = L Lᵀ, and Vᵀ = K_fu L⁻ᵀ."""
        if self.config.kernel == "squared-exponential":
            k_uu, *across = self._geometry(training)
            factor = torch.linalg.cholesky(k_uu)
            return factor, training.bound.project(factor, *across)
        k_uu, k_fu = self._covariances(training)
        factor = torch.linalg.cholesky(k_uu)
        return factor, torch.linalg.solve_triangular(factor, k_fu.mT, upper=False).mT

    @torch.no_grad()
    def _keep_posterior(self, training: Training) -> None:
        bound = training.bound
        self.factor, projection = self._projected(training)
        found = bound.posteriors(projection, self.noise)
        count = bound.targets.shape[1]
        self.pattern = self.factor.new_zeros(count)
        self.mean = self.factor.new_zeros(len(self.factor), count)
        for i, (q, (observed, targets)) in enumerate(zip(found, bound.groups, strict=True)):
            which = list(targets)
            self.log_signal[which] = (q.quadratic / observed.sum()).log()
            self.mean[:, which], self.pattern[which] = q.mean, float(i)
        self.root = torch.stack([q.factor.inverse().mT for q in found])

    def _fixed(self, bound: Literal["fitc", "vfe"], **changes: Any) -> SparseGaussianProcess:
        """The same data and inducing inputs, these held still, optimised from here."""
        training = self._need_training()
        config = replace(self.config, bound=bound, learn_inducing=False, compare=False, **changes)
        other = SparseGaussianProcess(self.layout, config)
        other._set_inducing(self.inducing.detach())
        again = Collapsed(training.bound.targets, training.bound.groups, bound)
        moved = Training.of(training.inputs, again, other.inducing)
        other._training = moved if self.config.learn_inducing else training._replace(bound=again)
        other._start_at(self)
        optimizer: Literal["l-bfgs", "newton"] = "l-bfgs" if config.ard else "newton"
        maximise(other, MarginalLikelihood(optimizer=optimizer), evaluator(other))
        return other

    def _warm_start(self) -> None:
        """Start from the best single length scale over inducing inputs that stay where they are.

        All at once from a poor start, the inputs settle in a far worse optimum.
        """
        self._start_at(self._fixed(self.config.bound, ard=False))

    def _compare(self) -> None:
        """Fit the variational bound from here and compare the noise."""
        other = self._fixed("vfe")
        other.settle()
        self.other_noise = other.noise_std
        warn_of_divergence(self.layout, self.noise_std, self.other_noise, self.config.divergence)
