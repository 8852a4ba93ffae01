"""A model from outside, in two files, joins by registration and keeps the laws of the house."""

from __future__ import annotations

import copy
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from laws import (
    batch_of,
    check_blind,
    check_exact,
    check_program,
    check_sites,
    check_uniform,
    judged,
)
from stranger.entry import ENTRY
from stranger.gpfa import GPFA
from support import data_of, movements
from torch import Tensor

import zoo
from zoo.catalogue import CATALOGUE

ROOT = Path(__file__).resolve().parents[2]
TASKS = ("forecast", "impute joints", "impute section")


class Flipped(GPFA):
    """Its posterior mean has the wrong sign."""

    def _posterior(self, values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        mean, factor = super()._posterior(values, mask)
        return -mean, factor


@pytest.fixture(scope="module")
def run() -> Iterator[zoo.Run]:
    """A training of the stranger's model, which is registered as long as these tests run."""
    with pytest.MonkeyPatch.context() as patch:
        list(CATALOGUE)
        patch.setattr(CATALOGUE, "_entries", dict(CATALOGUE._entries))
        patch.setattr(CATALOGUE, "_joined", set(CATALOGUE._joined))
        if "gpfa" not in zoo.list_models():
            zoo.register(ENTRY)
        data = movements()
        yield zoo.fit(zoo.create("gpfa", data, iterations=15), data)


def flipped(run: zoo.Run) -> zoo.Run:
    """The same run with the sign of its posterior mean flipped."""
    model, guide = copy.deepcopy((run.model, run.assembly.guide))
    model.__class__ = Flipped
    return replace(run, assembly=replace(run.assembly, model=model, guide=guide))


def test_it_joins(run: zoo.Run, tmp_path: Path) -> None:
    assert "gpfa" in zoo.list_models(can="forecast")
    assert run.capabilities == ("represent", "reconstruct", "forecast", "impute")
    assert "Yu et al." in zoo.card("gpfa").text
    assert run.history[-1]["objective"] < run.history[0]["objective"]
    again = zoo.load(run.save(tmp_path / "run"))
    seen = movements(missing=True).first(12)
    assert torch.equal(again.impute(seen).mean, run.impute(seen).mean)
    new = replace(movements(), values=movements().values + 0.01)
    assert "forecast" in str(zoo.evaluate(run, new).to_json())


@torch.no_grad()
def test_its_program_guide_and_bound_are_those_of_the_law(run: zoo.Run) -> None:
    check_program(run)
    check_sites(run)
    evidence = check_exact(run)
    batch = batch_of(run)
    mask = torch.ones_like(batch.values, dtype=torch.bool)
    assert evidence == pytest.approx(float(run.model.log_evidence(batch.values, mask).sum()))


@torch.no_grad()
def test_its_evidence_is_that_of_the_dense_gaussian(run: zoo.Run) -> None:
    """x is N(1 ⊗ d, Σ_k K_k ⊗ c_k c_kᵀ + I ⊗ diag σ²), without the entries that are missing."""
    model, batch = run.model, batch_of(run, data_of(ENTRY, missing=True))
    root, loading = model._root(batch.values.shape[1]), model.loading
    signal = torch.einsum("kta,kua,dk,ek->tdue", root, root, loading, loading)
    frames, channels = batch.values.shape[1:]
    dense = signal.reshape(frames * channels, -1) + torch.diag(model.noise.square().repeat(frames))
    found = model.log_evidence(batch.values, batch.mask)
    for row in (0, 1, 5):
        seen = batch.mask[row].flatten()
        law = torch.distributions.MultivariateNormal(
            model.offset.repeat(frames)[seen], dense[seen][:, seen]
        )
        expected = law.log_prob(batch.values[row].flatten()[seen])
        assert float(found[row]) == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.parametrize("task", TASKS)
def test_its_answers_are_calibrated_and_know_nothing_of_what_is_hidden(
    run: zoo.Run, task: str
) -> None:
    check_uniform(judged(run, task))
    check_blind(run, task)


@pytest.mark.parametrize("task", TASKS)
def test_a_flipped_posterior_mean_is_not_calibrated(run: zoo.Run, task: str) -> None:
    with pytest.raises(AssertionError, match="not uniform"):
        check_uniform(judged(flipped(run), task))


def test_a_flipped_posterior_mean_moves_the_bound(run: zoo.Run) -> None:
    with pytest.raises(AssertionError, match="the bound moves"):
        check_exact(flipped(run))


def test_the_contract_takes_it_where_its_package_is_installed(tmp_path: Path) -> None:
    """An entry point is all that it needs: the contract tests ask it what they ask every entry."""
    info = tmp_path / "gpfa-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: gpfa\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[movezoo.models]\ngpfa = stranger.entry:ENTRY\n")
    path = [tmp_path, ROOT / "tests", *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    asked = [*command, "-k", "gpfa", "tests/contract", "tests/faces/test_cards.py"]
    done = subprocess.run(asked, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None and int(passed[1]) >= 40, done.stdout
