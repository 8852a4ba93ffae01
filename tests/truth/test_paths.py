"""Latent path priors, by which vae-dmp and ae-dmp answer, asked about their own draws."""

from __future__ import annotations

import torch
from laws import check_uniform
from torch import Tensor

from zoo.models.filters.cycles import CyclePrior
from zoo.movement.gaussian_paths import stationary
from zoo.movement.paths import PathPrior

COUNT, TIME, LATENT, SEEN, DRAWS = 400, 10, 2, 4, 200
OBSERVATION = torch.tensor([[0.05, 0.02], [0.02, 0.08]], dtype=torch.float64)


def white(*shape: int, seed: int) -> Tensor:
    """Standard normal numbers of a stream of their own."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def picked(count: int, seed: int) -> Tensor:
    """One of ``count`` for every draw."""
    return torch.randint(count, (COUNT,), generator=torch.Generator().manual_seed(seed))


def observed(path: Tensor) -> Tensor:
    """Frames of paths with their noise."""
    noise = white(COUNT, TIME, LATENT, seed=11) @ torch.linalg.cholesky(OBSERVATION).mT
    return path + noise


def one_of_each(values: Tensor) -> Tensor:
    """One later coordinate of every path."""
    later = values[:, SEEN:].flatten(1)
    return later.gather(1, picked(later.shape[1], 12)[:, None])[:, 0]


def test_paths_between_those_known_are_forecast_with_the_right_bands() -> None:
    """PIT values of the mixture after four of ten frames."""
    paths = white(5, TIME, LATENT, seed=1).cumsum(1)
    spread = white(LATENT, TIME, TIME, seed=2)
    residuals = 0.3 * white(5, TIME, LATENT, seed=3)
    shape = {"bandwidth": 0.5, "shrinkage": 0.3, "process": 0.7}
    prior = PathPrior(paths, spread @ spread.mT / TIME, residuals, OBSERVATION, **shape)
    root = torch.linalg.cholesky(prior.covariance.reshape(TIME * LATENT, -1))
    moved = (white(COUNT, TIME * LATENT, seed=4) @ root.mT).unflatten(1, (TIME, LATENT))
    truth = prior.means[picked(5, 5)] + moved
    found = prior.condition(observed(truth), torch.arange(TIME) < SEEN)
    std = found.covariance.diagonal().sqrt().view(TIME, LATENT)
    below = torch.special.ndtr((truth[:, None] - found.means) / std)
    weight = found.log_weights.exp()[..., None, None]
    check_uniform(one_of_each((weight * below).sum(1)))


def test_cycles_of_unknown_timing_are_forecast_with_the_right_bands() -> None:
    """Ranks among the draws after four of ten frames."""
    designs = white(6, TIME, 3, seed=1)
    parameters = white(4, 3, LATENT, seed=2)
    residuals = 0.3 * white(4, TIME, LATENT, seed=3)
    shape = {"bandwidth": 0.6, "shrinkage": 0.2, "process": 0.5}
    prior = CyclePrior(designs, parameters, residuals, OBSERVATION, **shape)
    u = prior.means[picked(4, 4)] + white(COUNT, 3 * LATENT, seed=5) @ prior.root.mT
    cycles = designs[picked(6, 6)] @ u.unflatten(1, (3, LATENT))
    noise = prior.process * stationary(residuals).reshape(TIME * LATENT, -1)
    rest = white(COUNT, TIME * LATENT, seed=7) @ torch.linalg.cholesky(noise).mT
    truth = cycles + rest.unflatten(1, (TIME, LATENT))
    torch.manual_seed(8)
    drawn = prior.condition(observed(truth), torch.arange(TIME) < SEEN).sample(DRAWS)
    rank = (drawn < truth).sum(0) + torch.rand(truth.shape, dtype=torch.float64)
    check_uniform(one_of_each(rank / (DRAWS + 1)))


def test_kernels_and_components_together_are_as_wide_as_the_paths_known() -> None:
    """West's shrinkage: (1 − h²) S of the means and h² S of the kernels are S, whatever h."""
    paths = white(5, TIME, LATENT, seed=1).cumsum(1)
    still, spread = torch.zeros_like(paths), torch.zeros(LATENT, TIME, TIME).double()
    shape = {"bandwidth": 0.6, "shrinkage": 0.0, "process": 0.0}
    prior = PathPrior(paths, spread, still, OBSERVATION, **shape)
    covariances = [v.flatten(1).mT.cov() for v in (prior.means, paths)]
    both = covariances[0] + prior.covariance.reshape(TIME * LATENT, -1)
    torch.testing.assert_close(both, covariances[1])
