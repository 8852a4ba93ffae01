"""What primitives are learned from: first and last states of movements, the evidence of weights."""

from __future__ import annotations

from itertools import product
from typing import Literal

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from zoo.models.primitives.alignment import anchors
from zoo.models.primitives.conjugate_regression import conjugate_weights
from zoo.models.primitives.rollout import Primitive
from zoo.movement.timing import Timing


@pytest.mark.parametrize("kind", ["discrete", "rhythmic"])
def test_the_goal_is_the_last_observed_frame_or_the_mean_of_a_rhythm(
    kind: Literal["discrete", "rhythmic"],
) -> None:
    primitive = Primitive(kind=kind, kernels=5, alpha=25.0, beta=6.25, gated=False)
    x = torch.tensor([[0.0, 0.0], [1.0, 2.0], [5.0, 3.0], [3.0, 0.0]]).double()
    seen = torch.tensor([[True, False], [True, True], [True, True], [True, False]])
    found = anchors(primitive, x, seen, Timing(3.0))
    goal = [3.0, 3.0] if kind == "discrete" else [2.25, 2.5]
    expected = torch.tensor([[0.0, 3.0, goal[0]], [2.0, 3.0, goal[1]]]).double()
    torch.testing.assert_close(found, expected)


def test_the_variances_of_weights_have_the_highest_density_of_the_dense_gaussian() -> None:
    generator = torch.Generator().manual_seed(0)
    frames, kernels, sequences = 12, 3, 4
    design = torch.randn(frames, kernels, generator=generator).double()
    w = torch.randn(sequences, 2, kernels, generator=generator).double()
    noise = torch.randn(sequences, 2, frames, generator=generator).double()
    x, gram = w @ design.T + 0.3 * noise, design.T @ design
    count = torch.full((sequences, 1), float(frames)).double()
    found = conjugate_weights(gram[None, None], x @ design, x.square().sum(-1), count)
    ratio = (found.covariance[0].inverse() - gram).diagonal(dim1=-2, dim2=-1).mean(-1)

    def density(c: int, σ2: Tensor, λ: Tensor) -> float:
        covariance = σ2 * (design @ design.T / λ + torch.eye(frames).double())
        law = MultivariateNormal(torch.zeros(frames).double(), covariance)
        return float(law.log_prob(x[:, c]).sum())

    for c in range(2):
        σ2, λ = found.noise[c], ratio[c]
        others = [density(c, σ2 * f, λ * g) for f, g in product((0.8, 1, 1.25), (0.6, 1, 1.6))]
        assert density(c, σ2, λ) == max(others)
        mean = torch.linalg.solve(gram + λ * torch.eye(kernels).double(), (x @ design)[:, c].T)
        torch.testing.assert_close(found.mean[:, c], mean.T)
