"""The path noise in blocks against the dense Gaussian of all its frames."""

from __future__ import annotations

import pytest
import torch

from zoo.models.primitives.kalman import PathNoise, Smoother
from zoo.movement.response import Transformation

RATIOS = torch.tensor([[0.01], [1.0], [100.0]], dtype=torch.float64)


def noise(frames):
    return PathNoise(Transformation(25.0, 6.25, 1.0, 1 / max(frames - 1, 40)), frames)


def dense(path, ratio, seen):
    response = path.respond(torch.eye(path.frames - 1, dtype=torch.float64))
    prior = response @ response.mT
    known = prior[seen][:, seen] + ratio * torch.eye(int(seen.sum()), dtype=torch.float64)
    return prior, prior[:, seen], torch.linalg.cholesky(known)


@pytest.mark.parametrize("frames", [2, 3, 70, 151, 400])
def test_blocks_whiten_and_smooth_as_the_dense_gaussian_does(frames):
    path, generator = noise(frames), torch.Generator().manual_seed(frames)
    seen = torch.rand(2, frames, generator=generator) < 0.6
    seen[1], seen[:, 0] = True, True
    found = Smoother.of(path, RATIOS, seen)
    x = torch.randn(2, frames, 3, generator=generator, dtype=torch.float64) * seen[..., None]
    white, follow = found.whiten(x), found.follow(x)
    for i, ratio in enumerate(RATIOS[:, 0]):
        for j, s in enumerate(seen):
            prior, cross, root = dense(path, ratio, s)
            error = torch.linalg.solve_triangular(root, x[j, s], upper=False)
            torch.testing.assert_close(white[i, j][s], error, rtol=1e-9, atol=1e-9)
            smooth = cross @ torch.cholesky_solve(x[j, s], root)
            torch.testing.assert_close(follow[i, j], smooth, rtol=1e-9, atol=1e-9)
            variance = (prior - cross @ torch.cholesky_solve(cross.mT, root)).diagonal()
            torch.testing.assert_close(found.variance[i, j], variance, rtol=1e-9, atol=1e-9)
            volume = root.diagonal().log().sum()
            torch.testing.assert_close(found.log_root[i, j].sum(), volume, rtol=1e-9, atol=1e-9)


def test_errors_of_the_first_frames_know_nothing_of_the_later_ones():
    path, x = noise(130), torch.randn(1, 130, 2, dtype=torch.float64)
    found = Smoother.of(path, RATIOS[:1, 0], torch.ones(1, 130, dtype=torch.bool))
    later = torch.where(torch.arange(130)[:, None] < 60, x, 9.0)
    assert torch.equal(found.whiten(x)[:, :60], found.whiten(later)[:, :60])


def test_variance_without_observations_is_that_of_the_response():
    response = noise(80).respond(torch.eye(79, dtype=torch.float64))
    torch.testing.assert_close(noise(80).variance, response.square().sum(1))
