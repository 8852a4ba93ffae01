"""What importing costs: ``python -m benchmarks.startup`` (whole processes, in turn)."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.harness import interleave, report, store


def process(*arguments: str) -> None:
    """Run Python once and throw its output away."""
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def main() -> None:
    """Time ``import zoo`` with all its verbs beside its peers, and ``zoo list``."""
    verbs = "zoo.create, zoo.fit, zoo.load, zoo.evaluate, zoo.load_data, zoo.card"
    timings = interleave(
        {
            "import torch, pyro": lambda: process("-c", "import torch, pyro"),
            "import torch, pyro, zoo": lambda: process("-c", "import torch, pyro, zoo"),
            "and all verbs": lambda: process("-c", f"import torch, pyro, zoo; {verbs}"),
            "zoo list": lambda: process("-m", "zoo", "list"),
        },
        rounds=7,
        warmup=1,
    )
    report("start-up, seconds of a whole process", timings)
    base = timings["import torch, pyro"]["median"]
    store(
        "benchmark_startup",
        {
            "timings": timings,
            "import_zoo_beyond": timings["import torch, pyro, zoo"]["median"] - base,
            "all_verbs_beyond": timings["and all verbs"]["median"] - base,
            "zoo_list": timings["zoo list"]["median"],
        },
        label="simulated",
    )


if __name__ == "__main__":
    main()
