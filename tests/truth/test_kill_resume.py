"""Trainings killed at random moments end in the bits of the uninterrupted one (short version)."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_five_killed_trainings_end_alike() -> None:
    command = [sys.executable, "-m", "benchmarks.kill_resume", "--rounds", "5", "--dry"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--model", "vae"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["identical"] == 5 and found["kills"] >= 5
