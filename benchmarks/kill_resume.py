"""Trainings killed with SIGKILL at random moments and resumed: all must end in the same bits.

``python -m benchmarks.kill_resume`` runs 200 rounds and writes ``results/kill_resume.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.harness import store
from zoo.archive import replace_file
from zoo.catalogue import CATALOGUE
from zoo.datasets.records import Sequences
from zoo.inference.resume import checkpoint
from zoo.inference.svi import fit_svi
from zoo.runs.assembly import Assembly, create, options

__all__ = ["main", "rounds", "train"]

SETTINGS = {
    "epochs": 10,
    "batch_size": 16,
    "window": 10,
    "temper_epochs": 3,
    "warmup_epochs": 2,
    "validate_every": 2,
    "checkpoint_every": 1,
    "patience": None,
    "hidden": 40,
}
AGAIN = 0.3
PAUSES = (0.0, 0.05, 60.0)


def movements(seed: int) -> Sequences:
    """Six noisy movements of eight channels, simulated."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 30)[:, None]
    phases = rng.uniform(0.0, 6.0, size=(6, 1, 8))
    return Sequences.from_arrays(
        np.sin(6.0 * t + phases) + 0.05 * rng.normal(size=(6, 30, 8)), rate=30.0
    )


def train(model: str, folder: Path, pause: float) -> None:
    """Train or resume in ``folder`` and leave there the digest of all that training made.

    Checkpoints are written inside epochs every ``pause`` seconds.
    """
    data, held = movements(0), movements(1)
    made = _create(model, data)
    history = fit_svi(
        made.model,
        made.guide,
        data.to(dtype=made.dtype),
        made.inference,
        val=held.to(dtype=made.dtype),
        folder=folder,
        resume="auto",
        checkpoint_seconds=pause,
    )
    rows = [{k: v for k, v in row.items() if k != "seconds"} for row in history]
    total = hashlib.sha256(json.dumps(rows).encode())
    for part in (made.model, made.guide):
        for name, value in part.state_dict().items():
            total.update(name.encode() + value.numpy().tobytes())
    replace_file(folder / "digest", total.hexdigest().encode())


def _create(model: str, data: Sequences) -> Assembly:
    known = options(CATALOGUE[model])
    return create(model, data, **{k: v for k, v in SETTINGS.items() if k in known})


def _warm_up(model: str) -> None:
    """Import once what every child needs, without starting the autograd threads."""
    made = _create(model, movements(0))
    torch.optim.Adam(made.model.parameters(), fused=True)


def rounds(model: str, count: int, seed: int = 0) -> dict[str, Any]:
    """Kill and resume ``count`` trainings; how many ended in the bits of the uninterrupted one."""
    rng = random.Random(seed)
    _warm_up(model)
    with tempfile.TemporaryDirectory() as place:
        expected, duration = _uninterrupted(model, Path(place) / "whole")
        found: Counter[str] = Counter()
        digests: Counter[str] = Counter()
        for i in range(count):
            folder = Path(place) / str(i)
            _kill_and_resume(model, folder, rng, duration, found)
            digests[(folder / "digest").read_text()] += 1
    return {
        "model": model,
        "rounds": count,
        "kills": found.pop("kills"),
        "identical": digests[expected],
        "uninterrupted_seconds": round(duration, 3),
        "left_by_the_kills": dict(found),
    }


def _kill_and_resume(
    model: str, folder: Path, rng: random.Random, duration: float, found: Counter[str]
) -> None:
    folder.mkdir()
    killed = False
    while not killed or rng.random() < AGAIN:
        pause = rng.choice(PAUSES)
        child = _fork(partial(train, model, folder, pause))
        time.sleep(rng.uniform(0.0, duration))
        os.kill(child, signal.SIGKILL)
        if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
            killed = True
            found.update(["kills", _remains(folder)])
        elif killed:
            return
        else:
            _empty(folder)
    _finish(_fork(partial(train, model, folder, 60.0)))


def _remains(folder: Path) -> str:
    """What a kill left behind."""
    if list(folder.glob("*.part")):
        return "a file half written"
    if not checkpoint.exists(folder):
        return "no checkpoint yet"
    state = checkpoint.read(folder)[1]
    if state["finished"]:
        return "a finished training"
    return (
        "a checkpoint inside an epoch" if state["place"]["batch"] else "a checkpoint between epochs"
    )


def _uninterrupted(model: str, folder: Path) -> tuple[str, float]:
    folder.mkdir()
    begin = time.monotonic()
    _finish(_fork(partial(train, model, folder, 60.0)))
    return (folder / "digest").read_text(), time.monotonic() - begin


def _fork(task: Callable[[], None]) -> int:
    child = os.fork()
    if child == 0:
        try:
            task()
        except BaseException as error:
            os.write(2, f"{error!r}\n".encode())
            os._exit(1)
        os._exit(0)
    return child


def _finish(child: int) -> None:
    if status := os.waitpid(child, 0)[1]:
        raise RuntimeError(f"a training that nobody killed ended with status {status}")


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def main() -> None:
    """Run the rounds, print and store what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--model", default="vae-dmp")
    parser.add_argument("--dry", action="store_true", help="do not write results/")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    payload = rounds(chosen.model, chosen.rounds)
    print(json.dumps(payload))
    if not chosen.dry:
        print(store("kill_resume", payload, label="simulated", seed=0))
    if payload["identical"] != chosen.rounds:
        raise SystemExit(f"{chosen.rounds - payload['identical']} final states differ")


if __name__ == "__main__":
    main()
