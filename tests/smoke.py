"""In an environment with the core dependencies only: import, train, calibrate, save, load."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import zoo


def main() -> None:
    """Fail loudly where the wheel or its dependencies lack something."""
    rng = np.random.default_rng(0)
    data = zoo.Sequences.from_arrays(
        [np.cumsum(rng.normal(size=(30, 7)), 0) for _ in range(8)], rate=30.0, units="rad"
    )
    train, calib = data.split(by="trial", parts=(0.5, 0.5), seed=0)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("pca", "vae-dmp", "dmp"):
            settings = {"epochs": 2} if name == "vae-dmp" else {}
            run = zoo.fit(zoo.create(name, train, **settings), train).calibrate(calib)
            zoo.load(run.save(Path(folder) / name)).reconstruct(calib)
            again = {"run_dir": Path(folder) / f"{name}-kept", "resume": "auto"}
            kept = [zoo.fit(zoo.create(name, train, **settings), train, **again) for _ in range(2)]
            assert kept[0].made_of == kept[1].made_of and kept[0].seconds == kept[1].seconds
            print(zoo.evaluate(run, calib[:1]).to_markdown() if name == "dmp" else name)
    listing = subprocess.run(
        [sys.executable, "-m", "zoo", "list", "--json"], check=True, capture_output=True, text=True
    )
    assert "vae-dmp" in listing.stdout
    assert not {"tensorboard", "jupytext", "roboticstoolbox"} & set(sys.modules)
    print(
        f"smoke test passed with {len(zoo.list_models())} models from {Path(zoo.__file__).parent}"
    )


if __name__ == "__main__":
    main()
