"""The wheel holds what the tree holds, under one top-level name."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HOMES = {"zoo": "zoo", "zoo/guides": "guides", "zoo/datasets": "datasets", "zoo/results": "results"}


def test_the_wheel_is_the_tree(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir"]
    subprocess.run([*command, str(tmp_path), str(ROOT)], check=True, capture_output=True)
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
    content = {n for n in names if ".dist-info/" not in n}
    assert {n.split("/")[0] for n in content} == {"zoo"}
    expected = {"zoo/py.typed", "zoo/faces/player.html"}
    for inside, home in HOMES.items():
        for file in (ROOT / home).rglob("*.py"):
            if file.relative_to(ROOT).parts[:2] not in {tuple(h.split("/")) for h in HOMES}:
                expected.add(f"{inside}/{file.relative_to(ROOT / home).as_posix()}")
    expected |= {f"zoo/results/{f.name}" for f in (ROOT / "results").glob("*.json")}
    assert content == expected
