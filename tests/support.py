"""Small data that every entry of the catalogue can be trained on in a second."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.registry import Entry
from zoo.contract.strategies import Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.runs.assembly import Assembly, options
from zoo.runs.run import Run

FRAMES, CHANNELS = 24, 7


@cache
def movements(missing: bool = False) -> Sequences:
    """Eight smooth movements of five joints, in rad at 30 Hz, of two subjects."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, FRAMES)[:, None]
    mixing = rng.normal(size=(2, CHANNELS))
    arrays = []
    for _ in range(8):
        phase = rng.normal(scale=0.3)
        basis = np.concatenate([np.sin(2 * np.pi * time + phase), time * rng.normal(1, 0.2)], 1)
        arrays.append(basis @ mixing + 0.02 * rng.normal(size=(FRAMES, CHANNELS)))
    if missing:
        arrays[0][3:6, 1] = np.nan
        arrays[5][10, :] = np.nan
    return Sequences.from_arrays(
        arrays,
        rate=30.0,
        channels=[f"joint_{i}" for i in range(CHANNELS)],
        units="rad",
        groups={"trial": range(8), "subject": list("aaaabbbb")},
        name="tiny",
        provenance="simulated",
    )


@cache
def pairs(missing: bool = False) -> Pairs:
    """Sixty items of a smooth function of three features, two forces in N."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(60, 3))
    y = np.stack([np.sin(x[:, 0]) + x[:, 1], x[:, 2] ** 2], 1) + 0.05 * rng.normal(size=(60, 2))
    if missing:
        y[4, 1] = np.nan
    return Pairs.from_arrays(
        x,
        y,
        channels=["f_x", "f_z"],
        units="N",
        groups={"series": [str(i % 6) for i in range(60)]},
        name="tiny",
        provenance="simulated",
    )


def data_of(entry: Entry, missing: bool = False) -> Any:
    """The small data of an entry's kind."""
    return movements(missing) if entry.data == "sequences" else pairs(missing)


def assembly_of(entry: Entry, *, epochs: int = 2, seed: int = 0) -> Assembly:
    """An entry bound to the small data, with a short training."""
    settings: dict[str, Any] = {}
    if isinstance(entry.inference, Svi):
        settings = {"epochs": epochs, "batch_size": 16, "checkpoint_every": 1}
    elif "iterations" in options(entry):
        settings = {"iterations": 5}
    quick = {"inducing": 0.8, "em_tolerance": 1e-5}
    settings |= {k: v for k, v in quick.items() if k in options(entry)}
    return zoo.create(entry.name, data_of(entry), seed=seed, **settings)


@cache
def run_of(name: str) -> Run:
    """A short training of an entry, shared by the tests that only look at it."""
    entry = CATALOGUE[name]
    return zoo.fit(assembly_of(entry), data_of(entry))
