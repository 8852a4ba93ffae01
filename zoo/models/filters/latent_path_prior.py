"""The latent path prior: a mixture around the training movements' latent paths, for VAE-DMP."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from zoo.contract.readiness import need
from zoo.errors import NotFittedError
from zoo.inference.laplace import laplace
from zoo.models.filters.latent_dmp import Config, LatentDmp
from zoo.movement.demonstrations import extremes, seen_entries
from zoo.movement.durations import stretched
from zoo.movement.lengths import check_end
from zoo.movement.paces import ConditionedPaces, Paces, lengthened, paced
from zoo.movement.paths import Conditioned, PathPrior, Readout
from zoo.movement.response import Response
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Layout, Posterior

__all__ = ["PRIOR_DRAWS", "LatentPathPrior"]

_LEARNED = ("prior_movements", "prior_residuals", "prior_observation", "prior_shape", "reached")
PRIOR_DRAWS = 32
RESTARTS, KEPT = 4, 64
UNSEEN = 1e6
SEEN = 1 - 1e-6


class LatentPathPrior(LatentDmp):
    """What ``VaeDmp`` forecasts and fills gaps by, not its own p(w).

    The latents of the training movements, and what their paths leave of the encoded frames, are
    kept; :class:`~zoo.movement.paths.PathPrior` is a mixture around them, conditioned exactly on
    the frames observed.
    """

    prior_movements: Tensor
    prior_residuals: Tensor
    prior_observation: Tensor
    prior_shape: Tensor
    prior_lengths: Tensor
    reached: Tensor

    def __init__(self, layout: Layout, config: Config) -> None:
        """A model of the movements of ``layout``, the longest as the unit of time."""
        super().__init__(layout, config)
        for name in _LEARNED:
            self.register_buffer(name, torch.empty(0))
        if self.is_ragged:
            self.register_buffer("prior_lengths", torch.empty(0, dtype=torch.long))

    def forecast(
        self, batch: Batch, posterior: Posterior | None, *, horizon: int, draws: int
    ) -> Predictive:
        """Joint draws of the future given the encoded frames; phase 0 is the first frame."""
        seen = batch.values.shape[1]
        paths = self._conditioned(batch, need(posterior), seen + horizon).sample(draws)
        return self.decode(paths[:, :, seen:])

    def impute(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Joint draws of whole movements given the entries observed."""
        paths = self._conditioned(batch, need(posterior), batch.values.shape[1]).sample(draws)
        return self.decode(paths)

    def learn_prior(self, batch: Batch, posterior: Posterior) -> None:
        """Keep the latents of the training movements, and what the encoder sees beside them.

        The residuals are what the noise ε must add for the paths to pass through the encoded
        frames, at equal phases of movements that last unlike long; how far new movements may be
        from those known is found by leaving each out.
        """
        found = self._latents(posterior.draw(batch, PRIOR_DRAWS))
        parts = (found.w, *(v.unsqueeze(2) for v in (found.goal, found.position, found.velocity)))
        self.prior_movements = torch.cat([v.mean(0) for v in parts], dim=1).detach()
        self.reached = extremes(batch.values, seen_entries(batch))
        lengths = self.lengths(batch)
        if self.is_ragged:
            self.prior_lengths = batch.frames
        frames = stretched(self._observe(batch, posterior), lengths, self.frames)
        seen = self._frames_seen(batch)[..., None].to(frames)
        seen = stretched(seen, lengths, self.frames) > SEEN
        self.prior_residuals = torch.zeros_like(frames)
        self.prior_shape = frames.new_empty(0)
        rolled = self._prior(self.frames).paths.to(frames)
        self.prior_residuals = ((frames - rolled) * seen).detach()
        tuned = self._prior(self.frames).tuned(
            (self.frames // 7, self.frames // 2), self._readout(frames), self.prior_without
        )
        self.prior_shape = frames.new_tensor(tuned.shape)

    def learn_noise(self, batch: Batch, posterior: Posterior) -> None:
        """σ of movements that no network was trained on, never below what training found.

        σ² = E_q (x − μ(g(z)))² is what maximises their bound (80); a decoder fits the frames that
        it was trained on better than others.
        """
        z = posterior.encode(batch.values, batch.mask).sample((PRIOR_DRAWS,))
        error = (self.decoder(self.embed(z)) - batch.values).square().mean(0)
        mask = seen_entries(batch)
        mean = (error * mask).sum((0, 1)) / mask.sum((0, 1)).clamp(min=1)
        std = torch.maximum(mean.sqrt(), self.output_std)
        self.output_root.copy_((std - self.config.output_floor).sqrt())

    def prior_without(self, row: int) -> PathPrior:
        """The mixture over latent paths of all training movements but one."""
        return self._prior(self.frames, torch.arange(len(self.prior_movements)) != row)

    def _observe(self, batch: Batch, posterior: Posterior) -> Float[Tensor, "sequence time latent"]:
        """Encoded frames; how uncertain they are is kept."""
        q = posterior.encode(batch.values, batch.mask)
        frames, seen = self.embed(q.mean), self._frames_seen(batch)
        noise = (self.embed(q.sample((PRIOR_DRAWS,))) - frames) * seen[..., None]
        share = PRIOR_DRAWS * seen.sum() / len(frames)
        self.prior_observation = (torch.einsum("smti,smtj->mij", noise, noise) / share).detach()
        return frames

    def _readout(self, frames: Float[Tensor, "sequence time latent"]) -> Readout:
        jacobian = torch.func.vmap(torch.func.jacfwd(self.decoder))(frames.flatten(0, 1))
        shape = (*frames.shape[:2], *jacobian.shape[1:])
        return Readout(jacobian.detach().double().view(shape), self.output_std.detach().double())

    def _frames_seen(self, batch: Batch) -> Bool[Tensor, "sequence time"]:
        if batch.mask is None:
            return torch.ones(batch.values.shape[:2], dtype=torch.bool, device=self.basis.device)
        return batch.mask.all(-1)

    def _paced(self, seen: int, length: int) -> PathPrior | Paces:
        """The mixture over latent paths of movements of which ``seen`` frames are known."""
        if not self.is_ragged or not self.phased:
            return self._prior(length)
        return paced(lambda n: self._prior(length, lasting=n), self.prior_lengths, seen)

    def _prior(
        self, length: int, rows: Tensor | None = None, lasting: int | None = None
    ) -> PathPrior:
        """The mixture over latent paths of ``length`` frames, in float64, of some movements.

        ``lasting`` is how many frames whole ones have, None: as many as the longest.
        """
        if not self.prior_movements.numel():
            raise NotFittedError(f"{self.label} knows no movements yet; train it by zoo.fit first")
        movements, residuals, observation = self._known(rows)
        u, whole = movements.double(), self.frames if lasting is None else lasting
        missing, τ = length - whole, self.pace(whole)
        response = Response.of(self.lasting(whole), length, torch.float64, u.device)
        force = self.system.stiffness * torch.cat(
            [self.config.w_scale * self.kernels_at(length - 1, τ), torch.ones(length - 1, 1)], dim=1
        )
        start = torch.zeros(2, self.kernels + 3, dtype=torch.float64)
        start[0, -2], start[1, -1] = 1.0, 1 / τ
        φ = response.product(start, nn.functional.pad(force, (0, 2)))[0]
        return PathPrior.of_responses(
            φ,
            u,
            _variances(u),
            nn.functional.pad(stretched(residuals.double(), None, whole), (0, 0, 0, missing)),
            observation.double().mean(0),
            lengthened(self.prior_shape.tolist(), max(0, missing) / whole),
        )

    def _known(self, rows: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Latents, residuals and observation noise of all training movements or of some."""
        kept = slice(None) if rows is None else rows
        return (
            self.prior_movements[kept],
            self.prior_residuals[kept],
            self.prior_observation[kept],
        )

    def _conditioned(
        self, batch: Batch, posterior: Posterior, length: int
    ) -> Conditioned | ConditionedPaces:
        """p(z*_{1:length} | frames observed)."""
        seen = batch.values.shape[1]
        if self.phased and (length > seen or not self.is_ragged):
            check_end(self.label, self.frames, seen, length - seen)
        prior = self._paced(seen, length)
        where = torch.arange(length) < seen
        y = self.embed(posterior.encode(batch.values, batch.mask).mean)
        extra = None
        if batch.mask is not None and _is_one_section(batch.mask):
            where[:seen] = batch.mask[0, :, 0]
        elif batch.mask is not None:
            y, extra = self._encoded(batch.values, batch.mask, y, posterior)
            extra = nn.functional.pad(extra.double(), (0, 0, 0, 0, 0, length - seen))
        return prior.condition(
            nn.functional.pad(y.double(), (0, 0, 0, length - seen)), where, extra
        )

    def _encoded(
        self, values: Tensor, mask: Tensor, y: Tensor, posterior: Posterior
    ) -> tuple[Float[Tensor, "sequence time d"], Float[Tensor, "sequence time d d"]]:
        """Latent frames and how uncertain missing entries make them, by the decoder alone."""
        extra = torch.diag_embed(UNSEEN * (~mask.any(-1, keepdim=True)).to(y).expand_as(y))
        part = mask.any(-1) & ~mask.all(-1)
        if not part.any():
            return y, extra
        known = laplace(
            lambda z: self.decoder(self.embed(z)),
            posterior.encode(values, mask).mean[part],
            values[part],
            torch.where(mask[part], self.output_std, torch.inf),
            restarts=RESTARTS,
            near=False,
        )
        moved = self.embed(known.sample((KEPT,)))
        apart = moved - moved.mean(0)
        extra[part] = torch.einsum("sid,sie->ide", apart, apart) / (KEPT - 1)
        return y.masked_scatter(part[..., None], moved.mean(0)), extra


def _variances(u: Float[Tensor, "movement row latent"]) -> Float[Tensor, "row latent"]:
    """Variance of every row between movements, one for all kernels; of one movement its size."""
    apart = u - u.mean(0) if len(u) > 1 else u
    kernels = apart[:, :-3].square().mean((0, 1)).expand(u.shape[1] - 3, -1)
    return torch.cat([kernels, apart[:, -3:].square().mean(0)])


def _is_one_section(mask: Bool[Tensor, "sequence time channel"]) -> bool:
    """Whether only whole frames are missing, the same of every movement."""
    return bool((mask == mask[:1, :, :1]).all())
