"""Jacobians of a decoder against finite differences, and the prior that makes it flat."""

from __future__ import annotations

import pytest
import torch
from support import movements

import zoo
from zoo.models.filters.latent_dmp import Config, LatentDmp
from zoo.nn.metric import jacobians, pullback_metric, sensitivity
from zoo.nn.mlp import mlp


def test_jacobians_are_the_finite_differences() -> None:
    """Central differences in float64 of a tanh network, and the norm from them on a grid."""
    torch.manual_seed(0)
    network, h = mlp([2, 20, 7], "tanh").double(), 1e-5
    z = torch.randn(4, 3, 2, dtype=torch.float64)
    steps = h * torch.eye(2, dtype=torch.float64)
    with torch.no_grad():
        columns = [(network(z + s) - network(z - s)) / (2 * h) for s in steps]
    J = torch.stack(columns, -1)
    torch.testing.assert_close(jacobians(network, z[0]), J[0], rtol=1e-8, atol=1e-8)
    metric = pullback_metric(network, z[0])
    torch.testing.assert_close(metric, J[0].mT @ J[0], rtol=1e-7, atol=1e-8)
    norms = J.square().sum((-1, -2)).sqrt()
    torch.testing.assert_close(sensitivity(network, z), norms, rtol=1e-8, atol=1e-8)


def decoder(matrix: torch.Tensor) -> LatentDmp:
    """A model whose decoder is linear."""
    model = LatentDmp(movements().layout, Config(latent_dim=2, activation="tanh", flatness=1.5))
    model.decoder = torch.nn.Linear(2, len(matrix), bias=False)
    model.decoder.weight = torch.nn.Parameter(matrix)
    return model


def test_a_decoder_as_sensitive_everywhere_costs_nothing() -> None:
    """A linear one has the same Jacobian at every point; a bent one has not."""
    torch.manual_seed(2)
    path = torch.randn(64, 4, 2)
    flat = decoder(torch.randn(7, 2)).flatness_prior(path)
    torch.testing.assert_close(flat, torch.zeros(64), atol=1e-9, rtol=0)
    bent = decoder(torch.randn(7, 2))
    bent.decoder = torch.nn.Sequential(bent.decoder, torch.nn.Softplus())
    points = bent.flatness_prior(path).detach()
    assert float(points.max()) <= 0
    assert float(points.mean()) < -1e-3


def test_flat_training_evens_the_decoder_out() -> None:
    """The spread of ‖dx/dz‖ over the latents of the data is smaller with the prior."""
    spreads = []
    for η in (0.0, 10.0):
        settings = {"latent_dim": 2, "epochs": 150, "activation": "softplus", "flatness": η}
        run = zoo.fit(zoo.create("vae-dmp", movements(), seed=0, **settings), movements())
        latents = run.represent(movements(), draws=1).mean.flatten(0, 1)
        norms = sensitivity(run.model.decoder, latents)
        spreads.append(float(norms.max() / norms.min()))
    assert spreads[1] < spreads[0]


@pytest.mark.parametrize("wrong", [{"flatness": -1.0}, {"flatness": 1.0, "activation": "relu"}])
def test_a_flatness_without_a_meaning_is_refused(wrong: dict) -> None:
    """A kinked decoder has no curvature to correct."""
    with pytest.raises(ValueError, match="flatness"):
        Config(**wrong)
