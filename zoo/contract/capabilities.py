"""What a model can do: protocols that ``can=`` and the evaluation derive their answers from.

A capability is a method of that name in the model's class: :class:`~zoo.contract.registry.Entry`
finds it, and nothing else is declared. What every model has besides is in
:mod:`zoo.contract.parts`.

All tensors are in the model's own scale and dtype; the run scales on the way in and out.
``posterior`` is the guide behind the :class:`~zoo.types.Posterior` protocol, or None for
baselines, which have no guide. A batch given for prediction holds whole movements of one length,
starting at frame 0 (``batch.start == 0``); what a forecast observes is exactly ``batch.values``.
``draws`` is how many joint draws to make; 0 asks for the moments alone.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Posterior, Wishes

__all__ = [
    "Decodes",
    "Encodes",
    "FollowsPhase",
    "Forecasts",
    "Generates",
    "Imputes",
    "Reaches",
    "Reconstructs",
    "Regresses",
    "Reports",
    "Represents",
]


@runtime_checkable
class Regresses(Protocol):
    """Targets of new inputs."""

    def regress(self, inputs: Float[Tensor, "item feature"], *, draws: int) -> Predictive:
        """p(y | x, training data), shape (item, target)."""
        ...


@runtime_checkable
class Represents(Protocol):
    """Latent trajectories of observed movements."""

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(z_t | x), shape (sequence, time, latent)."""
        ...


@runtime_checkable
class Encodes(Protocol):
    """Latent coordinates of frames, of a model whose ``represent`` says more than they do."""

    def encode(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(z_t | x_t), shape (sequence, time, latent)."""
        ...


@runtime_checkable
class Decodes(Protocol):
    """Frames of latent coordinates, such as :meth:`Represents.represent` gives them."""

    latent_dim: int

    def decode(self, z: Float[Tensor, "sample sequence time latent"], /) -> Predictive:
        """p(x_t | z_t), shape (sequence, time, channel)."""
        ...


@runtime_checkable
class Reconstructs(Protocol):
    """Observed movements through the model."""

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x̂ | x), shape (sequence, time, channel)."""
        ...


@runtime_checkable
class Forecasts(Protocol):
    """The frames after those observed."""

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """p(x_{k+1:k+horizon} | x_{1:k}), shape (sequence, horizon, channel)."""
        ...


@runtime_checkable
class Imputes(Protocol):
    """Missing joints, frames or sections: entries that are False in ``batch.mask``."""

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """p(x_missing | x_seen), shape (sequence, time, channel), all entries."""
        ...


@runtime_checkable
class Generates(Protocol):
    """New movements from a demonstration: other goal, other duration, switching."""

    def generate(
        self,
        batch: Batch,
        posterior: Posterior | None,
        *,
        wishes: Wishes,
        draws: int,
    ) -> Predictive:
        """Movements like ``batch``: ended at another goal, longer, or switched, as ``wishes``."""
        ...


@runtime_checkable
class Reaches(Protocol):
    """How far training movements reached, so that a goal far beyond is told of."""

    reached: Float[Tensor, "2 channel"]


@runtime_checkable
class Reports(Protocol):
    """What was learned, in words and numbers."""

    def report(self) -> dict[str, Any]:
        """Plain values by name, in the model's scale.

        Those with ``_std`` in their name hold a standard deviation for each target or channel; the
        run brings them to the data's units.
        """
        ...


@runtime_checkable
class FollowsPhase(Protocol):
    """A model of movements that begin at their first frame and end at their last, if ``phased``."""

    @property
    def phased(self) -> bool:
        """Whether where a movement begins matters."""
        ...
