"""Learning of a forcing term from a demonstration: target forces (59) and their regression."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from zoo.movement.response import Response, Transformation, input_vector, transition_matrix

__all__ = [
    "locally_weighted_regression",
    "stationary_variance",
    "target_force",
    "target_known",
    "trajectory_matrix",
]


def target_force(
    position: Float[Tensor, "*batch time channel"],
    goal: Float[Tensor, "*batch channel"],
    system: Transformation,
) -> tuple[Float[Tensor, "*batch channel"], Float[Tensor, "*batch time_minus_1 channel"]]:
    """First velocity and the force (59) of every step that reproduce a demonstration exactly.

    The derivatives are those of semi-implicit Euler steps, so that the roll-out of the result is
    the demonstration; the first velocity is that of the first step.

    >>> x = torch.rand(1, 40, 2, dtype=torch.float64)
    >>> system = Transformation(dt=0.02)
    >>> velocity, force = target_force(x, x[:, -1], system)
    >>> z, _ = Response.of(system, 40).states(x[:, 0], velocity, x[:, -1], force)
    >>> bool((z - x).abs().max() < 1e-12)
    True
    """
    step = position.diff(dim=-2) / system.dt
    velocity = torch.cat([step[..., :1, :], step], dim=-2)
    acceleration = velocity.diff(dim=-2) / system.dt
    spring = system.stiffness * (goal[..., None, :] - position[..., :-1, :])
    damping = system.alpha * system.tau * velocity[..., :-1, :]
    return velocity[..., 0, :], system.tau**2 * acceleration - spring + damping


def target_known(seen: Bool[Tensor, "*batch time"]) -> Bool[Tensor, "*batch time_minus_1"]:
    """Steps whose target force needs no frame that is missing.

    >>> target_known(torch.tensor([True, True, False, True, True, True])).tolist()
    [True, False, False, False, True]
    """
    before = torch.cat([seen[..., :1], seen[..., :-2]], dim=-1)
    return before & seen[..., :-1] & seen[..., 1:]


def locally_weighted_regression(
    kernels: Float[Tensor, "time kernel"],
    target: Float[Tensor, "*batch time channel"],
    *,
    scale: Float[Tensor, " time"] | None = None,
    mask: Bool[Tensor, "*batch time channel"] | None = None,
) -> Float[Tensor, "*batch kernel channel"]:
    """Weights by (61): w_i = Σ_t Ψ_i ξ f / Σ_t Ψ_i ξ²; a kernel that saw nothing has weight 0.

    ``kernels`` are the Ψ_i(t) without normalisation, ``scale`` is ξ, ``mask`` the rows to use.
    """
    ξ = torch.ones_like(kernels[:, 0]) if scale is None else scale
    seen = torch.ones_like(target) if mask is None else mask.to(target.dtype)
    above = (kernels * ξ[:, None]).mT @ (target * seen)
    below = (kernels * ξ[:, None].square()).mT @ seen
    return torch.where(below > 0, above / below.clamp_min(torch.finfo(below.dtype).tiny), 0.0)


def trajectory_matrix(
    response: Response,
    basis: Float[Tensor, "time_minus_1 kernel"],
    *,
    weight: Float[Tensor, " time_minus_1"] | None = None,
    begin: bool = True,
) -> Float[Tensor, "time parameter"]:
    """R with y = R (y₁, ẏ₁, g, w₁ … w_N): the whole roll-out as one matrix.

    ``weight`` is the share η of goal and weights at every step (89); without ``begin`` the first
    state does not count.
    """
    start = basis.new_zeros(2, 3 + basis.shape[1])
    start[0, 0] = start[1, 1] = float(begin)
    goal = basis.new_full((len(basis), 1), response.system.stiffness)
    force = torch.cat([basis.new_zeros(len(basis), 2), goal, basis], dim=1)
    share = 1.0 if weight is None else weight[:, None]
    return response.product(start, force * share)[0]


def stationary_variance(system: Transformation) -> float:
    """Variance of the position in the long run under white forces of unit variance."""
    a, b = transition_matrix(system), input_vector(system)
    eye = torch.eye(4, dtype=a.dtype)
    return float(torch.linalg.solve(eye - torch.kron(a, a), torch.outer(b, b).flatten())[0])
