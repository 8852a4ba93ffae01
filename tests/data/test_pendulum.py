"""The simulated pendulum: energy, frequency, roll-outs and images."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from zoo.datasets.pendulum import Pendulum, load, load_images, render


def roll(pendulum: Pendulum, state: torch.Tensor, steps: int) -> torch.Tensor:
    states = [state]
    for _ in range(steps):
        states.append(pendulum.advance(states[-1], torch.zeros(len(state)).double()))
    return torch.stack(states, 1)


def test_energy_is_kept_without_friction_and_lost_with_it() -> None:
    start = torch.tensor([[2.0, 0.0], [0.5, 1.0], [math.pi, 8.0]], dtype=torch.float64)
    free, damped = Pendulum(friction=0.0), Pendulum()
    energy = free.energy(roll(free, start, 100))
    # Fourth-order steps of 5 ms at 10 rad/s: (0.05)⁵/120 a step, 1000 steps: some 3e-6.
    torch.testing.assert_close(energy, energy[:, :1].expand_as(energy), rtol=1e-5, atol=1e-4)
    assert bool((damped.energy(roll(damped, start, 100)).diff(dim=1) <= 0).all())


def test_small_swings_have_the_frequency_of_a_point_mass() -> None:
    pendulum = Pendulum(friction=0.0)
    start = torch.tensor([[math.pi + 1e-3, 0.0]], dtype=torch.float64)
    path = roll(pendulum, start, 200)[0, :, 0] - math.pi
    time = pendulum.step * torch.arange(201, dtype=torch.float64)
    expected = 1e-3 * torch.cos(math.sqrt(9.81 / 0.5) * time)
    torch.testing.assert_close(path, expected, rtol=0, atol=1e-8)


def test_friction_damps_small_swings_at_the_rate_of_the_closed_form() -> None:
    pendulum = Pendulum()
    start = torch.tensor([[math.pi + 1e-3, 0.0]], dtype=torch.float64)
    path = roll(pendulum, start, 200)[0, :, 0] - math.pi
    time = pendulum.step * torch.arange(201, dtype=torch.float64)
    decay = 0.25 / (2 * pendulum.inertia)
    omega = math.sqrt(9.81 / 0.5 - decay**2)
    swing = torch.cos(omega * time) + decay / omega * torch.sin(omega * time)
    torch.testing.assert_close(path, 1e-3 * torch.exp(-decay * time) * swing, rtol=0, atol=1e-8)


def test_the_largest_torque_holds_the_rod_at_the_angle_of_the_statics() -> None:
    angle = math.pi - math.asin(30 / (10 * 9.81 * 0.5))
    state = torch.tensor([[angle, 0.0]], dtype=torch.float64)
    held = Pendulum().advance(state, torch.tensor([-30.0], dtype=torch.float64))
    torch.testing.assert_close(held, state, rtol=0, atol=1e-12)


def test_roll_outs() -> None:
    data = load(rollouts=400)
    assert data.rate == 20
    assert data.provenance == "simulated"
    assert float(data.controls.abs().max()) <= 30
    # Lengths are 1 + Geometric(0.02): mean 51, sd 49.5.
    assert abs(float(data.lengths.double().mean()) - 51) < 6 * 49.5 / math.sqrt(400)
    first = data.values[:, 0]
    assert float((first[:, 0] - math.pi).abs().max()) < 0.6
    assert bool((first[:, 1] == 0).all())
    assert torch.equal(load(rollouts=5).values, load(rollouts=5).values)
    assert not torch.equal(load(rollouts=5).lengths, load(rollouts=5, seed=1).lengths)


def test_the_disturbance_has_the_standard_deviation_of_the_thesis() -> None:
    data = load(rollouts=100)
    pendulum = Pendulum()
    now, then = data.values[:, :-1], data.values[:, 1:]
    quiet = pendulum.advance(now, data.controls[:, :-1, 0])[..., 1]
    kick = pendulum.advance(now, data.controls[:, :-1, 0] + 1)[..., 1] - quiet
    disturbance = ((then[..., 1] - quiet) / kick)[data.mask[:, 1:, 1]]
    count = disturbance.numel()
    assert abs(float(disturbance.std()) - 4.5) < 6 * 4.5 / math.sqrt(2 * count)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.5])
def test_images_equal_a_finely_drawn_and_filtered_rod(angle: float) -> None:
    fine, view = 480, 1.2
    cell = view / fine
    drawn = np.zeros((2 * fine, 2 * fine))
    for u in (np.arange(2000) + 0.5) / 2000 * 0.5:
        column = fine + math.floor(u * math.sin(angle) / cell)
        row = fine - 1 - math.floor(u * math.cos(angle) / cell)
        drawn[row, column] += 0.5 / 2000
    sigma = 0.2 * view
    blurred = gaussian_filter(drawn, sigma / cell, mode="constant") / cell**2
    window = blurred[fine // 2 : 3 * fine // 2, fine // 2 : 3 * fine // 2]
    expected = window.reshape(20, 24, 20, 24).mean((1, 3)) * sigma * math.sqrt(2 * math.pi)
    image = render(torch.tensor(angle, dtype=torch.float64)).numpy()
    # A pixel averages over 6 cm and the drawing rounds to 2.5 mm: some 1 % of the brightness.
    np.testing.assert_allclose(image, expected, rtol=0, atol=0.01)


def test_image_features_are_images_and_their_differences_in_order() -> None:
    data, states = load_images(rollouts=4), load(rollouts=4)
    assert torch.equal(data.lengths, states.lengths)
    assert torch.equal(data.controls, states.controls)
    n = int(data.lengths[0])
    images = render(states.values[0, :n, 0])
    torch.testing.assert_close(data.values[0, :n, :400].unflatten(1, (20, 20)), images)
    torch.testing.assert_close(data.values[0, 1:n, 400:], images.diff(dim=0).flatten(1))
    assert float(data.values[:, 0, 400:].abs().max()) == 0


def test_no_roll_out_is_refused() -> None:
    with pytest.raises(ValueError, match="rollouts must be at least 1; got 0"):
        load(rollouts=0)
