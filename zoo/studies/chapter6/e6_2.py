"""E6.2: nine movements in three dimensions: do walks lie together? (§6.3.1.1, Fig. 47, 48)."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.cmu_mocap import load
from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.runs.run import Run
from zoo.studies.chapter6.e6_3 import fitted
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["nine", "run"]

STAND_INS = ("35_05", "35_08", "35_11", "35_14")
MODELS = {"VAE-DMP": "vae-dmp", "VAE": "vae"}
LATENT = 3
SEED = 0

Distances = NDArray[np.float64]


def nine() -> Sequences:
    """The five movements of the thesis and four walks, treated alike: 70 frames, folded."""
    five = load_data("thesis-movements")
    walks = load("35-walk")
    rows = [list(walks.groups["trial"]).index(t) for t in STAND_INS]
    columns = [walks.channels.index(c) for c in five.channels]
    extra = [np.arcsin(np.sin(walks.arrays[i][:, columns])) for i in rows]
    return Sequences.from_arrays(
        [*five.arrays, *extra],
        rate=five.rate,
        channels=five.channels,
        units=five.units,
        groups={"movement": [*five.groups["movement"], *(f"walk {t}" for t in STAND_INS)]},
        name="nine movements",
    )


def run(*, quick: bool, progress: bool) -> Result:
    """Train VAE-DMP and VAE on all nine and compare where their paths lie."""
    data = nine()
    names = [str(m).replace("_", " ") for m in data.groups["movement"]]
    paths = {
        label: _fitted(name, data, f"nine {label}", quick, progress).represent(data, draws=50).mean
        for label, name in MODELS.items()
    }
    return _result(names, paths)


def _fitted(name: str, data: Sequences, label: str, quick: bool, progress: bool) -> Run:
    """A model of all nine: their paths are looked at, none is predicted."""
    return fitted(name, data, LATENT, label, quick=quick, progress=progress, kept_out=0.0)


def _distances(paths: Tensor) -> Distances:
    """How far apart movements lie whatever their timing, in standard deviations of all paths.

    Mean over the frames of both of the distance to the nearest frame of the other.
    """
    scaled = paths.double() / paths.double().flatten(0, 1).std(0)
    each = torch.cdist(scaled[:, None], scaled[None])
    way: NDArray[np.float64] = each.min(-1).values.mean(-1).numpy()
    return (way + way.T) / 2


def _roughness(paths: Tensor) -> Distances:
    """Root mean square of second differences over that of first ones, of every movement."""
    x = paths.double()
    rough: NDArray[np.float64] = (
        (x.diff(n=2, dim=1).square().mean((1, 2)) / x.diff(dim=1).square().mean((1, 2)))
        .sqrt()
        .numpy()
    )
    return rough


def _together(distances: Distances, chosen: tuple[int, ...]) -> float:
    """Mean distance within a set of movements over that to all others."""
    inside = np.zeros(len(distances), bool)
    inside[list(chosen)] = True
    own = distances[np.ix_(inside, inside)]
    return float(
        own[~np.eye(len(own), dtype=bool)].mean() / distances[np.ix_(inside, ~inside)].mean()
    )


def _result(names: list[str], paths: dict[str, Tensor]) -> Result:
    walks = tuple(i for i, n in enumerate(names) if n.startswith("walk"))
    sets = list(combinations(range(len(names)), len(walks)))
    rows, findings = [], []
    for label, path in paths.items():
        distances, rough = _distances(path), _roughness(path)
        ratio = _together(distances, walks)
        rank = sum(_together(distances, s) <= ratio for s in sets)
        rows.append((label, ratio, rank / len(sets), *map(float, rough)))
        findings.append(
            f"{label}: walks lie {ratio:.2f} times as far from each other as from the other "
            f"movements; of all {len(sets)} sets of {len(walks)} movements {rank} are as close "
            f"(p = {rank / len(sets):.3f}). Roughness of its paths: {rough.mean():.2f} on average."
        )
    return Result(
        title="nine movements in a three-dimensional latent space",
        source="public",
        columns=(
            "model",
            "walks apart ÷ from the others",
            "p",
            *(f"roughness, {n}" for n in names),
        ),
        rows=tuple(rows),
        findings=(
            *findings,
            "Distances do not regard time: the mean way to the other movement's nearest frame. "
            "Roughness is the size of a path's second differences over that of its first.",
            "The thesis adds walks of subjects 86, 91, 114 and 139; their recordings are not at "
            f"hand here, so that four more walks of subject 35 ({', '.join(STAND_INS)}) stand in, "
            "folded and cut to 70 frames as the five are. Walks of one subject cluster more "
            "easily than walks of five.",
        ),
        seed=SEED,
        cards=(
            {
                "model": "vae-dmp",
                "what": "walks among nine movements in 3-D, apart over from the others",
                "value": f"{rows[0][1]:.2f}",
                "thesis": "Fig. 48, no numbers",
            },
        ),
        figure=_figure(names, paths),
    )


def _figure(names: list[str], paths: dict[str, Tensor]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.4), layout="constrained")
    for k, (label, path) in enumerate(paths.items()):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        for i, (name, each) in enumerate(zip(names, path, strict=True)):
            walk = name.startswith("walk")
            colour = "0.45" if walk and name != "walking" else f"C{i}"
            axes.plot(*each.T, color=colour, lw=1.6 if walk else 1.2, label=name)
        axes.set(xlabel="z 1", ylabel="z 2", zlabel="z 3", title=label)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    figure.suptitle("Nine movements; the walks that stand in for other subjects are grey")
    return figure
