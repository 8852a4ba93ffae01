"""Dynamic movement primitives in the latent space of a time-dependent variational autoencoder."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float
from torch import Tensor

from zoo.contract.readiness import need
from zoo.errors import MovementLengthError
from zoo.models.filters.latent_changes import LatentChanges
from zoo.models.filters.latent_dmp import Config
from zoo.models.filters.latent_path_prior import LatentPathPrior
from zoo.movement.durations import timed_paths, windows_of
from zoo.movement.plan import Plan
from zoo.movement.response import Response
from zoo.prediction.predictive import Predictive
from zoo.types import Batch, Posterior

__all__ = ["Config", "VaeDmp"]


class VaeDmp(LatentPathPrior, LatentChanges):
    r"""Movements as latent DMPs with process noise, decoded frame by frame (thesis §6.2).

    With s = (z*, ż), β = α/4 and dt = 1/(n − 1)::

        w ~ N(0, I),  z^goal, z_t ~ N(0, I),  ż_1 = σ_ż v,  v ~ N(0, I),  z* = g(z)
        s_{t+1} = A s_t + [dt, 1]ᵀ (αβ z*^goal + f_t + ε_{t+1}) dt,       (74)–(77)
        f_t = αβ σ_w Ψ(s_t) w,  ε = αβ ε̂ w_ε,  ε̂ ~ N(0, I)
        x_t ~ N(μ(z*_t), diag σ²),  σ constant in time                    (82), (83)

    Every window is observed twice, with z*_t rolled out (81) and with z*_t = g(z_t) of its own
    (80). Choices where the thesis is silent: g(z) = z + MLP(z); ż_1 has a Gaussian prior of its own
    and is recognised from the first two frames; σ = s² + floor.

    The program gives reconstructions, new goals, durations and switches. Forecasts and imputation
    are not those of its p(w), p(z^goal), (76)–(78), which know neither w nor goal of a new
    movement: they are those of a model of its own, the *latent path prior*. After training, the
    latents of the training movements become a mixture over latent paths, with what the paths leave
    of the encoded frames as a stationary process in place of ε; it is conditioned exactly on the
    frames observed (:class:`~zoo.movement.paths.PathPrior`). ``python -m
    benchmarks.latent_path_prior`` takes the two apart. A frame observed in part is a Gaussian at
    the mode of p(z | x_seen), which the decoder gives. σ is estimated again on movements that the
    networks were not trained on, where there are any (:meth:`learn_noise`).

    Movements that last unlike long have each their own duration: τ_i = (n_i − 1)/(n − 1), n the
    longest, in A, b and Ψ, as :class:`~zoo.movement.response.Transformation` has it. How long a
    movement of which only frames are known will last is then not known: the latent path prior is a
    mixture over durations of training movements too (:class:`~zoo.movement.paces.Paces`).
    Movements end, and nothing is said of frames after the longest.
    N. Chen, M. Karl, P. van der Smagt, *Dynamic movement primitives in latent space of
    time-dependent variational autoencoders*, Humanoids 2016.
    """

    def forward(self, batch: Batch) -> None:
        """The Pyro program: both sub-sequence lengths, (80) and (81), observe the window (82)."""
        windows, time = self._windows(batch)
        latent = self.latent_dim
        unit = dist.Normal(self.basis.new_zeros(()), self.basis.new_ones(()), validate_args=False)
        rows = len(batch.movements)
        with pyro.plate("movements", batch.total_sequences, subsample=torch.arange(rows)):
            plan = self.plan(rows)
        with pyro.plate("windows", batch.total, subsample=torch.arange(windows)):
            z = pyro.sample("z", unit.expand([windows, time, latent]).to_event(2))
            velocity = pyro.sample("velocity", unit.expand([windows, latent]).to_event(1))
            ε = pyro.sample("epsilon", unit.expand([windows, time - 1, latent]).to_event(2))
            path = self.paths(z, velocity, plan, ε, batch)
            if self.config.flatness:
                pyro.factor("flatness", self.flatness_prior(path))
            mean = self.decoder(torch.stack([path, self.embed(z)]))
            for name, frames in zip(("x", "x_single"), mean, strict=True):
                x = dist.Normal(frames, self.output_std, validate_args=False)
                if batch.mask is not None:
                    x = x.mask(batch.mask)
                pyro.sample(name, x.to_event(2), obs=batch.given(batch.values))

    def _windows(self, batch: Batch) -> tuple[int, int]:
        """Number and length of the windows, none of which may be padded."""
        windows, time = batch.values.shape[:2]
        if batch.lengths is not None and time > int(batch.lengths.min()):
            raise MovementLengthError(
                f"{self.label} takes movements of unlike length in windows of one length; got "
                f"windows of {time} frames and a movement of {int(batch.lengths.min())}: set "
                f"window={int(batch.lengths.min())} or less"
            )
        return windows, time

    def plan(self, rows: int) -> Plan:
        """The sites of ``rows`` movements."""
        zero = self.basis.new_zeros(rows, self.latent_dim)
        unit = dist.Normal(zero, 1.0, validate_args=False).to_event(1)
        return Plan(
            w=pyro.sample("w", self.forcing_prior(rows)),
            goal=pyro.sample("goal", unit),
            start=pyro.sample("start", unit) if self.goal_scaling else None,
        )

    def noise_gain(self, batch: Batch) -> Float[Tensor, "*window latent state"]:
        """G: ε = ε̂ w_ε enters the next state as (77) says."""
        return (self.system.stiffness * self.w_noise) @ self._moves(batch)[1]

    def initial_state(
        self,
        z: Float[Tensor, "window latent"],
        velocity: Float[Tensor, "window latent"],
        batch: Batch,
    ) -> Float[Tensor, "window state"]:
        """(z*_1, ż_1) of a window's first frame."""
        return torch.cat([self.embed(z), self._speed(velocity, batch)], dim=1)

    def _speed(
        self, velocity: Float[Tensor, "window latent"], batch: Batch
    ) -> Float[Tensor, "window latent"]:
        """ż_1 = σ_ż v / τ."""
        speed, lengths = self.config.velocity_scale * velocity, self.lengths(batch)
        if lengths is None:
            return speed
        return speed * ((self.frames - 1) / (windows_of(batch, lengths) - 1))[:, None].to(speed)

    def forces(self, plan: Plan, batch: Batch) -> Float[Tensor, "step window latent"]:
        """αβ z^goal + f_t of every step, f_t = αβ Ψ(s_t) w, time-major."""
        steps = batch.values.shape[1] - 1
        goal = self.embed(plan.goal)
        w = self.scaled(plan.w, goal, None if plan.start is None else self.embed(plan.start))
        pull = goal + self.forcing(w, plan, batch)
        at = batch.start + torch.arange(steps, device=batch.start.device)[:, None]
        row = at * pull.shape[1] + batch.sequence
        picked = (self.system.stiffness * pull).flatten(0, 1).index_select(0, row.flatten())
        return picked.view(steps, len(batch), -1)

    def forcing(
        self, w: Float[Tensor, "sequence kernel latent"], plan: Plan, batch: Batch
    ) -> Float[Tensor, "step sequence latent"]:
        """f_t in units of αβ of every step of whole movements, time-major."""
        lengths = self.lengths(batch)
        if lengths is None:
            return torch.einsum("tk,ukl->tul", self.config.w_scale * self.basis, w)
        each, which = lengths.unique(return_inverse=True)
        steps = batch.movements.shape[1] - 1
        Ψ = [self.kernels_at(steps, self.pace(n)).to(w) for n in each.tolist()]
        return torch.einsum("utk,ukl->tul", self.config.w_scale * torch.stack(Ψ)[which], w)

    def drive(self, plan: Plan, batch: Batch) -> Float[Tensor, "step window state"]:
        """What goal and forcing term add to the state in every step, (77)."""
        force, push = self.forces(plan, batch), self._moves(batch)[1]
        return force @ push if push.ndim == 2 else torch.einsum("twd,wds->tws", force, push)

    def path(
        self,
        z: Float[Tensor, "window latent"],
        velocity: Float[Tensor, "window latent"],
        plan: Plan,
        ε: Float[Tensor, "window step latent"],
        batch: Batch,
    ) -> Float[Tensor, "window time latent"]:
        """z*_{1:T} by the linear response of (75): no loop over time."""
        steps, lengths = batch.values.shape[1], self.lengths(batch)
        noise = ε.transpose(0, 1) @ (self.system.stiffness * self.w_noise)
        force = self.forces(plan, batch) + noise
        begin = torch.stack([self.embed(z), self._speed(velocity, batch)])
        if lengths is not None:
            each, which = windows_of(batch, lengths).unique(return_inverse=True)
            return timed_paths([self.lasting(n) for n in each.tolist()], which, begin, force)
        response = Response.of(self.system, steps, z.dtype, z.device)
        states = response.product(begin.flatten(1), force.flatten(1))
        return states[0].view(steps, len(batch), -1).transpose(0, 1)

    def paths(
        self,
        z: Float[Tensor, "*sample window time latent"],
        velocity: Float[Tensor, "*sample window latent"],
        plan: Plan,
        ε: Float[Tensor, "*sample window step latent"],
        batch: Batch,
    ) -> Float[Tensor, "*sample window time latent"]:
        """The paths of every draw of the program's sites, such as Pyro's vectorised particles."""
        lead = z.shape[:-3]
        if not lead:
            return self.path(z[:, 0], velocity, plan, ε, batch)
        parts = zip(
            z.flatten(0, -4), velocity.flatten(0, -3), plan.draws(), ε.flatten(0, -4), strict=True
        )
        found = [self.path(z[:, 0], v, p, ε, batch) for z, v, p, ε in parts]
        paths: Tensor = torch.stack(found).unflatten(0, lead)
        return paths

    def represent(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Paths z* with the recognised noise."""
        return Predictive(location=self._recognised(batch, posterior, draws), joint=True)

    def reconstruct(self, batch: Batch, posterior: Posterior | None, *, draws: int) -> Predictive:
        """Whole movements through the DMP with the recognised w, goal, start and noise."""
        return self.decode(self._recognised(batch, posterior, draws))

    def _recognised(self, batch: Batch, posterior: Posterior | None, draws: int) -> Tensor:
        """Draws of the paths of whole movements."""
        self._whole(batch)
        drawn = need(posterior).draw(batch, draws)
        flat = {name: value.flatten(0, 1) for name, value in drawn.items()}
        first, velocity, ε = flat["z"][:, 0], flat["velocity"], flat["epsilon"]
        path = self.path(first, velocity, Plan.of(flat), ε, batch.repeat(draws))
        split: Tensor = path.unflatten(0, (draws, len(batch)))
        return split
