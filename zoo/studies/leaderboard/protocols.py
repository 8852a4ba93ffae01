"""The protocols that ship: forecasts of walks, a leg that was not recorded, a robot arm's goals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from zoo.datasets.cmu_mocap import load
from zoo.datasets.records import Sequences
from zoo.datasets.robot_arm import load as load_arm
from zoo.errors import UnknownNameError
from zoo.studies.leaderboard.protocol import Protocol, Published, Settings

__all__ = ["BASELINES", "FORECASTERS", "IMPUTERS", "PROTOCOLS", "protocol"]

LEG = ("rfemur", "rtibia", "rfoot", "rtoes")
FRAMES = 300
BASELINES = ("mean", "last-value", "ar", "nearest-neighbour", "kernel-ridge")
FORECASTERS = (
    *BASELINES,
    "dmp",
    "promp",
    "promp-rhythmic",
    "pca-dmp",
    "vae-dmp-rhythmic",
    "vae-dmp",
    "ae-dmp",
    "dvbf",
    "promp-rhythmic+vae-dmp-rhythmic",
)
IMPUTERS = (
    "mean",
    "ar",
    "nearest-neighbour",
    "kernel-ridge",
    "pca",
    "dmp",
    "promp",
    "promp-rhythmic",
    "ae-dmp",
    "vae",
    "vae-dmp",
    "vae-dmp-rhythmic",
    "nearest-neighbour+promp-rhythmic",
    "promp-rhythmic+vae-dmp-rhythmic",
)
_LEFT_OUT_OF_PUBLISHED = ("vae-dmp", "ae-dmp")
_AE_DMP: Mapping[str, Any] = {"epochs": 1000}
_WALK_SETTINGS: Settings = {
    "kernel-ridge": {"places": 200},
    "ae-dmp": _AE_DMP,
    "sparse-ae-dmp": _AE_DMP,
    "ae-then-dmp": _AE_DMP,
    "vae-dmp": {"window": 20, "stride": 5, "epochs": 200},
    "vae-dmp-rhythmic": {"latent_dim": 8, "epochs": 200},
    "dvbf": {"window": 60, "stride": 20, "epochs": 500},
}


def _walks() -> Sequences:
    """The first 300 frames of 35_01–35_16 at 120 Hz."""
    return load("35-walk", frames=None).frames(0, FRAMES)


def _slow_walks() -> Sequences:
    """The same walks at 30 Hz, 75 frames."""
    return load("35-walk", frames=None, rate=30.0).frames(0, FRAMES // 4)


def _published(asked: Protocol, figures: tuple[Published, ...]) -> Protocol:
    """The same question as the literature poses it."""
    return replace(
        asked,
        name=f"{asked.name}-published",
        centred=True,
        models=tuple(m for m in asked.models if m not in _LEFT_OUT_OF_PUBLISHED),
        published=figures,
    )


_SETUP_1 = Protocol(
    name="walk-setup-1",
    summary="walks, 3 frames observed and 297 forecast: 50 joint angles, 120 Hz",
    load=_walks,
    source="public",
    need="forecast",
    models=FORECASTERS,
    seen=3,
    horizon=FRAMES - 3,
    settings=_WALK_SETTINGS,
)
_SETUP_2 = replace(
    _SETUP_1,
    name="walk-setup-2",
    summary="walks, 100 frames observed and 200 forecast: 50 joint angles, 120 Hz",
    seen=100,
    horizon=FRAMES - 100,
)
_MISSING_LEG = Protocol(
    name="walk-missing-leg",
    summary="walks at 30 Hz, 75 frames, the right leg's seven channels imputed",
    load=_slow_walks,
    source="public",
    need="impute",
    models=IMPUTERS,
    hidden=LEG,
    settings={
        "pca": {"latent_dim": 12},
        "vae": {"latent_dim": 12},
        "ae-dmp": {"latent_dim": 12, **_AE_DMP},
        "vae-dmp": {"latent_dim": 8, "epochs": 300},
        "vae-dmp-rhythmic": {"latent_dim": 8, "stride": 2, "epochs": 400},
    },
)
_ARM_GOALS = Protocol(
    name="arm-goals",
    summary="a robot arm's reaches, 10 of 76 frames observed, the goal held out",
    load=load_arm,
    source="simulated",
    need="forecast",
    models=(*BASELINES, "dmp", "promp"),
    seen=10,
    horizon=66,
    by="goal",
)
_SETUP_1_FIGURES = (
    Published("SDE Matching", 4.50),
    Published("NCDSSM", 5.69),
    Published("Latent ODE", 5.98),
    Published("ARCTA", 7.62),
    Published("ODE²VAE-KL", 8.09),
    Published("Latent NSF", 8.62),
)
_SETUP_2_FIGURES = (
    Published("Latent NSF", 3.41),
    Published("SDE Matching", 4.26),
    Published("NCDSSM", 4.74),
    Published("Latent SDE", 9.52),
)

PROTOCOLS: dict[str, Protocol] = {
    asked.name: asked
    for asked in (
        _SETUP_1,
        _published(_SETUP_1, _SETUP_1_FIGURES),
        _SETUP_2,
        _published(_SETUP_2, _SETUP_2_FIGURES),
        _MISSING_LEG,
        _ARM_GOALS,
    )
}


def protocol(name: str, known: Mapping[str, Protocol] = PROTOCOLS) -> Protocol:
    """A protocol by name.

    >>> protocol("walk-setup-2").seen, protocol("walk-setup-2-published").published[0].mse
    (100, 3.41)
    """
    if name not in known:
        raise UnknownNameError(f"no protocol {name!r}; there are {', '.join(known)}")
    return known[name]
