"""Skeleton of a model for ``zoo.MarginalLikelihood``: condition, objective, settle."""

from __future__ import annotations

import math
from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

import zoo
from zoo.contract.settings import Positive, settings

__all__ = ["Config", "Linear"]


@settings
class Config:
    """Settings of the model: ``noise`` is the starting value of σ, in scaled units."""

    noise: Positive = 0.5


class Linear(nn.Module):
    """Targets that are linear in the inputs.

        w_p ~ N(0, a² I),  y_p ~ N(w_pᵀ φ(x), σ_p²),  φ(x) = (1, x)

    Bishop, *Pattern recognition and machine learning*, 3.5 (2006). The posterior of the weights is
    exact given a and σ, which maximise the evidence: their uncertainty is not in the bands.
    """

    config_class: ClassVar[type] = Config
    dtype: ClassVar[torch.dtype] = torch.float64

    mean: Tensor
    root: Tensor

    def __init__(self, layout: zoo.Layout, config: Config) -> None:
        """Parameters are what ``objective`` is minimised over; buffers are what is kept."""
        super().__init__()
        self.layout, self.config = layout, config
        self.log_prior = nn.Parameter(torch.zeros((), dtype=self.dtype))
        self.log_noise = nn.Parameter(torch.zeros(len(layout.channels), dtype=self.dtype))
        for name in ("mean", "root"):
            self.register_buffer(name, torch.empty(0, dtype=self.dtype))
        self._training: tuple[Tensor, Tensor, Tensor] | None = None

    def condition(self, data: zoo.Pairs) -> None:
        """Take the training pairs in; set the parameters to their starting values."""
        self._training = _features(data.inputs), data.targets, data.mask
        with torch.no_grad():
            self.log_prior.zero_()
            self.log_noise.fill_(math.log(self.config.noise))

    def objective(self) -> Tensor:
        """Minus the log evidence of the training targets, summed over targets."""
        features, targets, mask = self._known()
        mean, factor = self._posterior(features, targets, mask)
        left = (targets - features @ mean.mT) * (-self.log_noise).exp()
        prior = (mean * (-self.log_prior).exp()).square().sum()
        determinant = 2 * (factor.diagonal(dim1=1, dim2=2).log() + self.log_prior).sum()
        constant = (mask * (math.log(2 * math.pi) + 2 * self.log_noise)).sum()
        return 0.5 * (constant + determinant + (mask * left.square()).sum() + prior)

    @torch.no_grad()
    def settle(self) -> None:
        """Keep the posterior under the final parameters, let go of the training pairs."""
        mean, factor = self._posterior(*self._known())
        self.mean, self.root = mean, torch.linalg.inv(factor).mT.contiguous()
        self._training = None

    def forward(self, batch: zoo.Batch) -> Tensor:
        """p(y, w): weights of every target, then the items; a minibatch stands for all."""
        features, targets, mask = self._seen(batch)
        prior = dist.Normal(self.log_noise.new_zeros(len(targets.mT), features.shape[1]), 1.0)
        with pyro.plate("targets", targets.shape[1]):
            w = pyro.sample("w", dist.Normal(prior.mean, self.log_prior.exp()).to_event(1))
            law = dist.Normal(w @ features.mT, self.log_noise.exp()[:, None])
            with pyro.poutine.scale(scale=batch.total / len(batch)):
                site = law.mask(mask.mT).to_event(1)
                y: Tensor = pyro.sample("y", site, obs=batch.given(targets.mT))
        return y

    def posterior_sites(self, batch: zoo.Batch) -> zoo.Sites:
        """What the exact guide draws from: p(w | y) of all items."""
        mean, factor = self._posterior(*self._seen(batch))
        w = dist.MultivariateNormal(mean, precision_matrix=factor @ factor.mT)
        return zoo.Sites(plate="targets", size=len(mean), rows=len(mean), of={"w": lambda _: w})

    @torch.no_grad()
    def regress(self, inputs: Tensor, *, draws: int) -> zoo.Predictive:
        """p(y | x, training pairs)."""
        features = _features(inputs)
        std = torch.einsum("pfg,nf->npg", self.root, features).square().sum(-1).sqrt()
        noise = torch.randn(draws, *self.mean.shape, 1, dtype=self.dtype)
        w = self.mean + (self.root @ noise)[..., 0]
        return zoo.Predictive(
            location=(features @ self.mean.mT)[None],
            noise=self.log_noise.exp(),
            epistemic=std[None],
            draws=features @ w.mT,
        )

    def _known(self) -> tuple[Tensor, Tensor, Tensor]:
        if self._training is None:
            raise RuntimeError("the evidence needs training pairs; call condition(data) first")
        return self._training

    def _seen(self, batch: zoo.Batch) -> tuple[Tensor, Tensor, Tensor]:
        if batch.inputs is None:
            raise ValueError("linear needs items with inputs; got none")
        mask = torch.ones_like(batch.values).bool() if batch.mask is None else batch.mask
        return _features(batch.inputs), batch.values, mask

    def _posterior(self, features: Tensor, targets: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the weights of every target, and the lower root of their precision."""
        weight = mask * (-2 * self.log_noise).exp()
        precision = torch.einsum("np,nf,ng->pfg", weight, features, features)
        eye = torch.eye(features.shape[1], dtype=self.dtype)
        factor = torch.linalg.cholesky(precision + (-2 * self.log_prior).exp() * eye)
        pulled = (weight * targets).mT @ features
        return torch.cholesky_solve(pulled[..., None], factor)[..., 0], factor


def _features(inputs: Tensor) -> Tensor:
    return torch.cat([torch.ones_like(inputs[:, :1]), inputs], 1)
