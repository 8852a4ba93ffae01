"""Other goals and other tempos by another road: the ratio of the ways, the spectrum of cycles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from zoo.models.filters.latent_dmp import Config
from zoo.models.filters.vae_dmp import VaeDmp
from zoo.models.filters.vae_dmp_rhythmic import Config as RhythmicConfig
from zoo.models.filters.vae_dmp_rhythmic import RhythmicVaeDmp
from zoo.movement.plan import Latents, Plan
from zoo.types import Layout

LAYOUT = Layout(kind="sequences", channels=("a", "b"), units=("", ""), rate=30.0, frames=24)
PERIOD = 20.0


@pytest.mark.parametrize("factor", [0.5, 2.0, 3.0, -1.0])
def test_forces_grow_with_the_way_to_the_goal(factor: float) -> None:
    """§6.2.5: w is multiplied by (g − y_0)/(g_fit − y_0), up to the slack of a way of 0."""
    model = VaeDmp(LAYOUT, Config(latent_dim=2, goal_scaling=False))
    generator = torch.Generator().manual_seed(0)
    w = torch.randn(3, 4, model.kernels, 2, generator=generator)
    position = torch.randn(3, 4, 2, generator=generator)
    way = 3 * (1 + torch.rand(3, 4, 2, generator=generator))
    found = Latents(
        plan=Plan(w=w, goal=position + way),
        w=w,
        goal=position + way,
        position=position,
        velocity=torch.zeros_like(position),
    )
    aimed = model._aimed(found, position + factor * way)
    torch.testing.assert_close(aimed.w, factor * w, rtol=5e-3, atol=1e-6)
    torch.testing.assert_close(aimed.goal, position + factor * way)


@pytest.mark.parametrize("tempo", [-0.4, 0.0, 0.4])
def test_the_tempos_of_a_new_movement_are_about_those_found(tempo: float) -> None:
    """A movement of log tempo λ repeats itself after P e^−λ frames: the spectrum's peak."""
    model = RhythmicVaeDmp(LAYOUT, RhythmicConfig(latent_dim=1, period=PERIOD / 30))
    model.prior_movements = torch.randn(3, model.kernels + 1, 1)
    model.prior_residuals = 0.1 * torch.randn(3, 24, 1)
    model.prior_observation = torch.eye(1).expand(3, 1, 1)
    model.prior_timings = torch.tensor([[0.0, tempo], [1.0, tempo], [2.0, tempo]])
    designs = model._prior(400).designs[..., 0].numpy()
    centred = designs - designs.mean(1, keepdims=True)
    spectra = np.abs(np.fft.rfft(centred, n=4000, axis=1))
    periods = 4000 / spectra[:, 1:].argmax(1).clip(1)
    assert np.median(periods) == pytest.approx(PERIOD * math.exp(-tempo), rel=0.05)
