"""Threads: answers and trainings in several threads of a process have the bits of single ones."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from support import assembly_of, data_of, movements, run_of
from torch import Tensor

import zoo
from zoo.catalogue import CATALOGUE

THREADS = 3


def at_once(work: Callable[[int], list[Tensor]]) -> list[list[Tensor]]:
    """What each of three threads gives."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, range(THREADS)))


def same(found: list[list[Tensor]], alone: list[list[Tensor]]) -> bool:
    return all(
        torch.equal(a, b)
        for each, other in zip(found, alone, strict=True)
        for a, b in zip(each, other, strict=True)
    )


@pytest.mark.parametrize("name", ["vae-dmp", "promp", "dvbf"])
def test_forecasts_of_several_threads_have_the_bits_of_one(name: str) -> None:
    run, known = run_of(name), movements().first(8)

    def asked(seed: int) -> list[Tensor]:
        prediction = run.forecast(known, horizon=6, draws=20, seed=seed)
        return [prediction.mean, prediction.std, prediction.sample(5, seed=seed)]

    before = torch.get_rng_state()
    alone = [asked(seed) for seed in range(THREADS)]
    assert same(at_once(asked), alone)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ["vae", "vae-dmp", "gp", "dmp"])
def test_trainings_in_several_threads_have_the_bits_of_one(name: str) -> None:
    entry = CATALOGUE[name]

    def trained(seed: int) -> list[Tensor]:
        run = zoo.fit(assembly_of(entry, epochs=4, seed=seed), data_of(entry))
        return list(run.model.state_dict().values())

    before = torch.get_rng_state()
    alone = [trained(seed) for seed in range(THREADS)]
    assert same(at_once(trained), alone)
    assert torch.equal(torch.get_rng_state(), before)
