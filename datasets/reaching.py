"""Simulated reaching of twelve operators who guide the KR5 arm to goals in a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.datasets.robot_arm import FRAMES, HEIGHT, START, follow_path, joint_sequences, minimum_jerk

__all__ = ["load"]

OPERATORS = 12
PLACES = 30


@dataclass(frozen=True, kw_only=True)
class Style:
    """How each reach is made: ``onset`` and ``duration`` as fractions of the recording.

    ``skew`` above 1 puts the peak speed late; ``bow`` is the sideways bulge of the path in
    fractions of its length; ``offset`` displaces the start, in m.
    """

    onset: Float[Tensor, " reach"]
    duration: Float[Tensor, " reach"]
    skew: Float[Tensor, " reach"]
    bow: Float[Tensor, " reach"]
    offset: Float[Tensor, "reach 2"]


def load(*, movements: int = 120, noise: float = 0.004, seed: int = 0) -> Sequences:
    """Reaches to 30 goals by 12 simulated operators: 76 frames of six joint angles in rad at 25 Hz.

    Every operator has an own onset, speed profile, bow and place of the start, and varies around
    them from reach to reach; the goals are drawn uniformly from x in [0.4, 0.95], y in [0, 0.85] m,
    0.6 to 1.1 m from the base, at z = 0.3 m. The joints carry smooth noise (Gaussian,
    correlated over some 4 frames) of ``noise`` rad. Columns: ``goal``, ``trial``, ``operator``.

    >>> data = load(movements=4)
    >>> data.values.shape, data.groups["operator"]
    (torch.Size([4, 76, 6]), ('operator_00', 'operator_01', 'operator_02', 'operator_03'))
    """
    if movements < 1:
        raise ValueError(f"movements must be at least 1; got {movements}")
    if noise < 0:
        raise ValueError(f"noise must not be negative, in rad; got {noise}")
    rng = np.random.default_rng(seed)
    places = _places(rng)
    operator = np.arange(movements) % OPERATORS
    place = np.concatenate([rng.permutation(PLACES) for _ in range(0, movements, PLACES)])
    place = place[:movements]
    style = _styles(rng, operator)
    angles = follow_path(_paths(style, places[torch.from_numpy(place)]))
    groups = {
        "goal": [f"goal_{g:02d}" for g in place],
        "trial": [f"trial_{i:03d}" for i in range(movements)],
        "operator": [f"operator_{o:02d}" for o in operator],
    }
    return joint_sequences(
        angles + noise * _smooth_noise(rng, movements), groups, "robot-arm/reaching"
    )


def _places(rng: Generator) -> Float[Tensor, "place 2"]:
    drawn = rng.uniform((0.4, 0.0), (0.95, 0.85), size=(20 * PLACES, 2))
    distance = np.linalg.norm(drawn, axis=1)
    return torch.from_numpy(drawn[(distance > 0.6) & (distance < 1.1)][:PLACES])


def _styles(rng: Generator, operator: np.ndarray) -> Style:
    def vary(between: float, within: float) -> Tensor:
        own = rng.normal(0, between, OPERATORS)[operator]
        return torch.from_numpy(own + rng.normal(0, within, len(operator)))

    return Style(
        onset=(0.04 + vary(0.02, 0.01)).clamp(0, 0.1),
        duration=(0.82 + vary(0.05, 0.02)).clamp(0.65, 0.9),
        skew=vary(0.12, 0.05).exp(),
        bow=vary(0.04, 0.01),
        offset=torch.stack([vary(0.02, 0.01), vary(0.02, 0.01)], -1),
    )


def _paths(style: Style, goal: Float[Tensor, "reach 2"]) -> Float[Tensor, "reach time 3"]:
    time = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    phase = ((time - style.onset[:, None]) / style.duration[:, None]).clamp(0, 1)
    s = minimum_jerk(phase ** style.skew[:, None])[..., None]
    start = torch.tensor(START, dtype=torch.float64) + style.offset
    along = goal - start
    across = torch.stack([-along[:, 1], along[:, 0]], -1) * style.bow[:, None]
    path = start[:, None] + s * along[:, None] + 4 * s * (1 - s) * across[:, None]
    return torch.cat([path, torch.full_like(path[..., :1], HEIGHT)], -1)


def _smooth_noise(rng: Generator, movements: int) -> Float[Tensor, "reach time joint"]:
    lag = np.arange(-12, 13)
    kernel = np.exp(-0.5 * (lag / 4) ** 2)
    kernel /= np.linalg.norm(kernel)
    white = rng.normal(size=(movements, 6, FRAMES + len(lag) - 1))
    smooth = np.lib.stride_tricks.sliding_window_view(white, len(lag), axis=-1) @ kernel
    return torch.from_numpy(smooth.swapaxes(1, 2).copy())
