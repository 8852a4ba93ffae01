"""Execute every notebook in a copy, as a reader would, and count what it shows."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import jupytext
import nbformat

HOME = Path(__file__).resolve().parent.parent / "notebooks"
EXPECTED = 5


def main() -> int:
    """Convert, run and check; a notebook without figures or with bare prints fails."""
    scripts = sorted(HOME.glob("*.py"))
    if len(scripts) < EXPECTED:
        print(f"{len(scripts)} notebooks in {HOME}; {EXPECTED} are needed")
        return 1
    with tempfile.TemporaryDirectory() as folder:
        copies = [Path(folder) / f"{s.stem}.ipynb" for s in scripts]
        for script, copy in zip(scripts, copies, strict=True):
            jupytext.write(jupytext.read(script), copy)
        command = [
            sys.executable,
            "-m",
            "pytest",
            "--nbmake",
            "--overwrite",
            "-q",
            "--durations=0",
            folder,
        ]
        code = subprocess.run([*command, "--nbmake-timeout=600", "-c", "/dev/null"]).returncode
        return code or sum(_poor(copy) for copy in copies)


def _poor(copy: Path) -> int:
    """1 where a notebook shows no figure, or prints instead of showing."""
    cells = nbformat.read(copy, as_version=4).cells
    outputs = [o for cell in cells for o in cell.get("outputs", [])]
    figures = sum("image/png" in o.get("data", {}) for o in outputs)
    prints = sum(o.output_type == "stream" and o.name == "stdout" for o in outputs)
    if not figures or prints:
        print(f"{copy.name}: {figures} figures, {prints} bare print-outs")
    return int(not figures or prints > 0)


if __name__ == "__main__":
    sys.exit(main())
