"""Models make their tensors where their own are, not on torch's default device.

The default device is ``meta`` here, whose tensors hold no numbers: what a model makes without
saying where cannot meet its own tensors. Movement primitives are left out: they make constants on
the CPU and move them, which ``meta`` cannot tell apart.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from support import data_of, movements, run_of

from zoo.contract.registry import load
from zoo.inference.loader import whole
from zoo.inference.posterior import GuidePosterior
from zoo.prediction.predictive import Predictive
from zoo.runs.run import Run

EXACT = ["pca", "gp", "fitc", "vfe", "mean", "last-value", "ar", "nearest-neighbour"]
NAMES = [*EXACT, "mean-regressor", "vae", "vae-dynamics"]


def answers(run: Run) -> dict[str, Callable[[], Predictive]]:
    """Every task of the model itself, on scaled data with missing entries."""
    model, guide, scaled = run.model, run.assembly.guide, run.exchange.scaled
    posterior = None if guide is None else GuidePosterior(guide)
    data = scaled(data_of(run.assembly.entry, missing=True))
    batch = whole(data)
    if run.assembly.layout.kind == "pairs":
        return {"regress": lambda: model.regress(data.inputs, draws=3)}
    start = whole(scaled(movements(missing=True).first(10)))
    return {
        "represent": lambda: model.represent(batch, posterior, draws=3),
        "reconstruct": lambda: model.reconstruct(batch, posterior, draws=3),
        "impute": lambda: model.impute(batch, posterior, draws=3),
        "forecast": lambda: model.forecast(start, posterior, horizon=5, draws=3),
    }


@pytest.mark.parametrize("name", NAMES)
def test_answers_are_where_the_model_is(name: str) -> None:
    run = run_of(name)
    for task, answer in answers(run).items():
        if task in run.capabilities:
            with torch.no_grad(), torch.device("meta"):
                found = answer()
            assert bool(found.location.isfinite().all()), task


@pytest.mark.parametrize("name", EXACT)
def test_statistics_are_where_the_data_are(name: str) -> None:
    run = run_of(name)
    model = copy.deepcopy(run.model)
    data = run.exchange.scaled(data_of(run.assembly.entry, missing=True))
    with torch.device("meta"):
        model.condition(data)
    assert {b.device.type for b in model.buffers()} == {"cpu"}


def test_penalties_are_of_the_model_s_own_number_type() -> None:
    """Settings reach float64 sums with all their digits."""
    name = "zoo.models.baselines.autoregression:Autoregression"
    model = load(name)(movements().layout, load(name).config_class(order=1, noise_floor=0.1))
    floor = model._shrunk(torch.zeros(2, 7, 7, dtype=torch.float64))
    assert floor.dtype == torch.float64 and float(floor[0, 0, 0]) == 0.1**2
