r"""Dynamic movement primitives: transformation system, basis functions and linear response.

One convention throughout, that of Ijspeert et al. (2013); τ = 1 reproduces thesis (53)::

    τ² ÿ = α (β (g − y) − τ ẏ) + f

Semi-implicit Euler steps of it are thesis (74)–(77). They are linear in (y₁, ẏ₁, g, f), so that
all states of a movement follow from one product with a lower-triangular matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

__all__ = [
    "ALPHA_FRAME",
    "Response",
    "Transformation",
    "critical_system",
    "discrete_basis",
    "impulse_response",
    "input_vector",
    "phase",
    "rhythmic_basis",
    "transition_matrix",
]

DECAY = math.log(100.0)
ALPHA, ALPHA_FRAME = 25.0, 0.4
WIDTH = 0.55
DENSE = 300
BLOCK = 32


@dataclass(frozen=True)
class Transformation:
    """Constants of the transformation system (53): attraction, damping, time scale and step.

    ``tau`` and ``dt`` share one unit of time; β = α/4 damps critically.

    >>> Transformation(alpha=25.0, beta=6.25, tau=1.0, dt=0.1).stable
    False
    """

    alpha: float = 25.0
    beta: float = 6.25
    tau: float = 1.0
    dt: float = 0.01

    def __post_init__(self) -> None:
        """Refuse constants that are no attractor."""
        for name in ("alpha", "beta", "tau", "dt"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive; got {getattr(self, name)}")

    @property
    def stiffness(self) -> float:
        """αβ: the goal enters the system as a constant force αβ g."""
        return self.alpha * self.beta

    @property
    def stable(self) -> bool:
        """Whether semi-implicit Euler steps of this length converge to the goal."""
        return bool(torch.linalg.eigvals(transition_matrix(self)).abs().max() < 1)


def critical_system(
    alpha: float | None, frames: int, shortest: int | None = None
) -> Transformation:
    """The critically damped system, β = α/4, a movement of ``frames`` frames long in its unit.

    None for α is 25, or 0.4 a frame for movements under 64 frames: more makes Euler steps unstable.
    α is that of the ``shortest`` movements where these have fewer frames.
    """
    least = frames if shortest is None else shortest
    α = min(ALPHA, ALPHA_FRAME * (least - 1)) if alpha is None else alpha
    if not Transformation(α, α / 4, 1.0, 1 / (least - 1)).stable:
        raise ValueError(
            f"alpha = {α:g} makes Euler steps of {least} frames a movement unstable; "
            f"{ALPHA_FRAME * (least - 1):.3g} is safe"
        )
    return Transformation(α, α / 4, 1.0, 1 / (frames - 1))


def transition_matrix(system: Transformation) -> Float[Tensor, "2 2"]:
    """A of (76), with τ² for τ as Ijspeert et al. (2013) have it, in float64.

    >>> transition_matrix(Transformation(alpha=4.0, beta=1.0, tau=1.0, dt=0.1))
    tensor([[ 0.9600,  0.0600],
            [-0.4000,  0.6000]], dtype=torch.float64)
    """
    dt, spring, damping = system.dt, system.stiffness / system.tau**2, system.alpha / system.tau
    rate = torch.tensor(
        [[-dt * spring, 1 - dt * damping], [-spring, -damping]], dtype=torch.float64
    )
    return rate * dt + torch.eye(2, dtype=torch.float64)


def input_vector(system: Transformation) -> Float[Tensor, " 2"]:
    """The vector that multiplies αβ g + f + ε in b of (77), in float64."""
    return torch.tensor([system.dt, 1.0], dtype=torch.float64) * system.dt / system.tau**2


def impulse_response(
    transition: Float[Tensor, "2 2"], inputs: Float[Tensor, "2 *input"], steps: int
) -> tuple[Float[Tensor, "steps_plus_1 2 2"], Float[Tensor, "steps 2 *input"]]:
    """A⁰ … A^steps, and A^k B: the answer k + 1 steps after a unit input; by doubling."""
    powers = torch.eye(2, dtype=transition.dtype)[None]
    while len(powers) <= steps:
        powers = torch.cat([powers, powers @ (powers[-1] @ transition)])
    return powers[: steps + 1], powers[:steps] @ inputs


class Response:
    """All states of the transformation system in one product: the linear response of (75).

    Up to 300 states are one time-major product; beyond, one product carries the states at the
    begins of blocks of 32 steps and a batched one fills the blocks. Differentiable in every
    argument. Get one from :meth:`of`, which keeps them.

    >>> response = Response.of(Transformation(), 50, torch.float64, "cpu")
    >>> still, goal = torch.zeros(1, 2, dtype=torch.float64), torch.ones(1, 2, dtype=torch.float64)
    >>> z, velocity = response.states(still, still, goal, torch.zeros(1, 49, 2))
    >>> z.shape, bool(z[0, -1, 0] > 0.9)
    (torch.Size([1, 50, 2]), True)
    """

    def __init__(
        self, system: Transformation, steps: int, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        """Precompute the response of ``steps`` states to the first state and the inputs."""
        if steps < 2:
            raise ValueError(f"steps must be at least 2; got {steps}")
        self.system, self.steps = system, steps
        self.block = steps if steps <= DENSE else BLOCK
        self.blocks = math.ceil(steps / self.block)
        transition, inputs = transition_matrix(system), input_vector(system)
        free, forced = impulse_response(transition, inputs, self.block)
        matrix = torch.cat([free[:-1].movedim(0, 1), _lagged(forced)], dim=2)
        ends = forced.flip(0).mT
        powers, _ = impulse_response(free[-1], inputs, self.blocks)
        carry = torch.stack([_toeplitz(p) for p in powers[:-1].flatten(1).mT])
        carry = carry.unflatten(0, (2, 2)).permute(2, 0, 3, 1).flatten(2).flatten(0, 1)
        self.matrix: Float[Tensor, "2 block block_plus_2"] = matrix.to(device, dtype)
        self.ends: Float[Tensor, "2 block"] = ends.to(device, dtype)
        self.carry: Float[Tensor, "2*blocks 2*blocks"] = carry.to(device, dtype)

    @staticmethod
    @lru_cache(maxsize=64)
    def of(
        system: Transformation,
        steps: int,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Response:
        """The response of ``steps`` states (``steps − 1`` inputs), computed once and kept."""
        return Response(system, steps, dtype, device)

    def states(
        self,
        position: Float[Tensor, "*batch latent"],
        velocity: Float[Tensor, "*batch latent"],
        goal: Float[Tensor, "*batch latent"] | Float[Tensor, "*batch time_minus_1 latent"],
        forcing: Float[Tensor, "*batch time_minus_1 latent"],
    ) -> tuple[Float[Tensor, "*batch time latent"], Float[Tensor, "*batch time latent"]]:
        """Positions and velocities from the first state, the goal and the force f + ε.

        ``forcing[..., t, :]`` acts on the step from t to t + 1; a goal may change in time.
        """
        if forcing.shape[-2] != self.steps - 1:
            raise ValueError(
                f"forcing has {forcing.shape[-2]} steps; this response needs {self.steps - 1}"
            )
        goal = goal.unsqueeze(-2) if goal.ndim == position.ndim else goal
        force = (self.system.stiffness * goal + forcing).movedim(-2, 0)
        start = torch.stack([position.expand(force.shape[1:]), velocity.expand(force.shape[1:])])
        path = self.product(start.flatten(1), force.flatten(1))
        z, rate = path.unflatten(2, force.shape[1:]).movedim(1, -2)
        return z, rate

    def product(
        self, start: Float[Tensor, "2 column"], force: Float[Tensor, "time_minus_1 column"]
    ) -> Float[Tensor, "2 time column"]:
        """Time-major form of :meth:`states`: ``force`` is αβ g + f + ε, columns are independent."""
        if self.blocks == 1:
            matrix = self.matrix[:, :, :-1].flatten(0, 1)
            dense = matrix @ torch.cat([start, force])
            return dense.view(2, self.steps, -1)
        short = self.blocks * self.block - len(force)
        pieces = pad(force, (0, 0, 0, short)).unflatten(0, (self.blocks, -1))
        jumps = torch.cat([start[None], (self.ends @ pieces)[:-1]])
        begins = (self.carry @ jumps.flatten(0, 1)).unflatten(0, (-1, 2))
        path = self.matrix.flatten(0, 1) @ torch.cat([begins, pieces], dim=1)
        path = path.view(self.blocks, 2, self.block, -1).movedim(1, 0)
        return path.flatten(1, 2)[:, : self.steps]


def phase(
    time: Float[Tensor, "*time"], *, duration: float, decay: float = DECAY
) -> Float[Tensor, "*time"]:
    """s of the canonical system (55), from 1 at time 0 to e^−decay at ``duration``.

    >>> phase(torch.tensor([0.0, 69.0]), duration=69)
    tensor([1.0000, 0.0100])
    """
    return torch.exp(-decay * time / duration)


def discrete_basis(
    time: Float[Tensor, "*time"],
    *,
    kernels: int,
    duration: float,
    normalised: bool = True,
) -> Float[Tensor, "*time kernel"]:
    """Ψ_i(s)/ΣΨ of the discrete system (56) at any times, in units of ``duration``.

    Centres are equally spaced in time from 0 to ``duration``; σ_i is 0.55 of the distance
    to the next centre in s. Rows sum to one, also far outside of the movement; Ψ_i alone comes
    with ``normalised=False``.

    >>> discrete_basis(torch.arange(70.0), kernels=20, duration=69).shape
    torch.Size([70, 20])
    """
    _check_kernels(kernels)
    at = torch.linspace(0, duration, kernels, dtype=time.dtype, device=time.device)
    centre = phase(at, duration=duration)
    gap = (centre[:-1] - centre[1:]) * WIDTH
    width = torch.cat([gap, gap[-1:]])
    s = phase(time, duration=duration)
    exponent = -0.5 * ((s[..., None] - centre) / width).square()
    return _normalised(exponent) if normalised else exponent.exp()


def rhythmic_basis(
    time: Float[Tensor, "*frame"],
    *,
    kernels: int,
    period: float | Tensor,
    offset: float | Tensor = 0.0,
    normalised: bool = True,
) -> Float[Tensor, "*time kernel"]:
    """Ψ_i(s)/ΣΨ of the rhythmic system (57), (58); s grows by 2π in a ``period``.

    Centres are equally spaced on the circle, h = 1/(0.55 distance)²; ``offset`` in rad is
    the phase at time 0; both may be tensors that broadcast with ``time``; Ψ_i alone comes with
    ``normalised=False``.

    >>> rows = rhythmic_basis(torch.tensor([0.0, 30.0, 60.0]), kernels=8, period=30)
    >>> bool((rows[0] - rows[2]).abs().max() < 1e-5)
    True
    """
    _check_kernels(kernels)
    gap = 2 * math.pi / kernels
    centre = gap * torch.arange(kernels, dtype=time.dtype, device=time.device)
    s = 2 * math.pi * time / period + offset
    exponent = (torch.cos(s[..., None] - centre) - 1) / (WIDTH * gap) ** 2
    return _normalised(exponent) if normalised else exponent.exp()


def _check_kernels(kernels: int) -> None:
    if kernels < 2:
        raise ValueError(f"kernels must be at least 2; got {kernels}")


def _normalised(exponent: Float[Tensor, "*time kernel"]) -> Float[Tensor, "*time kernel"]:
    # the largest exponent is taken out; several times faster than torch.softmax in float64
    psi = (exponent - exponent.amax(dim=-1, keepdim=True)).exp()
    return psi / psi.sum(dim=-1, keepdim=True)


def _lagged(forced: Float[Tensor, "time 2"]) -> Float[Tensor, "2 time time"]:
    later = torch.cat([forced.new_zeros(1, 2), forced[:-1]])
    return torch.stack([_toeplitz(later[:, 0]), _toeplitz(later[:, 1])])


def _toeplitz(response: Float[Tensor, " time"]) -> Float[Tensor, "time time"]:
    steps = len(response)
    padded = torch.cat([response.new_zeros(steps - 1), response])
    return padded.unfold(0, steps, 1).flip(1)
