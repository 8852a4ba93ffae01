"""Laplace's approximation: exact where the decoder is linear, the mode where it is not."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import minimize

from zoo.inference.laplace import laplace
from zoo.nn.mlp import mlp


def test_a_linear_decoder_gives_the_exact_posterior() -> None:
    """Mean and covariance of Bayesian linear regression, in float64."""
    torch.manual_seed(0)
    W, x = torch.randn(6, 2, dtype=torch.float64), torch.randn(4, 6, dtype=torch.float64)
    σ = torch.rand(6, dtype=torch.float64) + 0.1
    found = laplace(lambda z: z @ W.T, torch.randn(4, 2, dtype=torch.float64), x, σ)
    precision = torch.eye(2, dtype=torch.float64) + W.T @ torch.diag(σ**-2) @ W
    mean = torch.linalg.solve(precision, (x / σ**2 @ W).T).T
    torch.testing.assert_close(found.mean, mean, rtol=1e-8, atol=1e-8)
    expected = torch.linalg.inv(precision).expand(4, 2, 2)
    torch.testing.assert_close(found.covariance_matrix, expected, rtol=1e-8, atol=1e-8)


def test_a_network_s_mode_is_that_of_a_general_optimiser() -> None:
    """BFGS of scipy from the same start finds no lower minus log joint."""
    torch.manual_seed(1)
    network = mlp([2, 16, 5], "tanh").double()
    start, x = torch.zeros(3, 2, dtype=torch.float64), torch.randn(3, 5, dtype=torch.float64)
    σ = torch.full((5,), 0.3, dtype=torch.float64)

    def loss(z: torch.Tensor, row: int) -> float:
        with torch.no_grad():
            apart = (x[row] - network(z)) / σ
        return float((apart.square().sum() + z.square().sum()) / 2)

    with torch.no_grad():
        found = laplace(network, start, x, σ)
    for row in range(3):
        other = minimize(lambda z, row=row: loss(torch.from_numpy(z), row), start[row].numpy())
        assert loss(found.mean[row], row) <= other.fun + 1e-6 * abs(other.fun)


def test_entries_of_infinite_spread_are_not_there() -> None:
    """A different part of every frame is missing; each has the posterior of what is left of it."""
    torch.manual_seed(2)
    W, x = torch.randn(6, 2, dtype=torch.float64), torch.randn(4, 6, dtype=torch.float64)
    seen = torch.rand(4, 6) > 0.4
    σ = torch.full((4, 6), 0.5, dtype=torch.float64).masked_fill(~seen, torch.inf)
    begin = torch.zeros(4, 2, dtype=torch.float64)
    found = laplace(lambda z: z @ W.T, begin, x, σ)
    for row, kept in enumerate(seen):
        alone = laplace(
            lambda z, k=kept: z @ W[k].T, begin[:1], x[row : row + 1, kept], σ[row, kept]
        )
        torch.testing.assert_close(found.mean[row], alone.mean[0], rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(
            found.covariance_matrix[row], alone.covariance_matrix[0], rtol=1e-8, atol=1e-8
        )


def test_the_best_mode_is_taken_unless_the_nearest_is_asked_for() -> None:
    """z² = 4 has modes near −2 and 2, of which the tilt prefers the one that is farther away."""

    def decode(z: torch.Tensor) -> torch.Tensor:
        return torch.cat([z.square(), 0.1 * z], -1)

    start, x = torch.full((1, 1), -1.5), torch.tensor([[4.0, 0.2]])
    near, best = (laplace(decode, start, x, torch.full((2,), 0.1), near=n) for n in (True, False))
    assert float(near.mean) < -1.5
    assert float(best.mean) > 1.5


@pytest.mark.parametrize("unit", [1.0, 57.3], ids=["radians", "degrees"])
def test_float32_gives_the_covariance_of_independent_directions(unit: float) -> None:
    """JᵀJ is diagonal, of 1e6 and more: what float32 leaves beside it is not symmetric."""
    torch.manual_seed(0)
    W = 10 * unit * torch.linalg.qr(torch.randn(62, 3))[0]
    σ, z = torch.full((62,), 0.01), torch.randn(30, 3)
    found = laplace(lambda z: z @ W.T, z, z @ W.T, σ, restarts=2)
    precision = 1 + (10 * unit / 0.01) ** 2
    assert found.mean.dtype == found.covariance_matrix.dtype == torch.float32
    expected = torch.eye(3).expand(30, 3, 3)
    torch.testing.assert_close(precision * found.covariance_matrix, expected, atol=1e-4, rtol=1e-4)
