"""The skeleton that the README tells people to copy is a model that trains and predicts."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support import movements

import zoo
from zoo.assembly import assemble

ROOT = Path(__file__).resolve().parents[2]


def test_the_skeleton_trains_and_predicts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    from docs.skeleton.entry import ENTRY

    data = movements()
    settings = {"epochs": 60, "batch_size": 64, "latent_dim": 3}
    assembly = assemble(ENTRY, data.layout, settings, seed=0, device="cpu")
    run = zoo.fit(assembly, data)
    prediction = run.reconstruct(data)
    error = (prediction.mean - data.values).square().mean()
    assert ENTRY.capabilities == ("reconstruct",)
    assert float(error) < float(data.values.var())
    assert run.history[-1]["loss"] < run.history[0]["loss"]
    for module in [m for m in sys.modules if m.startswith("docs.skeleton")]:
        monkeypatch.delitem(sys.modules, module)
