"""Guides that Pyro makes from a model: one distribution of all latent sites, whatever the data."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import pyro
import torch
from pyro.infer.autoguide import (
    AutoDelta,
    AutoGuide,
    AutoMultivariateNormal,
    AutoNormal,
    init_to_mean,
)
from torch import Tensor, nn

from zoo.contract.settings import Positive, settings
from zoo.errors import NotCapableError
from zoo.types import Batch, Layout

__all__ = ["Automatic", "Config", "Delta", "MultivariateNormal", "Normal"]

Moments = dict[str, tuple[Tensor, Tensor]]


@settings
class Config:
    """``init_scale``: standard deviation from which the training starts, in unconstrained units."""

    init_scale: Positive = 0.1


class Automatic(nn.Module):
    """A guide of :mod:`pyro.infer.autoguide`, built once the model has its constants.

    It holds for models that name in ``global_sites`` their latent sites, all of a fixed size; with
    latent sites of single windows, movements or items it would have to know which of them a batch
    holds, and would know nothing of new ones. Parameters stay in the module: nothing enters Pyro's
    global store.
    """

    config_class: ClassVar[type] = Config

    def __init__(self, layout: Layout, model: nn.Module, config: Config) -> None:
        """Refuse models without global latent sites."""
        super().__init__()
        if not getattr(model, "global_sites", ()):
            raise NotCapableError(
                f"{type(model).__name__} allows no automatic guide: that has one distribution for "
                "every latent site, while the sites of this model belong to single windows, "
                "movements or items, or there are none; take its own guide"
            )
        self.layout, self.config = layout, config
        self._model = (model,)
        self.sites: AutoGuide | None = None

    def build(self) -> None:
        """Make the parameters from a batch without data; the model must have its constants."""
        model: Any = self._model[0]
        with torch.no_grad(), pyro.settings.context(module_local_params=True):
            made = self.made(model)
            made(Batch.blank(self.layout, model.dtype))
        self.sites = made.train(self.training)

    @abstractmethod
    def made(self, model: Any) -> AutoGuide:
        """The guide of Pyro for ``model``, without parameters yet."""
        ...

    @abstractmethod
    def gaussians(self, guide: Any) -> Moments:
        """Mean of each site, and a root of its covariance: one row for each entry."""
        ...

    @torch.no_grad()
    def moments(self) -> Moments:
        """Mean and root of the covariance of every site, by name."""
        with pyro.settings.context(module_local_params=True):
            return self.gaussians(self.built)

    @property
    def built(self) -> Any:
        """The guide of Pyro, built where it has not been."""
        if self.sites is None:
            self.build()
        return self.sites

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Draw every latent site."""
        with pyro.settings.context(module_local_params=True):
            drawn: dict[str, Tensor] = self.built(batch)
        return drawn


def _begin(site: Any) -> Tensor:
    """The prior mean, in memory of its own: an optimiser writes into it."""
    mean: Tensor = init_to_mean(site).contiguous()
    return mean


class Delta(Automatic):
    """A point for each site: maximum a posteriori."""

    def made(self, model: Any) -> AutoGuide:
        """Pyro's AutoDelta."""
        return AutoDelta(model, init_loc_fn=_begin)

    def gaussians(self, guide: Any) -> Moments:
        """The points, without any deviation."""
        points = guide.median()
        return {name: (v, v.new_zeros(*v.shape, 1)) for name, v in points.items()}


class Normal(Automatic):
    """Independent Gaussians in the unconstrained space of each site."""

    def made(self, model: Any) -> AutoGuide:
        """Pyro's AutoNormal."""
        scale = self.config.init_scale
        return AutoNormal(model, init_loc_fn=_begin, init_scale=scale)

    def gaussians(self, guide: Any) -> Moments:
        """Means and standard deviations of sites without a constraint."""
        quantiles = guide.quantiles([0.5, 0.8413447460685429])
        return {name: (q[0], torch.diag_embed(q[1] - q[0])) for name, q in quantiles.items()}


class MultivariateNormal(Automatic):
    """One Gaussian with a full covariance over all sites, in their unconstrained space."""

    def made(self, model: Any) -> AutoGuide:
        """Pyro's AutoMultivariateNormal."""
        scale = self.config.init_scale
        return AutoMultivariateNormal(model, init_loc_fn=_begin, init_scale=scale)

    def gaussians(self, guide: Any) -> Moments:
        """Means, and the rows of the root of the joint covariance that are a site's."""
        root, means, first, found = guide.get_posterior().scale_tril, guide.median(), 0, {}
        for name, mean in means.items():
            rows = root[first : first + mean.numel()]
            found[name] = (mean, rows.reshape(*mean.shape, -1))
            first += mean.numel()
        return found
