"""What primitives are learned from: first and last states of movements, the evidence of weights."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch.distributions import MultivariateNormal

from zoo.models.primitives.alignment import anchors
from zoo.movement.conjugate_regression import conjugate_weights
from zoo.movement.rollout import Primitive
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


def test_the_evidence_of_weights_is_the_density_of_the_dense_gaussian() -> None:
    generator = torch.Generator().manual_seed(0)
    frames, kernels, sequences = 12, 3, 4
    design = torch.randn(frames, kernels, generator=generator).double()
    w = torch.randn(sequences, 2, kernels, generator=generator).double()
    noise = torch.randn(sequences, 2, frames, generator=generator).double()
    x = w @ design.T + 0.3 * noise
    found = conjugate_weights(
        (design.T @ design)[None, None],
        x @ design,
        x.square().sum(-1),
        torch.full((sequences, 1), float(frames)).double(),
        torch.zeros(sequences, 1).double(),
    )
    for c in range(2):
        covariance = found.prior[c] * design @ design.T
        covariance = covariance + found.noise[c] * torch.eye(frames).double()
        law = MultivariateNormal(torch.zeros(frames).double(), covariance)
        torch.testing.assert_close(found.log_evidence[c], law.log_prob(x[:, c]).sum())
