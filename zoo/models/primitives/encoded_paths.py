"""The encoded paths of AE-DMP's training movements: what forecasts and filled gaps come from."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from zoo.contract.readiness import need
from zoo.errors import NotFittedError
from zoo.models.primitives.imitator import Imitator
from zoo.movement.demonstrations import extremes
from zoo.movement.durations import lengths_of, pace, stretched, windows_of
from zoo.movement.lengths import check_end, check_whole, checked_span
from zoo.movement.paces import Paces, completed, lengthened, paced
from zoo.movement.paths import PathPrior, Readout
from zoo.nn.metric import jacobians
from zoo.types import Batch, Layout, Posterior

__all__ = ["EncodedPaths"]

SEEN = 1 - 1e-6


class EncodedPaths(nn.Module):
    """A decoder, the primitive of every length, and the latent path prior of ``AeDmp``.

    θ of the training movements and what their roll-outs leave of the encoded frames are kept;
    :class:`~zoo.movement.paths.PathPrior` is a mixture around them, of every duration that a new
    movement may have (:class:`~zoo.movement.paces.Paces`).
    """

    label: ClassVar[str]
    decoder: nn.Module
    root: nn.Parameter
    chain: int
    noise_floor: float

    prior_movements: Tensor
    prior_residuals: Tensor
    prior_shape: Tensor
    prior_lengths: Tensor
    reached: Tensor

    def __init__(self, layout: Layout, kernels: int, alpha: float | None) -> None:
        """Primitives of the movements of ``layout``, the longest as the unit of time."""
        super().__init__()
        shortest, self.frames = checked_span(self.label, layout)
        self.is_ragged = shortest < self.frames
        least = Imitator(shortest, kernels, alpha)
        self.imitator = least if not self.is_ragged else least.lasting(self.frames)
        for name in ("prior_movements", "prior_residuals", "prior_shape", "reached"):
            self.register_buffer(name, torch.empty(0))
        if self.is_ragged:
            self.register_buffer("prior_lengths", torch.empty(0, dtype=torch.long))

    @property
    @abstractmethod
    def σ(self) -> Float[Tensor, "*channel"]:
        """Standard deviation of the channels."""
        ...

    def learn_prior(self, batch: Batch, posterior: Posterior) -> None:
        """Keep the θ of the training movements and what their roll-outs leave of the paths."""
        mask = torch.ones_like(batch.values) > 0 if batch.mask is None else batch.mask
        self.reached = extremes(batch.values, mask)
        y, seen = self._encoded(batch, posterior)
        lengths = self._lengths(batch)
        if self.is_ragged:
            self.prior_lengths = batch.frames
        self.prior_movements = self._imitated(batch, posterior)
        y = stretched(y, lengths, self.frames)
        known = stretched(seen[..., None].to(y), lengths, self.frames) > SEEN
        self.prior_residuals = (y - self.imitator.roll_out(self.prior_movements)) * known
        self.prior_shape = y.new_empty(0)
        prior, window = self._prior(self.frames), (self.frames // 7, self.frames // 2)
        tuned = prior.tuned(window, self._readout(y), self.prior_without)
        self.prior_shape = y.new_tensor(tuned.shape)

    def learn_noise(self, batch: Batch, posterior: Posterior) -> None:
        """σ of movements that no network was trained on, never below what training found."""
        y, _ = self._encoded(batch, posterior)
        error = (self.decoder(y) - batch.values).square()
        mean = error.mean() if batch.mask is None else (error * batch.mask).sum() / batch.mask.sum()
        std = torch.maximum(mean.sqrt(), self.σ)
        self.root.copy_((std - self.noise_floor).sqrt())

    def prior_without(self, row: int) -> PathPrior:
        """The mixture over latent paths of all training movements but one."""
        return self._prior(self.frames, torch.arange(len(self.prior_movements)) != row)

    def _readout(self, y: Float[Tensor, "sequence time latent"]) -> Readout:
        J = jacobians(self.decoder, y.flatten(0, 1)).detach().double()
        std = self.σ.detach().double().expand(J.shape[1])
        return Readout(J.unflatten(0, y.shape[:2]), std)

    def _prior(
        self, length: int, rows: Tensor | None = None, lasting: int | None = None
    ) -> PathPrior:
        """The mixture over latent paths of ``length`` frames, in float64, of some movements.

        ``lasting`` is how many frames whole ones have, None: as many as the longest.
        """
        if not self.prior_movements.numel():
            raise NotFittedError(f"{self.label} knows no movements yet; train it by zoo.fit first")
        kept = slice(None) if rows is None else rows
        θ, residuals = self.prior_movements[kept].double(), self.prior_residuals[kept].double()
        own = self._lasting(self.frames if lasting is None else lasting)
        shape = lengthened(self.prior_shape.tolist(), max(0, length - own.frames) / own.frames)
        return own.prior(θ, stretched(residuals, None, own.frames), length, shape)

    def _lasting(self, frames: int) -> Imitator:
        """The primitive of movements of ``frames`` frames."""
        pace(self.label, self.imitator.system, frames, self.frames)
        return self.imitator.lasting(frames)

    def _completed(
        self,
        y: Float[Tensor, "sequence time latent"],
        seen: Bool[Tensor, "sequence time"],
        length: int,
        draws: int,
    ) -> Float[Tensor, "sample sequence frame latent"]:
        """Draws of paths of ``length`` frames given the latent frames seen."""
        if length > y.shape[1] or not self.is_ragged:
            check_end(self.label, self.frames, y.shape[1], length - y.shape[1])
        prior: PathPrior | Paces = self._prior(length)
        if self.is_ragged:
            prior = paced(lambda n: self._prior(length, lasting=n), self.prior_lengths, y.shape[1])
        return completed(prior, y, seen, length, draws)

    def _encoded(
        self, batch: Batch, posterior: Posterior | None
    ) -> tuple[Float[Tensor, "sequence time latent"], Bool[Tensor, "sequence time"]]:
        """Latent frames, missing joints filled by passing them k times; frames seen at all."""
        guide, x = need(posterior), batch.values
        if batch.mask is None:
            return guide.encode(x).mean, torch.ones_like(x[..., 0], dtype=torch.bool)
        x = torch.where(batch.mask, x, 0.0)
        for _ in range(self.chain):
            x = torch.where(batch.mask, x, self.decoder(guide.encode(x).mean))
        return guide.encode(x).mean, batch.mask.any(-1)

    def _imitated(self, batch: Batch, posterior: Posterior | None) -> Tensor:
        return need(posterior).draw(batch, 1)["theta"][0]

    def _whole(self, batch: Batch) -> int:
        """Frames of whole movements, of which this model can roll out as many."""
        frames = batch.values.shape[1]
        check_whole(self.label, self.frames, frames, self.is_ragged)
        pace(self.label, self.imitator.system, frames, self.frames)
        return frames

    def _lengths(self, batch: Batch) -> Int[Tensor, " window"] | None:
        """Frames of every whole movement; None where all are as long as the longest."""
        lengths = lengths_of(batch, self.frames)
        return None if lengths is None else windows_of(batch, lengths)
