"""Movements kept out of the networks' training: they set the noise, and stay in the prior."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import zoo
from zoo.contract.strategies import Svi
from zoo.datasets.records import Sequences
from zoo.inference.harness import kept_out

QUICK = {"epochs": 3, "batch_size": 16, "latent_dim": 2, "hidden": 20}


def walks(trials: int = 12) -> Sequences:
    """Two windows of each of some smooth movements."""
    generator = torch.Generator().manual_seed(0)
    time = torch.linspace(0, 6, 40)[:, None]
    swing = torch.randn(trials, 1, 5, generator=generator)
    values = torch.sin(time + swing) + 0.01 * torch.randn(trials, 40, 5, generator=generator)
    groups = {"subject": ["35"] * trials, "trial": range(trials)}
    data = Sequences.from_arrays(values.numpy(), rate=30.0, groups=groups, name="swings")
    return data.windows(20, stride=20)


def parts(data: Sequences, **settings: float) -> tuple[Sequences, Sequences | None]:
    model = zoo.create("vae-dmp", data, **QUICK).model
    known, kept = kept_out(model, Svi(**settings), data, None, 0)
    return known, kept


def test_whole_groups_are_kept_out() -> None:
    known, kept = parts(walks(), kept_out=0.25)
    assert kept is not None
    assert not set(known.groups["trial"]) & set(kept.groups["trial"])
    assert (len(known), len(kept)) == (18, 6)
    assert kept_out(torch.nn.Module(), Svi(), known, kept, 0) == (known, kept)


def test_few_groups_are_all_trained_on() -> None:
    few = walks(7)
    known, kept = parts(few, kept_out=0.25)
    assert known is few and kept is None


@pytest.mark.parametrize("name", ["vae-dmp", "ae-dmp"])
def test_the_prior_knows_every_movement_and_the_noise_those_kept_out(name: str) -> None:
    data = walks()
    run = zoo.fit(zoo.create(name, data, **QUICK), data)
    assert len(run.model.prior_movements) == len(data)
    assert "kept_out" in zoo.runs.assembly.options(run.assembly.entry)
    noisy = replace(data, values=data.values + 5 * torch.randn(data.values.shape))
    val = zoo.fit(zoo.create(name, data, **QUICK), data, val=noisy)
    plain = zoo.fit(zoo.create(name, data, kept_out=0.0, **QUICK), data)
    wide, narrow = (r.reconstruct(data[:2]).std.mean() for r in (val, plain))
    assert float(wide) > 3 * float(narrow)
    assert len(val.model.prior_movements) == len(data)


def test_a_model_without_such_a_noise_refuses_the_setting() -> None:
    with pytest.raises(ValueError, match="kept_out must be 0 for VAE"):
        zoo.fit(zoo.create("vae", walks(), epochs=1, kept_out=0.5), walks())
