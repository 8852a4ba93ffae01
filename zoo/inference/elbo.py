"""The evidence lower bound of one pass through guide and model, with its terms kept apart."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyro
import torch
from pyro.distributions import Delta
from pyro.infer import Trace_ELBO
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor, nn

from zoo.types import Batch

__all__ = [
    "Bound",
    "Program",
    "Site",
    "Sites",
    "bound",
    "check",
    "divergences",
    "sites",
    "tight_bound",
]

Program = nn.Module | Callable[[Batch], Any]
Site = Any


@dataclass(frozen=True)
class Sites:
    """Sample sites of one pass: of the model given the guide's draws, and of the guide."""

    model: dict[str, Site]
    guide: dict[str, Site]

    @property
    def observed(self) -> list[str]:
        """Names of the model's observed sites."""
        return [name for name, site in self.model.items() if site["is_observed"]]

    @property
    def latent(self) -> list[str]:
        """Names of the model's latent sites."""
        return [name for name, site in self.model.items() if not site["is_observed"]]


@dataclass(frozen=True)
class Bound:
    r"""One draw of the bound on log p(x), summed over the whole training set.

    ``loss = −[c log p(x|z) − β (log q(z) − c log p(z))]`` is what training minimises, (87);
    ``reconstruction = Σ log p(x|z)`` and ``kl = Σ log q(z) − log p(z)`` are free of c and β.
    ``terms`` holds the parts by name of the site: ``p(name)``, ``q(name)`` and ``kl(name)``.
    """

    loss: Tensor
    reconstruction: Tensor
    kl: Tensor
    terms: dict[str, Tensor]

    @property
    def elbo(self) -> Tensor:
        """The plain bound, c = β = 1."""
        return self.reconstruction - self.kl

    def broken(self) -> list[str]:
        """Terms that are not finite, the model's first."""
        return [name for name, value in self.terms.items() if not math.isfinite(value.item())]


def bound(
    model: Program, guide: Program, batch: Batch, *, c: float = 1.0, beta: float = 1.0
) -> Bound:
    """One reparameterised draw of the bound, all its terms sampled; c tempers the model alone."""
    drawn = sites(model, guide, batch)
    p = {name: log_density(site) for name, site in drawn.model.items()}
    q = {name: log_density(site) for name, site in drawn.guide.items()}
    likelihood = _total([p[name] for name in drawn.observed])
    prior = _total([p[name] for name in drawn.latent])
    log_q = _total(list(q.values()))
    loss = beta * (log_q - c * prior) - c * likelihood
    terms = {f"p({n})": v for n, v in p.items()} | {f"q({n})": v for n, v in q.items()}
    return Bound(loss, likelihood.detach(), (log_q - prior).detach(), terms)


def tight_bound(
    model: Program, guide: Program, batch: Batch, *, c: float = 1.0, beta: float = 1.0
) -> Bound:
    """The same bound with KLs in closed form where they are known: fewer terms, less noise.

    A site whose KL is not known, or whose parents in the model may come later in the guide, keeps
    its sampled log q − log p. Where c < 1 a closed site costs c KL + (1 − c) log q.
    """
    drawn = sites(model, guide, batch)
    observed = {f"p({name})": log_density(drawn.model[name]) for name in drawn.observed}
    kls = {f"kl({name})": kl for name, kl in divergences(drawn).items()}
    likelihood, kl = _total(list(observed.values())), _total(list(kls.values()))
    cost = kl
    if c != 1.0:
        cost = c * kl + (1.0 - c) * _total([log_density(site) for site in drawn.guide.values()])
    loss = beta * cost - c * likelihood
    return Bound(loss, likelihood.detach(), kl.detach(), observed | kls)


def divergences(drawn: Sites) -> dict[str, Tensor]:
    """KL(q ‖ p) of every latent site, in closed form where that is known and right."""
    same_order = drawn.latent == [name for name in drawn.guide if name in drawn.model]
    shared = {
        name: _divergence(drawn.guide[name], drawn.model[name], closed=same_order)
        for name in drawn.latent
    }
    return shared | {n: log_density(s) for n, s in drawn.guide.items() if n not in drawn.model}


def sites(model: Program, guide: Program, batch: Batch) -> Sites:
    """Run the guide, then the model on the guide's draws."""
    with _Record() as posterior:
        guide(batch)
    with _Record(given=posterior.seen) as joint:
        model(batch)
    return Sites(joint.real, posterior.real)


def check(model: Program, guide: Program, batch: Batch) -> None:
    """One pass with every check of Pyro, and the checks of this estimator, by name of the site."""
    with torch.no_grad(), pyro.validation_enabled(True):
        drawn = sites(model, guide, batch)
        _check_match(drawn)
        Trace_ELBO().loss(model, guide, batch)


def log_density(site: Site) -> Tensor:
    """Log density of a site with its mask and its scale, summed."""
    return _weighted(site["fn"].log_prob(site["value"], *site["args"], **site["kwargs"]), site)


class _Record(Messenger):
    """Keep every sample site; take the values of those that are ``given``."""

    def __init__(self, given: dict[str, Site] | None = None) -> None:
        super().__init__()
        self.given = {} if given is None else given
        self.seen: dict[str, Site] = {}

    @property
    def real(self) -> dict[str, Site]:
        """The sites without the subsamples of plates."""
        return {n: s for n, s in self.seen.items() if not site_is_subsample(s)}

    def _pyro_sample(self, message: Site) -> None:
        if message["name"] in self.given and not message["is_observed"]:
            message["value"], message["done"] = self.given[message["name"]]["value"], True

    def _pyro_post_sample(self, message: Site) -> None:
        self.seen[message["name"]] = message


def _divergence(q: Site, p: Site, *, closed: bool) -> Tensor:
    if closed and not _is_point(q["fn"]):
        try:
            kl = torch.distributions.kl_divergence(q["fn"], p["fn"])
        except NotImplementedError:
            pass
        else:
            return _weighted(kl.expand(q["fn"].batch_shape), q)
    return log_density(q) - log_density(p)


def _is_point(fn: Any) -> bool:
    """Whether draws are a point, whose log density Pyro's own KL leaves out."""
    while hasattr(fn, "base_dist"):
        fn = fn.base_dist
    return isinstance(fn, Delta)


def _weighted(each: Tensor, site: Site) -> Tensor:
    """Terms of a site, summed where its mask is True, times its scale."""
    scale, mask = site["scale"], site["mask"]
    if isinstance(mask, Tensor):
        each = torch.where(mask, each, 0.0)
    elif mask is False:
        return each.new_zeros(())
    if isinstance(scale, Tensor) and scale.ndim:
        return (scale * each).sum()
    total = each.sum()
    return total if scale == 1.0 else total * scale


def _check_match(drawn: Sites) -> None:
    latent = set(drawn.latent)
    if missing := sorted(latent - set(drawn.guide)):
        raise ValueError(f"the guide has no site for {', '.join(missing)} of the model")
    drawn_only = {n for n, s in drawn.guide.items() if not s["infer"].get("is_auxiliary")}
    if extra := sorted(drawn_only - latent):
        raise ValueError(f"the model has no latent site for {', '.join(extra)} of the guide")
    for name, site in drawn.guide.items():
        if not site["fn"].has_rsample:
            raise ValueError(
                f"site {name!r} of the guide is {type(site['fn']).__name__}, which has no "
                "reparameterised draws; this bound needs them at every latent site"
            )


def _total(terms: list[Tensor]) -> Tensor:
    return sum(terms[1:], terms[0]) if terms else torch.zeros(())
