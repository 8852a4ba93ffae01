"""`zoo.fit` and `run.reconstruct` of a movement primitive against the package movement-primitives.

``python -m benchmarks.dmp`` checks that both give the same weights and the same movement, times
what a user calls in turn, and writes ``results/benchmark_dmp.json``. Cold calls follow after the
kept responses were dropped; the harness' share is what the model itself does not need.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from movement_primitives.dmp import DMP
from torch import Tensor

import zoo
from benchmarks.harness import Timings, interleave, ratio, report, store
from benchmarks.peer_primitive import design, imitated
from zoo.inference.loader import whole
from zoo.models.primitives import kalman, rollout
from zoo.models.primitives import sufficient_statistics as sums
from zoo.movement.forcing import trajectory_matrix
from zoo.movement.response import Response, Transformation

JOINTS, STEPS, KERNELS = 50, 1000, 20
MANY = 100
BACKENDS = ("rk4-cython", "euler-cython")
PEER = "movement-primitives"


def movement(seed: int = 0) -> Tensor:
    """Smooth random joint angles in rad, (time, joint)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, STEPS)[:, None, None]
    waves = np.sin(2 * np.pi * (time * rng.uniform(0.5, 4, (JOINTS, 5)) + rng.random((JOINTS, 5))))
    return torch.from_numpy((waves * rng.normal(size=(JOINTS, 5)) / 5).sum(-1))


def demonstrations(count: int) -> zoo.Sequences:
    """Movements as a user has them."""
    arrays = np.stack([movement(seed).numpy() for seed in range(count)])
    return zoo.Sequences.from_arrays(arrays, rate=STEPS - 1.0)


def peer(x: Tensor, kernels: int = KERNELS) -> DMP:
    """The peer at the same step, time scale, kernels and constants."""
    dt = 1 / (STEPS - 1)
    dmp = DMP(JOINTS, execution_time=1.0, dt=dt, int_dt=dt, n_weights_per_dim=kernels)
    dmp.imitate(np.linspace(0, 1, STEPS), x.numpy())
    return dmp


def cold(call: Callable[[], object]) -> Callable[[], object]:
    """The call after all kept responses were dropped."""

    def dropped() -> object:
        for kept in (Response.of, rollout.roll_out, kalman._parts, sums._complete):
            kept.cache_clear()
        return call()

    return dropped


def measure(count: int, rounds: int) -> dict[str, Any]:
    """Times of one call on ``count`` demonstrations, and how many times faster than the peer."""
    data, time = demonstrations(count), np.linspace(0, 1, STEPS)
    model, dmp = zoo.create("dmp", data), peer(data.values[0])
    run = zoo.fit(model, data)
    scaled = run.exchange.scaled(data)
    inner = copy.deepcopy(model.model)
    fit, roll = partial(zoo.fit, model, data), partial(run.reconstruct, data)
    fits = interleave(
        {
            "zoo.fit": fit,
            "zoo.fit, cold": cold(fit),
            "its model alone": partial(inner.condition, scaled),
            PEER: partial(dmp.imitate, time, data.values[0].numpy()),
        },
        rounds=rounds,
    )
    calls: dict[str, Any] = {
        "run.reconstruct": roll,
        "run.reconstruct, cold": cold(roll),
        "its model alone": partial(run.model.reconstruct, whole(scaled), None, draws=200),
    }
    calls |= {f"peer {b}": partial(dmp.open_loop, step_function=b) for b in BACKENDS}
    rolls = interleave(calls, rounds=rounds)
    report(f"fit of {count}", fits)
    report(f"reconstruction of {count}", rolls)
    fastest = min((f"peer {b}" for b in BACKENDS), key=lambda name: rolls[name]["median"])
    found: dict[str, Any] = {"fit": fits, "roll_out": rolls, "fastest_peer": fastest}
    found["fit_ratio"] = shares(fits, PEER, "zoo.fit", count)
    found["roll_out_ratio"] = shares(rolls, fastest, "run.reconstruct", count)
    return found


def shares(timings: Timings, slow: str, fast: str, count: int) -> dict[str, float]:
    """Times faster than the peer a demonstration, and the harness' share of the call."""
    alone, call = timings["its model alone"]["median"], timings[fast]["median"]
    return {
        "elapsed": count * ratio(timings, slow, fast),
        "elapsed_cold": count * ratio(timings, slow, f"{fast}, cold"),
        "processor": count * ratio(timings, slow, fast, measure="processor_median"),
        "harness_share": max(0.0, 1 - alone / call),
    }


def agreement(kernels: int = KERNELS) -> dict[str, float]:
    """Largest differences: same movement → same weights, same weights → same movement."""
    x = movement()
    system = Transformation(alpha=25.0, beta=6.25, tau=1.0, dt=1 / (STEPS - 1))
    dmp = peer(x, kernels)
    weights = torch.from_numpy(dmp.forcing_term.weights_.T.copy())
    own = imitated(x, kernels, system)
    matrix = trajectory_matrix(Response.of(system, STEPS), design(kernels, STEPS)[1:])
    path = matrix @ torch.cat([x[:1], torch.zeros_like(x[:1]), x[-1:], own])
    theirs = torch.from_numpy(dmp.open_loop(step_function="euler-cython")[1][:STEPS])
    return {
        "weights_relative_difference": float((own - weights).abs().max() / weights.abs().max()),
        "path_difference": float((path - theirs).abs().max()),
    }


def main(rounds: int = 15) -> None:
    """Measure, print and store."""
    torch.set_num_threads(1)
    found = {str(count): measure(count, rounds if count == 1 else 3) for count in (1, MANY)}
    one, many = found["1"], found[str(MANY)]
    card = {
        "model": "dmp",
        "what": f"`zoo.fit` and `run.reconstruct` against movement-primitives, {JOINTS} joints × "
        f"{STEPS} steps, {KERNELS} kernels, a demonstration",
        "value": f"one: {1e3 * one['fit']['zoo.fit']['median']:.0f} and "
        f"{1e3 * one['roll_out']['run.reconstruct']['median']:.0f} ms, "
        f"{one['fit_ratio']['elapsed']:.2g}× and {one['roll_out_ratio']['elapsed']:.2g}× as fast; "
        f"of {MANY}: {many['fit_ratio']['elapsed']:.2g}× and "
        f"{many['roll_out_ratio']['elapsed']:.2g}×",
        "source": "simulated",
        "command": "python -m benchmarks.dmp",
    }
    payload = {
        "joints": JOINTS,
        "steps": STEPS,
        "kernels": KERNELS,
        "agreement": agreement(),
        "demonstrations": found,
        "cards": [card],
    }
    libraries = ("movement-primitives", "pytransform3d")
    print(store("benchmark_dmp", payload, label="simulated", libraries=libraries, seed=0))


if __name__ == "__main__":
    main()
