"""What a model and a guide must have, and what the inference strategies and the harness call.

An entry is a generative model, a guide and a strategy. Both parts are ``nn.Module``; every tensor
that prediction needs is a parameter or a buffer, so that it is saved. ``docs/skeleton`` has an
entry for each strategy; the tasks that a model answers are in :mod:`zoo.contract.capabilities`.

==========================  ====================================================================
``Exact()``                 calls ``condition`` (:class:`Conditions`)
``MarginalLikelihood(…)``   ``condition``, ``objective``, ``settle`` (:class:`MaximisesEvidence`)
``Svi(…)``                  the Pyro programs of model and guide, on minibatches
==========================  ====================================================================

Data reach both parts scaled, in ``dtype``; missing entries are 0 and False in the mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.types import Batch, Posterior, Sites

__all__ = [
    "Adopts",
    "Builds",
    "Conditions",
    "GenerativeModel",
    "Guide",
    "KnowsPosterior",
    "LearnsNoise",
    "LearnsPrior",
    "MaximisesEvidence",
    "Prepares",
]


class GenerativeModel(Protocol):
    """Every model: ``__init__(layout, config)`` with a :class:`~zoo.types.Layout` and its Config.

    It is built under the seed of the assembly, before it sees data. Buffers whose size the data
    decide start empty, ``torch.empty(0, dtype=…)``, and are replaced by ``condition``.
    """

    config_class: ClassVar[type]
    """Made by :func:`zoo.contract.settings.settings`: every field is a setting of
    ``zoo.create`` with a default, its docstring is a part of the card."""

    dtype: ClassVar[torch.dtype]
    """Number type that model, guide and data get: ``torch.float64`` where matrices are factorised,
    ``torch.float32`` for networks."""

    def forward(self, batch: Batch) -> Any:
        """The Pyro program p(x, z).

        Plates have the size ``batch.total`` (windows or items) or ``batch.total_sequences``, with
        ``subsample=torch.arange(…)`` of what the batch holds, so that a minibatch stands for all;
        data are observed by ``obs=batch.given(batch.values)`` at a site ``x`` (``y`` for pairs),
        masked by ``batch.mask``.
        """
        ...


class Guide(Protocol):
    """Every guide: ``__init__(layout, model, config)``; it may read what the model offers.

    ``zoo.guides.exact:ExactPosterior`` is ready-made for a :class:`KnowsPosterior`. A method
    ``encode(values, mask)`` makes :meth:`zoo.types.Posterior.encode` work.
    """

    config_class: ClassVar[type]
    """Settings, as those of the model; a setting that both have goes to both."""

    def forward(self, batch: Batch) -> Any:
        """The Pyro program q(z | x), with the latent sites of the model in the same plates."""
        ...


@runtime_checkable
class Conditions(Protocol):
    """Exact inference: the statistics of the training data are all there is to learn."""

    def condition(self, data: Any) -> None:
        """Take in all training data, ``zoo.Sequences`` or ``zoo.Pairs``.

        ``data.values`` is (sequence, frame, channel) with ``data.mask``, False where an entry is
        missing or a shorter movement has ended; pairs have ``inputs``, ``targets`` and ``mask``.
        Learned numbers go into buffers, starting values of parameters are set in place under
        ``torch.no_grad()``. It may be called again, with other data.
        """
        ...


@runtime_checkable
class MaximisesEvidence(Conditions, Protocol):
    """Type-II maximum likelihood: all parameters with ``requires_grad`` are optimised."""

    def objective(self) -> Float[Tensor, ""]:
        """Minus the log evidence of the data last given to ``condition``, differentiable.

        A covariance that cannot be factorised may raise ``torch.linalg.LinAlgError``: the
        optimiser steps back.
        """
        ...

    def settle(self) -> None:
        """Called once, after the best parameters are set.

        Store in buffers what prediction needs of the data under them, and let go of what only
        training needed (training data that are no buffer, matrices): nothing else is saved.
        """
        ...


class KnowsPosterior(Protocol):
    """A model with closed-form inference: what ``zoo.guides.exact:ExactPosterior`` asks for."""

    def posterior_sites(self, batch: Batch) -> Sites:
        """p(latent sites | data): one distribution after the other, and their plate."""
        ...


@runtime_checkable
class Prepares(Protocol):
    """A model or guide with constants that are read off the training data before all else."""

    def prepare(self, data: Any) -> None:
        """Fill buffers, such as a period; the model comes before its guide."""
        ...


@runtime_checkable
class Builds(Protocol):
    """A guide that is made from its model, once that has its constants."""

    def build(self) -> None:
        """Make the parameters."""
        ...

    def moments(self) -> Mapping[str, tuple[Tensor, Tensor]]:
        """Mean of each latent site, and a root of its covariance."""
        ...


@runtime_checkable
class Adopts(Protocol):
    """A model that predicts from a Gaussian of its latent sites, however that was found."""

    def adopt(self, found: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Keep mean and root of the covariance of each site."""
        ...


@runtime_checkable
class LearnsPrior(Protocol):
    """A prior over whole movements, estimated from the trained guide (empirical Bayes)."""

    def learn_prior(self, batch: Batch, posterior: Posterior) -> None:
        """Store the aggregate of the training movements' latents in buffers."""
        ...


@runtime_checkable
class LearnsNoise(Protocol):
    """Noise that is estimated again on movements that no network was trained on."""

    def learn_noise(self, batch: Batch, posterior: Posterior) -> None:
        """Set the standard deviations of the observations."""
        ...
