"""The process noise of a filter as one vectorised distribution with its own adjoint."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.distributions import kl

__all__ = ["FilteringNoise", "NoiseNetwork", "RecurrentNoise", "Stacked"]

ROOT_SCALE = 0.1


class NoiseNetwork(nn.Module):
    """Moments of ε̂_{t+1} from (x_{t+1}, z_t), (79): one hidden layer, σ = (W_σ h + b_σ)² + floor.

    >>> network = NoiseNetwork(channels=50, latent_dim=5, hidden=20)
    >>> mean, std = network(network.features(torch.randn(4, 50)), torch.randn(4, 5))
    >>> mean.shape, std.shape
    (torch.Size([4, 5]), torch.Size([4, 5]))
    """

    def __init__(
        self, *, channels: int, latent_dim: int, hidden: int, initial: float = 1.0
    ) -> None:
        """Network from ``channels`` and ``latent_dim`` inputs; σ starts near ``initial``."""
        super().__init__()
        self.floor = 1e-3
        self.features = nn.Linear(channels, hidden)
        self.state = nn.Linear(latent_dim, hidden, bias=False)
        self.moments = nn.Linear(hidden, 2 * latent_dim)
        with torch.no_grad():
            self.moments.weight[latent_dim:] *= ROOT_SCALE
            self.moments.bias[latent_dim:] = initial**0.5

    def forward(
        self, features: Float[Tensor, "*batch hidden"], z: Float[Tensor, "*batch latent"]
    ) -> tuple[Float[Tensor, "*batch latent"], Float[Tensor, "*batch latent"]]:
        """Mean and standard deviation of ε̂_{t+1}."""
        hidden = torch.relu(features + self.state(z))
        mean, root = self.moments(hidden).chunk(2, dim=-1)
        return mean, root.square() + self.floor


class _Filter(torch.autograd.Function):
    """The recurrence ε̂_{t+1} = μ + σ η, s_{t+1} = s_t A + drive_t + ε̂_{t+1} G and its adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        noise: Tensor,
        state: Tensor,
        drive: Tensor,
        transition: Tensor,
        gain: Tensor,
        state_weight: Tensor,
        weight: Tensor,
        bias: Tensor,
        floor: float,
    ) -> tuple[Tensor, Tensor]:
        steps, latent = noise.shape[0], noise.shape[2]
        s = torch.empty_like(drive)
        h, ε, σ = torch.empty_like(features), torch.empty_like(noise), torch.empty_like(noise)
        m = noise.new_empty(*noise.shape[:2], 2 * latent)
        s[0] = state
        lift, head = _lift(state_weight, state.shape[1]).t(), weight.t()
        least, own = noise.new_full((), floor), transition.ndim == 3
        for t in range(steps):
            torch.addmm(features[t], s[t], lift, out=h[t]).clamp_min_(0)
            μ, root = torch.addmm(bias, h[t], head, out=m[t]).split(latent, 1)
            torch.addcmul(least, root, root, out=σ[t])
            torch.addcmul(μ, σ[t], noise[t], out=ε[t])
            if t + 1 < steps and own:
                s[t + 1] = drive[t] + _rows(s[t], transition) + _rows(ε[t], gain)
            elif t + 1 < steps:
                torch.addmm(drive[t], s[t], transition, out=s[t + 1]).addmm_(ε[t], gain)
        ctx.save_for_backward(s, h, m, ε, noise, transition, gain, state_weight, weight)
        return ε, σ

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        s, h, m, ε, noise, transition, gain, state_weight, weight = ctx.saved_tensors
        g_ε, g_σ = grads
        steps, latent = noise.shape[0], noise.shape[2]
        root2 = 2 * m[..., latent:]
        slope, direct = root2 * noise, root2 * g_σ
        lift, back, out = _lift(state_weight, s.shape[2]), transition.mT, gain.mT
        own = transition.ndim == 3
        λ, g_h, g_m = torch.zeros_like(s), h.sign(), torch.empty_like(m)
        g_state = torch.zeros_like(s[0])
        for t in range(steps - 1, -1, -1):
            μ, root = g_m[t].split(latent, 1)
            μ.copy_(g_ε[t] + _rows(λ[t], out) if own else torch.addmm(g_ε[t], λ[t], out))
            torch.addcmul(direct[t], μ, slope[t], out=root)
            g_h[t].mul_(g_m[t] @ weight)
            before = λ[t - 1] if t else g_state
            if own:
                before.copy_(_rows(λ[t], back))
            else:
                torch.mm(λ[t], back, out=before)
            before.addmm_(g_h[t], lift)
        g_transition = _contract(s, λ, own) if ctx.needs_input_grad[4] else None
        g_lift = _contract(g_h, s, False)[:, :latent]
        g_bias = g_m.flatten(0, 1).sum(0)
        return (
            g_h,
            None,
            g_state,
            λ,
            g_transition,
            _contract(ε, λ, own),
            g_lift,
            _contract(g_m, h, False),
            g_bias,
            None,
        )


def _lift(weight: Tensor, states: int) -> Tensor:
    """The noise network sees z, not ż: zero columns for the rest of the state."""
    return nn.functional.pad(weight, (0, states - weight.shape[1]))


def _rows(rows: Tensor, matrices: Tensor) -> Tensor:
    """Every row times the matrix of its own window."""
    return torch.bmm(rows[:, None], matrices)[:, 0]


def _contract(left: Tensor, right: Tensor, own: bool) -> Tensor:
    if own:
        return torch.einsum("twi,twj->wij", left, right)
    return left.flatten(0, 1).t() @ right.flatten(0, 1)


class RecurrentNoise(TorchDistribution):
    r"""Noise whose moments in every step depend on the state that the noise before led to.

    A draw is one recurrence; its moments are kept, so that its log density and its divergence from
    a Gaussian prior cost nothing more.
    """

    has_rsample = True
    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.real, 2)

    def __init__(self, steps: int, windows: int, latent: int, like: Tensor) -> None:
        """Noise of ``windows`` sub-sequences; ``like`` has its dtype and device."""
        self._like = like
        self._kept: tuple[Tensor, Tensor, Tensor] | None = None
        super().__init__(torch.Size((windows,)), torch.Size((steps, latent)), validate_args=False)

    @abstractmethod
    def draw(self, η: Float[Tensor, "step window latent"]) -> tuple[Tensor, Tensor]:
        """Noise and its standard deviations, from standard normal numbers, time-major."""
        ...

    @abstractmethod
    def moments(
        self, value: Float[Tensor, "window step latent"]
    ) -> tuple[Float[Tensor, "step window latent"], Float[Tensor, "step window latent"]]:
        """Mean and standard deviation of every step along the states that ``value`` leads to."""
        ...

    def expand(self, batch_shape: Any, _instance: Any = None) -> RecurrentNoise | Stacked:
        """The distribution itself, or draws of it one after the other."""
        if torch.Size(batch_shape) == self.batch_shape:
            return self
        return Stacked([self], ()).expand(batch_shape)

    def rsample(
        self, sample_shape: Any = (), noise: Tensor | None = None
    ) -> Float[Tensor, "window step latent"]:
        """One reparameterised draw; ``noise`` η replaces the standard normal numbers."""
        if tuple(sample_shape):
            raise ValueError(f"one draw at a time; got sample_shape {tuple(sample_shape)}")
        shape = (self.event_shape[0], self.batch_shape[0], self.event_shape[1])
        η = torch.randn(shape, dtype=self._like.dtype, device=self._like.device)
        η = η if noise is None else noise
        ε, σ = self.draw(η)
        value: Tensor = ε.transpose(0, 1)
        self._kept = value, η, σ
        return value

    def log_prob(self, value: Float[Tensor, "window step latent"]) -> Float[Tensor, " window"]:
        """Log density of ``value``, summed over steps and dimensions."""
        if self._kept is not None and value is self._kept[0]:
            _, η, σ = self._kept
            return _log_normal(η, σ)
        mean, std = self.moments(value)
        return _log_normal((value.transpose(0, 1) - mean) / std, std)

    def kept_moments(self) -> tuple[Tensor, Tensor]:
        """Moments along the last draw, shape (step, window, latent)."""
        if self._kept is None:
            raise ValueError("no draw has been made")
        value, η, σ = self._kept
        return value.transpose(0, 1) - σ * η, σ


class Stacked(TorchDistribution):
    """Independent distributions of one shape side by side, along the axes ``lead``.

    Vectorised particles of a recurrence: each part runs its own.
    """

    has_rsample = True
    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.real, 2)

    def __init__(self, parts: Sequence[RecurrentNoise], lead: Sequence[int]) -> None:
        """``parts`` in the order of the axes ``lead``."""
        self.parts, self.lead = list(parts), torch.Size(lead)
        batch_shape = self.lead + parts[0].batch_shape
        super().__init__(batch_shape, parts[0].event_shape, validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> Stacked:
        """The same distributions again and again, along axes before all others."""
        shape = torch.Size(batch_shape)
        known = len(self.batch_shape)
        if len(shape) < known or shape[len(shape) - known :] != self.batch_shape:
            raise ValueError(f"batch shape {tuple(shape)} for {tuple(self.batch_shape)} windows")
        new = shape[: len(shape) - known]
        return self if not new else Stacked(self.parts * new.numel(), new + self.lead)

    def rsample(self, sample_shape: Any = ()) -> Float[Tensor, "*sample window step latent"]:
        """One reparameterised draw of every part."""
        if tuple(sample_shape):
            raise ValueError(f"one draw at a time; got sample_shape {tuple(sample_shape)}")
        value: Tensor = torch.stack([p.rsample() for p in self.parts]).unflatten(0, self.lead)
        return value

    def log_prob(
        self, value: Float[Tensor, "*sample window step latent"]
    ) -> Float[Tensor, "*sample window"]:
        """Log density of every part's value."""
        values = value.reshape(len(self.parts), *value.shape[-3:])
        each = [part.log_prob(v) for part, v in zip(self.parts, values, strict=True)]
        total: Tensor = torch.stack(each).unflatten(0, self.lead)
        return total


class FilteringNoise(RecurrentNoise):
    r"""q(ε̂_{2:T} | x, s_1): ε̂_{t+1} ~ N(μ(x_{t+1}, z_t), σ²(x_{t+1}, z_t)), (79), (84).

    The states between follow s_{t+1} = s_t A + drive_t + ε̂_{t+1} G, in plain torch with the
    adjoint written out. A and G are shared by all windows, or each has its own.
    """

    def __init__(
        self,
        network: NoiseNetwork,
        features: Float[Tensor, "step window hidden"],
        state: Float[Tensor, "window state"],
        drive: Float[Tensor, "step window state"],
        transition: Float[Tensor, "*each state state"],
        gain: Float[Tensor, "*each latent state"],
    ) -> None:
        """Noise of ``window`` sub-sequences, each ``step`` + 1 frames long."""
        self.network, self.features, self.state = network, features, state
        self.drive, self.transition, self.gain = drive, transition, gain
        super().__init__(features.shape[0], state.shape[0], gain.shape[-2], state)

    def draw(self, η: Float[Tensor, "step window latent"]) -> tuple[Tensor, Tensor]:
        """The recurrence and its adjoint."""
        net = self.network
        found: tuple[Tensor, Tensor] = _Filter.apply(  # type: ignore[no-untyped-call]
            self.features,
            η,
            self.state,
            self.drive,
            self.transition,
            self.gain,
            net.state.weight,
            net.moments.weight,
            net.moments.bias,
            net.floor,
        )
        return found

    def moments(
        self, value: Float[Tensor, "window step latent"]
    ) -> tuple[Float[Tensor, "step window latent"], Float[Tensor, "step window latent"]]:
        """Mean and standard deviation of every step along the states that ``value`` leads to."""
        noise, own = value.transpose(0, 1), self.transition.ndim == 3
        pushed = torch.einsum("twl,wls->tws", noise, self.gain) if own else noise @ self.gain
        added, states = self.drive + pushed, [self.state]
        for t in range(len(added) - 1):
            before, A = states[-1], self.transition
            states.append(added[t] + (_rows(before, A) if own else before @ A))
        z = torch.stack(states)[..., : self.gain.shape[-2]]
        mean, std = self.network(self.features, z)
        return mean, std


def _log_normal(η: Tensor, σ: Tensor) -> Tensor:
    constant = 0.9189385332046727 * η.shape[0] * η.shape[2]
    return -(0.5 * η.square() + σ.log()).sum((0, 2)) - constant


@kl.register_kl(RecurrentNoise, torch.distributions.Independent)  # type: ignore[untyped-decorator]
def _kl_recurrent_prior(q: RecurrentNoise, p: torch.distributions.Independent[Any]) -> Tensor:
    """KL of every step given the state it starts from, along the draw: no noise of its own."""
    if not isinstance(p.base_dist, torch.distributions.Normal) or p.event_shape != q.event_shape:
        raise NotImplementedError
    mean, std = q.kept_moments()
    each = kl.kl_divergence(
        torch.distributions.Normal(mean.transpose(0, 1), std.transpose(0, 1), validate_args=False),
        p.base_dist,
    )
    return each.sum((1, 2))
