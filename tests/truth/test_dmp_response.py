"""The linear response and the bases of dynamic movement primitives, by other roads."""

from __future__ import annotations

import math

import pytest
import torch

from zoo.movement.response import (
    Response,
    Transformation,
    discrete_basis,
    input_vector,
    phase,
    rhythmic_basis,
    transition_matrix,
)

SYSTEM = Transformation(alpha=20.0, beta=4.0, tau=1.3, dt=0.013)


def loop(system, position, velocity, goal, forcing):
    """(74) step by step, with τ²ÿ as Ijspeert et al. (2013) have it."""
    z, rate = [position], [velocity]
    for t in range(forcing.shape[1]):
        at = goal if goal.ndim == 2 else goal[:, t]
        pull = system.alpha * (system.beta * (at - z[-1]) - system.tau * rate[-1])
        rate.append(rate[-1] + system.dt * (pull + forcing[:, t]) / system.tau**2)
        z.append(z[-1] + system.dt * rate[-1])
    return torch.stack(z, 1), torch.stack(rate, 1)


def draw(steps, *, moving_goal):
    generator = torch.Generator().manual_seed(steps)
    shapes = [(3, 2), (3, 2), (3, steps - 1, 2) if moving_goal else (3, 2), (3, steps - 1, 2)]
    return [
        torch.randn(s, generator=generator, dtype=torch.float64, requires_grad=True) for s in shapes
    ]


@pytest.mark.parametrize("moving_goal", [False, True])
@pytest.mark.parametrize("steps", [2, 10, 70, 300, 301, 385, 500])
def test_response_equals_the_loop(steps, moving_goal):
    inputs = draw(steps, moving_goal=moving_goal)
    expected = loop(SYSTEM, *inputs)
    found = Response.of(SYSTEM, steps, torch.float64, "cpu").states(*inputs)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("steps", [10, 330])
def test_gradients_equal_those_of_the_loop(steps):
    inputs = draw(steps, moving_goal=False)
    response = Response.of(SYSTEM, steps, torch.float64, "cpu")
    gradients = []
    for z, rate in (response.states(*inputs), loop(SYSTEM, *inputs)):
        gradients.append(torch.autograd.grad((z.sin() + rate.square()).sum(), inputs))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


def test_single_precision_stays_within_its_rounding():
    inputs = [x.detach() for x in draw(70, moving_goal=False)]
    exact = loop(SYSTEM, *inputs)[0]
    z = Response.of(SYSTEM, 70, torch.float32, "cpu").states(*(x.float() for x in inputs))[0]
    bound = 70 * torch.finfo(torch.float32).eps * exact.abs().max()
    assert (z.double() - exact).abs().max() < bound


def critical(time, start, rate, goal, omega):
    """Analytic solution of the critically damped system at zero forcing."""
    a, b = start - goal, rate + omega * (start - goal)
    return goal + (a + b * time) * torch.exp(-omega * time)


def free_error(steps):
    system = Transformation(alpha=20.0, beta=5.0, tau=2.0, dt=2.0 / steps)
    start, goal = torch.tensor([[1.0]], dtype=torch.float64), torch.tensor([[-0.5]]).double()
    time = torch.arange(steps + 1, dtype=torch.float64) * system.dt
    exact = critical(time, 1.0, 0.3, -0.5, 10.0 / system.tau)
    zero = torch.zeros(1, steps, 1, dtype=torch.float64)
    found = Response.of(system, steps + 1).states(start, 0.3 * start, goal, zero)[0][0, :, 0]
    return (found - exact).abs().max()


def test_free_motion_converges_to_the_analytic_solution():
    coarse, fine = free_error(200), free_error(400)
    assert math.log2(coarse / fine) == pytest.approx(1, abs=0.15)


def test_free_motion_is_the_matrix_power():
    response = Response.of(SYSTEM, 400, torch.float64, "cpu")
    start = torch.tensor([[0.7, 0.0], [0.0, -1.1]], dtype=torch.float64)
    path = response.product(start, torch.zeros(399, 2, dtype=torch.float64))
    power = torch.linalg.matrix_power(transition_matrix(SYSTEM), 399)
    torch.testing.assert_close(path[:, -1], power @ start, rtol=1e-12, atol=1e-14)


def test_thesis_transition_matrix():
    a, b, dt = 25.0, 6.25, 0.01
    printed = torch.tensor([[-dt * a * b, -dt * a + 1], [-a * b, -a]], dtype=torch.float64) * dt
    system = Transformation(alpha=a, beta=b, tau=1.0, dt=dt)
    torch.testing.assert_close(
        transition_matrix(system), printed + torch.eye(2, dtype=torch.float64)
    )
    torch.testing.assert_close(input_vector(system), torch.tensor([dt * dt, dt]).double())


def test_phase_solves_the_canonical_system():
    time = torch.linspace(0, 3, 50, dtype=torch.float64, requires_grad=True)
    s = phase(time, duration=3.0, decay=4.0)
    (rate,) = torch.autograd.grad(s.sum(), time)
    torch.testing.assert_close(3.0 * rate, -4.0 * s)


def test_bases_by_their_formulas():
    time = torch.arange(30, dtype=torch.float64)
    s = torch.exp(-math.log(100) * time / 29)
    centre = torch.exp(-math.log(100) * torch.linspace(0, 1, 7, dtype=torch.float64))
    sigma = 0.55 * (centre[:-1] - centre[1:])[[0, 1, 2, 3, 4, 5, 5]]
    psi = torch.exp(-((s[:, None] - centre) ** 2) / (2 * sigma**2))
    torch.testing.assert_close(
        discrete_basis(time, kernels=7, duration=29), psi / psi.sum(1, keepdim=True)
    )
    angle = 2 * math.pi * time / 12 + 0.4
    centre = 2 * math.pi * torch.arange(6).double() / 6
    psi = torch.exp((torch.cos(angle[:, None] - centre) - 1) / (0.55 * 2 * math.pi / 6) ** 2)
    found = rhythmic_basis(time, kernels=6, period=12, offset=0.4)
    torch.testing.assert_close(found, psi / psi.sum(1, keepdim=True))


def test_basis_far_after_the_movement_is_finite():
    rows = discrete_basis(torch.tensor([1e4]), kernels=50, duration=69)
    torch.testing.assert_close(rows.sum(-1), torch.ones(1))


def test_errors_say_what_is_wrong():
    with pytest.raises(ValueError, match="tau must be positive; got 0"):
        Transformation(tau=0.0)
    with pytest.raises(ValueError, match="steps must be at least 2; got 1"):
        Response.of(SYSTEM, 1)
    still = torch.zeros(1, 1, dtype=torch.float64)
    with pytest.raises(ValueError, match="forcing has 3 steps; this response needs 9"):
        Response.of(SYSTEM, 10).states(still, still, still, still.expand(1, 3, 1))
    with pytest.raises(ValueError, match="kernels must be at least 2; got 1"):
        discrete_basis(torch.arange(3.0), kernels=1, duration=2)
