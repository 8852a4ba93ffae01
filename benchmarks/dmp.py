"""Fit and roll-out of a dynamic movement primitive against the package movement-primitives.

``python -m benchmarks.dmp`` checks that both give the same weights and the same movement, times
them in turn, and writes ``results/benchmark_dmp.json``.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import torch
from movement_primitives.dmp import DMP
from torch import Tensor

from benchmarks.harness import Timings, interleave, ratio, report, store
from zoo.dynamics.dmp import Response, Transformation, discrete_basis, phase
from zoo.dynamics.imitation import fit_matrix, trajectory_matrix

JOINTS, STEPS, KERNELS = 50, 1000, (10, 20, 50)
OVERLAP = 1 / math.sqrt(-2 * math.log(0.8))
BACKENDS = ("rk4", "rk4-cython", "euler", "euler-cython")


def movement(seed: int = 0) -> Tensor:
    """Smooth random joint angles in rad, (time, joint)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, STEPS)[:, None, None]
    waves = np.sin(2 * np.pi * (time * rng.uniform(0.5, 4, (JOINTS, 5)) + rng.random((JOINTS, 5))))
    return torch.from_numpy((waves * rng.normal(size=(JOINTS, 5)) / 5).sum(-1))


def design(kernels: int) -> Tensor:
    """s Ψ/ΣΨ of every frame, with the peer's widths."""
    time = torch.arange(STEPS, dtype=torch.float64)
    basis = discrete_basis(time, kernels=kernels, duration=STEPS - 1, spread=OVERLAP)
    return basis * phase(time, duration=STEPS - 1)[:, None]


def fit(x: Tensor, system: Transformation, kernels: int) -> Tensor:
    """Weights of one demonstration, everything from scratch."""
    return fit_matrix(design(kernels), system) @ x


def roll_out(x: Tensor, weights: Tensor, system: Transformation) -> Tensor:
    """The movement of ``weights`` from scratch, with a response of its own."""
    still = torch.zeros_like(x[0])
    force = design(len(weights))[1:] @ weights
    response = Response(system, STEPS, torch.float64, "cpu")
    start = torch.stack([x[0], still])
    return response.product(start, system.stiffness * x[-1] + force)[0]


def parameters(x: Tensor, weights: Tensor) -> Tensor:
    """θ = (y₁, ẏ₁, g, w) of every joint."""
    return torch.cat([x[:1], torch.zeros_like(x[:1]), x[-1:], weights]).T.contiguous()


def cached_roll_out(matrix: Tensor, θ: Tensor) -> Tensor:
    """The movement of θ with the kept response: one product."""
    return (θ @ matrix.T).T


def peer(x: Tensor, kernels: int) -> DMP:
    """The peer at matched settings: same step, time scale, kernels and constants."""
    dt = 1 / (STEPS - 1)
    dmp = DMP(JOINTS, execution_time=1.0, dt=dt, int_dt=dt, n_weights_per_dim=kernels)
    dmp.imitate(np.linspace(0, 1, STEPS), x.numpy())
    return dmp


def measure(kernels: int, rounds: int) -> dict[str, Any]:
    """Agreement and times at one number of kernels."""
    x, time = movement(), np.linspace(0, 1, STEPS)
    system = Transformation(alpha=25.0, beta=6.25, tau=1.0, dt=1 / (STEPS - 1))
    dmp = peer(x, kernels)
    weights = torch.from_numpy(dmp.forcing_term.weights_.T.copy())
    matrix = trajectory_matrix(Response.of(system, STEPS), design(kernels)[1:])
    matrix = matrix.T.contiguous().T
    kept = fit_matrix(design(kernels), system)
    fits = interleave(
        {
            "zoo, kept matrix": lambda: kept @ x,
            "zoo, cold": partial(fit, x, system, kernels),
            "movement-primitives": partial(dmp.imitate, time, x.numpy()),
        },
        rounds=rounds,
    )
    calls: dict[str, Any] = {
        "zoo, kept response": partial(cached_roll_out, matrix, parameters(x, weights)),
        "zoo, cold": partial(roll_out, x, weights, system),
    }
    calls |= {f"peer {b}": partial(dmp.open_loop, step_function=b) for b in BACKENDS}
    rolls = interleave(calls, rounds=rounds)
    fastest = min((f"peer {b}" for b in BACKENDS), key=lambda name: rolls[name]["median"])
    report(f"fit, {kernels} kernels", fits)
    report(f"roll-out, {kernels} kernels", rolls)
    return {
        "fit": fits,
        "roll_out": rolls,
        "fastest_peer": fastest,
        **ratios(fits, rolls, fastest, "median"),
        "processor_time": ratios(fits, rolls, fastest, "processor_median"),
        **agreement(x, dmp, weights, matrix, system),
    }


def ratios(fits: Timings, rolls: Timings, fastest: str, measure: str) -> dict[str, float]:
    """How many times faster than the peer, with kept matrices and cold."""
    package = "movement-primitives"
    return {
        "fit_ratio": ratio(fits, package, "zoo, kept matrix", measure=measure),
        "cold_fit_ratio": ratio(fits, package, "zoo, cold", measure=measure),
        "roll_out_ratio": ratio(rolls, fastest, "zoo, kept response", measure=measure),
        "cold_roll_out_ratio": ratio(rolls, fastest, "zoo, cold", measure=measure),
    }


def agreement(
    x: Tensor, dmp: DMP, weights: Tensor, matrix: Tensor, system: Transformation
) -> dict[str, float]:
    """Largest differences: same movement → same weights, same weights → same movement."""
    path = torch.from_numpy(dmp.open_loop(step_function="euler-cython")[1][:STEPS])
    own = fit(x, system, len(weights))
    return {
        "weights_relative_difference": float((own - weights).abs().max() / weights.abs().max()),
        "cached_path_difference": float(
            (cached_roll_out(matrix, parameters(x, weights)) - path).abs().max()
        ),
        "cold_path_difference": float((roll_out(x, weights, system) - path).abs().max()),
        "fit_path_difference": float(
            (cached_roll_out(matrix, parameters(x, own)) - path).abs().max()
        ),
    }


def main(rounds: int = 30) -> None:
    """Measure, print and store."""
    torch.set_num_threads(1)
    found = {str(k): measure(k, rounds) for k in KERNELS}
    for kernels, f in found.items():
        for name, r in (("elapsed", f), ("processor", f["processor_time"])):
            print(
                f"{kernels} kernels, {name} time: fit {r['fit_ratio']:.0f}× "
                f"(cold {r['cold_fit_ratio']:.1f}×), roll-out {r['roll_out_ratio']:.0f}× "
                f"(cold {r['cold_roll_out_ratio']:.1f}×) of {f['fastest_peer']}"
            )
        print(
            f"  weights differ by {f['weights_relative_difference']:.1e} of the largest, "
            f"paths by {f['fit_path_difference']:.1e} rad"
        )
    f = found[str(KERNELS[0])]
    card = {
        "model": "dmp",
        "what": f"speed against movement-primitives, {JOINTS} joints × {STEPS} steps, "
        f"{KERNELS[0]} kernels",
        "value": f"fit {f['fit_ratio']:.0f}×, roll-out {f['roll_out_ratio']:.0f}× "
        f"(cold {f['cold_roll_out_ratio']:.0f}×)",
        "source": "simulated",
        "command": "python -m benchmarks.dmp",
    }
    payload = {"joints": JOINTS, "steps": STEPS, "kernels": found, "cards": [card]}
    libraries = ("movement-primitives", "pytransform3d")
    print(store("benchmark_dmp", payload, label="simulated", libraries=libraries, seed=0))


if __name__ == "__main__":
    main()
