"""The skeletons that people copy are models that train, predict and keep the laws."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from laws import check_exact, check_program, check_sites, check_uniform, judged
from support import data_of, movements

import zoo
from zoo.runs.assembly import assemble

ROOT = Path(__file__).resolve().parents[2]
SETTINGS: dict[str, dict[str, Any]] = {
    "svi": {"epochs": 60, "batch_size": 64, "latent_dim": 3},
    "exact": {},
    "marginal_likelihood": {"iterations": 20},
}
TASKS = {
    "svi": (),
    "exact": ("forecast", "impute joints", "impute section"),
    "marginal_likelihood": ("regress",),
}


@pytest.fixture(params=list(SETTINGS), scope="module")
def skeleton(request: pytest.FixtureRequest) -> Iterator[tuple[str, zoo.Run]]:
    """A training of the skeleton of each inference."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        entry = import_module(f"docs.skeleton.{request.param}.entry").ENTRY
        data = data_of(entry)
        made = assemble(entry, data.layout, SETTINGS[request.param], seed=0, device="cpu")
        yield request.param, zoo.fit(made, data)
        for module in [m for m in sys.modules if m.startswith("docs.skeleton")]:
            patch.delitem(sys.modules, module)


def test_it_trains_predicts_and_keeps_the_laws(skeleton: tuple[str, zoo.Run]) -> None:
    kind, run = skeleton
    asked = {task.split()[0] for task in TASKS[kind]}
    assert set(run.capabilities) == (asked or {"reconstruct"})
    check_program(run)
    check_sites(run)
    if kind == "svi":
        data = movements()
        error = (run.reconstruct(data).mean - data.values).square().mean()
        assert float(error) < float(data.values.var())
        assert run.history[-1]["loss"] < run.history[0]["loss"]
        return
    evidence = check_exact(run)
    if kind == "marginal_likelihood":
        assert evidence == pytest.approx(-run.history[-1]["objective"])
    for task in TASKS[kind]:
        check_uniform(judged(run, task))


def test_missing_entries_are_no_part_of_it(skeleton: tuple[str, zoo.Run]) -> None:
    """What is missing may be anything; a run answers all the same, and in the data's units."""
    kind, run = skeleton
    holed = data_of(run.assembly.entry, missing=True)
    made = assemble(run.assembly.entry, holed.layout, SETTINGS[kind], seed=0, device="cpu")
    again = zoo.fit(made, holed)
    outcomes = zoo.evaluation.tasks.outcomes(again, data_of(run.assembly.entry)[:4])
    assert all(bool(t.prediction.mean.isfinite().all()) for t in outcomes)
    assert {u for t in outcomes for u in t.prediction.units} <= {"rad", "N"}
