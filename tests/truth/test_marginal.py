"""Marginal likelihood: every optimiser resumes to the same bits and retreats from NaN."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from torch import nn

from zoo.contract.strategies import MarginalLikelihood
from zoo.errors import DamagedRunError, TrainingError
from zoo.inference.marginal import fit_marginal
from zoo.inference.minimise import MINIMISERS

OPTIMISERS = pytest.mark.parametrize("optimizer", sorted(MINIMISERS))


class Valley(nn.Module):
    """Rosenbrock's valley, without a value where its first coordinate is above ``wall``."""

    def __init__(self, wall=np.inf, broken=False, stop=None):
        super().__init__()
        self.x = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.wall, self.broken, self.stop, self.calls = wall, broken, stop, 0

    def condition(self, data):
        with torch.no_grad():
            self.x.copy_(data + 0.1 * torch.randn(2, dtype=torch.float64))

    def objective(self):
        self.calls += 1
        if self.stop is not None and self.calls > self.stop:
            raise KeyboardInterrupt
        if self.broken:
            raise torch.linalg.LinAlgError("not positive definite")
        a, b = self.x
        value = (1 - a) ** 2 + 100 * (b - a**2) ** 2
        return value if a < self.wall else value * torch.nan

    def settle(self):
        self.settled = True


START = torch.tensor([-1.2, 1.0], dtype=torch.float64)


def fit(model, optimizer, folder=None, resume="never", restarts=1, seed=0):
    strategy = MarginalLikelihood(optimizer=optimizer, tolerance=1e-12, restarts=restarts)
    rows = fit_marginal(model, START, strategy, seed=seed, folder=folder, resume=resume)
    return rows, model.x.detach().clone()


@OPTIMISERS
def test_finds_the_minimum(optimizer):
    rows, x = fit(Valley(), optimizer)
    torch.testing.assert_close(x, torch.ones_like(x), rtol=0, atol=1e-4)
    assert [r["iteration"] for r in rows] == list(range(len(rows)))
    assert rows[-1]["gradient_norm"] < 1e-2


@OPTIMISERS
def test_retreats_from_values_that_are_not_finite(optimizer):
    rows, x = fit(Valley(wall=1.02), optimizer)
    torch.testing.assert_close(x, torch.ones_like(x), rtol=0, atol=1e-2)
    assert all(np.isfinite(r["objective"]) for r in rows)


@OPTIMISERS
def test_gives_up_with_a_named_error(optimizer):
    with pytest.raises(TrainingError, match="Valley: the log evidence is nan at the start"):
        fit(Valley(broken=True), optimizer)


@OPTIMISERS
@pytest.mark.parametrize("stop", [1, 2, 7, 20])
def test_an_interrupted_fit_resumes_to_the_same_bits(optimizer, stop, tmp_path):
    rows, x = fit(Valley(), optimizer, restarts=2)
    with pytest.raises(KeyboardInterrupt):
        fit(Valley(stop=stop), optimizer, tmp_path, restarts=2)
    file = tmp_path / "evaluations.jsonl"
    file.write_text(file.read_text() + '{"at": "cut by a cra')
    resumed = Valley()
    again, y = fit(resumed, optimizer, tmp_path, "auto", restarts=2)
    assert again == rows
    assert torch.equal(x, y)
    whole = Valley()
    fit(whole, optimizer, restarts=2)
    assert resumed.calls == whole.calls - stop + 1


def test_a_journal_of_other_data_is_refused(tmp_path):
    fit(Valley(), "newton", tmp_path)
    with pytest.raises(DamagedRunError, match="other data or settings"):
        fit(Valley(), "newton", tmp_path, "auto", seed=1)


def test_a_missing_or_foreign_journal_is_refused(tmp_path):
    with pytest.raises(DamagedRunError, match="no evaluations"):
        fit(Valley(), "newton", tmp_path, "must")
    (tmp_path / "evaluations.jsonl").write_text(json.dumps({"version": 99}) + "\n")
    with pytest.raises(DamagedRunError, match="not a journal"):
        fit(Valley(), "newton", tmp_path, "auto")


def test_newton_refuses_many_parameters():
    model = Valley()
    model.extra = nn.Parameter(torch.zeros(40, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"42.*l-bfgs"):
        fit(model, "newton")
