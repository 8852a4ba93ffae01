"""Mutations of core mathematics, splits and scores: how many of them turn a test red.

``make mutants`` applies the stored list (``tests/mutations/*.toml``), one mutation at a time in a
copy of the tree, and runs the tests that are named for it, then the whole suite if these pass. What
was found is kept in ``results/mutants.json``; a repeated command goes on where it stopped, as long
as neither code nor tests nor the mutation have changed.
"""

from __future__ import annotations

import argparse
import fnmatch
import gc
import hashlib
import json
import multiprocessing
import os
import platform
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
STORED = ROOT / "results" / "mutants.json"
SUITE = ("tests/truth", "tests/contract", "tests/data", "tests/faces", "tests/house")
SOURCES = ("zoo", "guides", "datasets", "tests", "docs")
NAMED_SECONDS, SUITE_SECONDS = 900.0, 7200.0
RED, GREEN, FOREIGN = 1, 0, 99
# libraries are imported once, in a server; every run of tests is a fork of it
LIBRARIES = (
    "torch torch._dynamo torch.distributed.tensor pyro pyro.infer gpytorch numpy scipy.stats"
    " scipy.signal sklearn.linear_model scoringrules xarray pydantic safetensors.torch jaxtyping"
    " beartype matplotlib.pyplot IPython rich typer pytest hypothesis nbmake.pytest_items"
    " pytest_benchmark.plugin"
)
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning")
FORKED = multiprocessing.get_context("forkserver")
FORKED.set_forkserver_preload(LIBRARIES.split())


class StaleListError(ValueError):
    """Mutations that no longer fit the code."""


@dataclass(frozen=True, kw_only=True)
class Mutation:
    """``old`` text, found once in ``file``, that becomes ``new``; ``tests`` are tried first."""

    name: str
    file: str
    old: str
    new: str
    breaks: str
    tests: tuple[str, ...]

    def fault(self, root: Path = ROOT) -> str | None:
        """Why it cannot be applied, if so."""
        path = root / self.file
        if not path.is_file():
            return f"{self.name}: there is no file {self.file}"
        count = path.read_text(encoding="utf-8").count(self.old)
        if count != 1 or self.old == self.new:
            return f"{self.name}: its old text is found {count} times in {self.file}, not once"
        lost = [t for t in self.tests if not (root / t.split("::")[0]).exists()]
        if lost or not self.tests:
            return f"{self.name}: there is no test {', '.join(lost) or 'named'}"
        return None

    def applied(self, text: str) -> str:
        """The text of the file with the mutation."""
        return text.replace(self.old, self.new)


def listed(folder: Path = ROOT / "tests" / "mutations") -> list[Mutation]:
    """All mutations of the list, their names distinct."""
    found = []
    for file in sorted(folder.glob("*.toml")):
        for name, told in tomllib.loads(file.read_text(encoding="utf-8")).items():
            found.append(Mutation(name=name, **{**told, "tests": tuple(told["tests"])}))
    names = [m.name for m in found]
    if len(set(names)) != len(names):
        raise StaleListError(f"named twice: {sorted({n for n in names if names.count(n) > 1})}")
    return found


def check(mutations: Sequence[Mutation], root: Path = ROOT) -> None:
    """Refuse a list that does not fit the code, with every mutation that does not."""
    faults = [fault for m in mutations if (fault := m.fault(root)) is not None]
    if faults:
        raise StaleListError("\n".join(faults))


def tracked() -> list[Path]:
    """Files of the tree, those not yet committed too."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z", "-co", "--exclude-standard"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [
        Path(f) for f in told.split("\0") if f and (ROOT / f).is_symlink() | (ROOT / f).exists()
    ]


def state_of_the_code() -> str:
    """A hash of everything that decides whether a test is red."""
    content = hashlib.blake2b(digest_size=8)
    for file in sorted(tracked()):
        if file.parts[0] in SOURCES and file.suffix == ".py" and (ROOT / file).is_file():
            content.update(str(file).encode() + (ROOT / file).read_bytes())
    return content.hexdigest()


def key(mutation: Mutation, code: str) -> str:
    """What a stored outcome belongs to."""
    told = json.dumps([code, mutation.file, mutation.old, mutation.new, mutation.tests])
    return hashlib.blake2b(told.encode(), digest_size=8).hexdigest()


def copied(folder: Path) -> Path:
    """A copy of the tree, links kept."""
    for file in tracked():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / file, folder / file, follow_symlinks=False)
    return folder


def run(tree: Path, tests: Sequence[str], seconds: float) -> tuple[int, str]:
    """Exit status of pytest in ``tree``, and the first test that is red."""
    told = tree / "told.txt"
    child = FORKED.Process(target=_tested, args=(str(tree), tuple(tests), str(told)))
    child.start()
    child.join(seconds)
    if child.exitcode is None:
        child.kill()
        child.join()
        return RED, f"no end after {seconds:.0f} s"
    text = told.read_text(encoding="utf-8")
    first = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", text, re.MULTILINE)
    if child.exitcode not in (GREEN, RED, 2) or (child.exitcode and first is None):
        raise StaleListError(f"pytest could not run {tests}:\n{text[-2000:]}")
    return (RED if child.exitcode else GREEN), first[1] if first else ""


def _tested(tree: str, tests: Sequence[str], told: str) -> None:
    """Run pytest in ``tree``, whose package is imported and no other, and end the process."""
    with open(told, "w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(tree)
    sys.path[:] = [tree, *(p for p in sys.path if Path(p) not in (ROOT, ROOT / "tests"))]
    os.environ["PYTHONPATH"] = tree
    sys.dont_write_bytecode = False
    gc.freeze()
    status = int(pytest.main([*PYTEST, *tests]))
    home = getattr(sys.modules.get("zoo"), "__file__", tree)
    if not Path(home).is_relative_to(tree):
        print(f"it is {home} that was tested")
        sys.exit(FOREIGN)
    sys.exit(status)


def outcome(mutation: Mutation, tree: Path) -> dict[str, Any]:
    """Whether a test turns red, which, and after how many seconds."""
    path, began = tree / mutation.file, time.monotonic()
    whole, before = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(mutation.applied(whole), encoding="utf-8")
    try:
        status, test = run(tree, mutation.tests, NAMED_SECONDS)
        if status == GREEN:
            status, test = run(tree, SUITE, SUITE_SECONDS)
    finally:
        path.write_text(whole, encoding="utf-8")
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return {
        "name": mutation.name,
        "file": mutation.file,
        "breaks": mutation.breaks,
        "outcome": "killed" if status == RED else "survived",
        "test": test,
        "seconds": round(time.monotonic() - began, 1),
    }


def outcomes(mutations: Sequence[Mutation], jobs: int) -> Iterator[dict[str, Any]]:
    """Outcomes as they are found, every worker in its own copy of the tree."""
    with tempfile.TemporaryDirectory() as home, ThreadPoolExecutor(jobs) as pool:
        trees: queue.Queue[Path] = queue.Queue()
        for k in range(jobs):
            trees.put(copied(Path(home) / str(k)))

        def found(mutation: Mutation) -> dict[str, Any]:
            tree = trees.get()
            try:
                return outcome(mutation, tree)
            finally:
                trees.put(tree)

        for done in as_completed([pool.submit(found, m) for m in mutations]):
            yield done.result()


def green(mutations: Sequence[Mutation]) -> None:
    """Refuse to count where the named tests are red without any mutation."""
    tests = sorted({test for m in mutations for test in m.tests})
    with tempfile.TemporaryDirectory() as home:
        status, test = run(copied(Path(home)), tests, SUITE_SECONDS)
    if status != GREEN:
        raise StaleListError(f"{test} is red without a mutation")


def stored() -> dict[str, dict[str, Any]]:
    """Outcomes found before, by name."""
    if not STORED.exists():
        return {}
    return {row["name"]: row for row in json.loads(STORED.read_text(encoding="utf-8"))["rows"]}


def store(rows: Sequence[dict[str, Any]]) -> str:
    """Write what was found; returns it as a line."""
    from zoo.studies.result import commit

    killed = sum(row["outcome"] == "killed" for row in rows)
    share = 100 * killed / max(1, len(rows))
    payload = {
        "name": "mutants",
        "label": "own",
        "command": "make mutants",
        "seconds": round(sum(row["seconds"] for row in rows), 1),
        "versions": {n: version(n) for n in ("movezoo", "torch", "pyro-ppl", "numpy", "pytest")},
        "commit": commit(),
        "machine": {"cores": os.cpu_count(), "python": platform.python_version()},
        "mutations": len(rows),
        "killed": killed,
        "share": round(share, 1),
        "rows": sorted(rows, key=lambda row: str(row["name"])),
    }
    text = json.dumps(payload, indent=1, ensure_ascii=False)
    written = STORED.with_suffix(".tmp")
    written.write_text(text + "\n", encoding="utf-8")
    written.replace(STORED)
    survivors = [row["name"] for row in rows if row["outcome"] != "killed"]
    left = f"; alive: {', '.join(survivors)}" if survivors else ""
    return f"{killed} of {len(rows)} mutations turn a test red, {share:.1f} %{left}"


def main() -> None:
    """Apply the mutations that no stored outcome answers for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="*", help="glob of names")
    parser.add_argument("--jobs", type=int, default=2, help="copies of the tree at once")
    parser.add_argument("--list", action="store_true", help="check the list and stop")
    told = parser.parse_args()
    everything = listed()
    chosen = [m for m in everything if fnmatch.fnmatch(m.name, told.only)]
    check(chosen)
    print(f"{len(chosen)} mutations fit the code")
    if told.list:
        return
    os.environ["OMP_NUM_THREADS"] = "1"
    code = state_of_the_code()
    keys = {m.name: key(m, code) for m in everything}
    known = {n: row for n, row in stored().items() if row["key"] == keys.get(n)}
    due = [m for m in chosen if m.name not in known]
    if due:
        green(due)
    for count, row in enumerate(outcomes(due, told.jobs), 1):
        known[row["name"]] = {**row, "key": keys[row["name"]]}
        store(list(known.values()))
        print(f"{count}/{len(due)} {row['name']}: {row['outcome']} {row['test']}", flush=True)
    print(store(list(known.values())))


if __name__ == "__main__":
    try:
        main()
    except StaleListError as error:
        sys.exit(str(error))
