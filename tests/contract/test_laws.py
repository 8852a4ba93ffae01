"""The laws of the architecture page, asked of every entry of the catalogue."""

from __future__ import annotations

import fnmatch
from dataclasses import replace

import pytest
import torch
from laws import (
    batch_of,
    check_blind,
    check_exact,
    check_program,
    check_sites,
    check_uniform,
    check_weights,
    imputed,
    judged,
)
from support import assembly_of, data_of, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.registry import Entry
from zoo.contract.strategies import Svi
from zoo.datasets.records.scaling import Scaler

NAMES = [e.name for e in CATALOGUE]
BASELINES = {e.name for e in CATALOGUE if e.thesis.startswith("baseline")}
VARIATIONAL = [e.name for e in CATALOGUE if isinstance(e.inference, Svi)]
CLOSED = [e.name for e in CATALOGUE if not isinstance(e.inference, Svi)]
TASKS = {
    "forecast": ("forecast",),
    "impute": ("impute joints", "impute section"),
    "regress": ("regress",),
}
PATHS = (
    "its answers are those of a latent path prior, a model of its own: tests/truth/test_paths.py"
)
AMORTISED = "its encoder stands for the posterior, and its chain for the conditional"
UNCALIBRATED = {
    "*ae-*dmp*": PATHS,
    "vae": AMORTISED,
    "vae-dynamics": AMORTISED,
    "dvbf": AMORTISED,
    "last-value": "its program is a walk from one frame to the next, its bands those of each lead",
    "nearest-neighbour": "it answers by movements that it knows, aligned; its program is their mix",
    "kernel-ridge": "it answers by regressions for the entries asked, its program by frames alone",
}
every = pytest.mark.parametrize("name", NAMES)


def questions(names: list[str]) -> list[tuple[str, str]]:
    """Entries with the questions whose answers are distributions of data."""
    return [(n, task) for n in names for task in tasks_of(CATALOGUE[n])]


def tasks_of(entry: Entry) -> list[str]:
    """Questions that an entry has answers to."""
    return [task for can in entry.capabilities for task in TASKS.get(can, ())]


def exempt(name: str) -> bool:
    """Whether an entry's answers are approximate by design."""
    return any(fnmatch.fnmatch(name, pattern) for pattern in UNCALIBRATED)


@every
def test_the_program_draws_what_it_observes(name: str) -> None:
    check_program(run_of(name))


@pytest.mark.parametrize("name", [e.name for e in CATALOGUE if e.guide is not None])
def test_the_guide_draws_what_the_program_does_not_observe(name: str) -> None:
    check_sites(run_of(name))


@pytest.mark.parametrize("name", VARIATIONAL)
def test_a_minibatch_stands_for_the_whole_training_set(name: str) -> None:
    check_weights(run_of(name))


@every
def test_every_entry_has_a_guide_or_is_a_baseline(name: str) -> None:
    assert (CATALOGUE[name].guide is None) == (name in BASELINES)


@pytest.mark.parametrize("name", [n for n in CLOSED if CATALOGUE[n].guide is not None])
def test_the_bound_is_the_log_evidence_at_every_draw(name: str) -> None:
    check_exact(run_of(name))


@pytest.mark.parametrize(("name", "task"), questions([n for n in CLOSED if not exempt(n)]))
def test_answers_about_its_own_draws_are_calibrated(name: str, task: str) -> None:
    check_uniform(judged(run_of(name), task))


def test_exemptions_are_of_entries_that_exist() -> None:
    assert all(fnmatch.filter(NAMES, pattern) for pattern in UNCALIBRATED)


@pytest.mark.parametrize(("name", "task"), questions(NAMES))
def test_what_is_hidden_is_asked_for_and_cannot_matter(name: str, task: str) -> None:
    check_blind(run_of(name), task)


@pytest.mark.parametrize("name", CATALOGUE.names(can="impute"))
def test_a_model_reads_no_entry_that_is_missing(name: str) -> None:
    run = run_of(name)
    batch = batch_of(run, data_of(CATALOGUE[name], missing=True))
    assert batch.mask is not None
    noise = 5 * torch.randn(batch.values.shape, generator=torch.Generator().manual_seed(0))
    values = torch.where(batch.mask, batch.values, noise.to(batch.values))
    other = imputed(run, replace(batch, values=values, movements=values))
    assert torch.equal(imputed(run, batch).location, other.location)


@every
def test_scaling_is_that_of_the_training_data(name: str) -> None:
    entry = CATALOGUE[name]
    group = "trial" if entry.data == "sequences" else "series"
    train, val = data_of(entry).split(by=group, parts=(0.5, 0.5), seed=0)
    assembly = assembly_of(entry)
    run = zoo.fit(assembly, train, val=val)
    assert run.scaler.to_json() == Scaler.fit(train, assembly.scaling).to_json()
