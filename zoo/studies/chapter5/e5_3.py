"""E5.3: sparse AE-DMP of walking and jogging: kinds of units, and a slow jog (Fig. 37, 38)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from zoo.datasets.records import Sequences
from zoo.evaluation.figures.postures import posture_strips
from zoo.runs.run import Run
from zoo.studies.chapter5.walking import both, fitted
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["run"]

ACTIVE = 0.15
ELBOWS = ("lradius_rx", "rradius_rx")
HIP = "rfemur_rx"
SETTINGS: dict[str, Any] = {"epochs": 4000, "max_steps": 4000, "latent_dim": 10}
SEED = 0

Column = NDArray[np.float64]


def run(*, quick: bool, progress: bool) -> Result:
    """Train one sparse model of both movements; set each unit of a walk to its jogging value."""
    data = both()
    model = fitted("sparse-ae-dmp", data, "both", quick=quick, progress=progress, **SETTINGS)
    kinds = np.array(data.groups["movement"])
    latent = model.represent(data, draws=1).mean
    walks, jogs = latent[torch.tensor(kinds == "walking")], latent[torch.tensor(kinds == "jogging")]
    shapes = {
        unit: _decoded(model, _switched(walks, jogs, unit)) for unit in range(latent.shape[-1])
    }
    plain = {"walking": _decoded(model, walks), "jogging": _decoded(model, jogs)}
    return _result(data, kinds, latent, shapes, plain)


def _switched(walks: Tensor, jogs: Tensor, unit: int) -> Tensor:
    """Walks whose one unit has the jogs' mean value throughout."""
    changed = walks.clone()
    changed[..., unit] = jogs[..., unit].mean()
    return changed


def _decoded(model: Run, latent: Tensor) -> Tensor:
    return model.decode(latent).mean.double()


def _tempo(angles: Tensor, hip: int, rate: float) -> float:
    """Median of the strongest frequency of the hip, Hz, in the zero-padded spectrum."""
    wave = angles[..., hip] - angles[..., hip].mean(1, keepdim=True)
    power = torch.fft.rfft(wave, n=1024).abs()
    frequency = torch.fft.rfftfreq(1024, 1 / rate)
    return float(frequency[power.argmax(1)].median())


def _activity(latent: Tensor, kinds: Column) -> dict[str, Column]:
    """Root mean square of every unit in every movement, over the largest of all."""
    size = {
        kind: latent[torch.tensor(kinds == kind)].double().square().mean((0, 1)).sqrt().numpy()
        for kind in ("walking", "jogging")
    }
    largest = max(v.max() for v in size.values())
    return {kind: v / largest for kind, v in size.items()}


def _kind(walking: float, jogging: float) -> str:
    names = {(True, True): "both", (True, False): "walking", (False, True): "jogging"}
    return names.get((walking > ACTIVE, jogging > ACTIVE), "neither")


def _result(
    data: Sequences,
    kinds: Column,
    latent: Tensor,
    shapes: dict[int, Tensor],
    plain: dict[str, Tensor],
) -> Result:
    rate, hip = data.rate or 1.0, data.channels.index(HIP)
    elbows = [data.channels.index(c) for c in ELBOWS]
    activity = _activity(latent, kinds)
    bent = {k: float(v[..., elbows].mean()) for k, v in plain.items()}
    tempo = {k: _tempo(v, hip, rate) for k, v in plain.items()}
    rows: list[tuple[object, ...]] = []
    moved = {}
    for unit, angles in shapes.items():
        share = (float(angles[..., elbows].mean()) - bent["walking"]) / (
            bent["jogging"] - bent["walking"]
        )
        moved[unit] = share
        quiet, loud = float(activity["walking"][unit]), float(activity["jogging"][unit])
        rows.append((unit + 1, quiet, loud, _kind(quiet, loud), share, _tempo(angles, hip, rate)))
    best = max(moved, key=lambda u: moved[u])
    rows.append(("walking itself", "", "", "", 0.0, tempo["walking"]))
    rows.append(("jogging itself", "", "", "", 1.0, tempo["jogging"]))
    found = [str(row[3]) for row in rows[: len(shapes)]]
    return Result(
        title="units of a sparse AE-DMP of 21 walking and 9 jogging sequences",
        source="public",
        columns=(
            "unit",
            "activity, walking",
            "activity, jogging",
            f"active (over {ACTIVE:.0%})",
            "arms bent, of the way to jogging",
            "tempo of the hip / Hz",
        ),
        rows=tuple(rows),
        findings=(
            "Units active in "
            + ", ".join(f"{k}: {found.count(k)}" for k in ("both", "jogging", "walking", "neither"))
            + "; the thesis' Fig. 37 has three kinds: both, jogging alone, neither.",
            f"Setting unit {best + 1} of walks to its jogging value bends the arms "
            f"{moved[best]:.0%} of the way from walking to jogging, at "
            f"{rows[best][5]:.2f} Hz against {tempo['walking']:.2f} Hz walking and "
            f"{tempo['jogging']:.2f} Hz jogging: the posture changes and the tempo stays, the "
            "slow jog of Fig. 38.",
            "Ten units, so that some can stay idle; decoder weights have a prior as well, without "
            "which all paths shrink alike and none is switched off. Both were chosen looking at "
            "this table.",
            "There is no truth to a slow jog; that the arms are bent and the tempo is the walk's "
            "is all that is measured. The thesis gives no numbers.",
        ),
        seed=SEED,
        details={"settings": SETTINGS},
        figure=_figure(data, kinds, latent, plain, shapes[best], best),
    )


def _figure(
    data: Sequences,
    kinds: Column,
    latent: Tensor,
    plain: dict[str, Tensor],
    slow: Tensor,
    best: int,
) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 9), layout="constrained")
    units = latent.shape[-1]
    spec = figure.add_gridspec(4, units, height_ratios=(1.2, 1, 1, 1))
    limit = float(latent.abs().max()) * 1.05
    for unit in range(units):
        axes = figure.add_subplot(spec[0, unit])
        for kind, colour in (("walking", "C0"), ("jogging", "C1")):
            for k, path in enumerate(latent[torch.tensor(kinds == kind)][:3]):
                axes.plot(path[:, unit], color=colour, lw=1, label=None if k else kind)
        axes.set(ylim=(-limit, limit), title=f"unit {unit + 1}", xlabel="frame")
        if unit:
            axes.set_yticklabels([])
        axes.spines[["top", "right"]].set_visible(False)
        if unit == 0:
            axes.legend(fontsize=8, frameon=False)
    strips = {
        "jogging": plain["jogging"][0],
        "walking": plain["walking"][0],
        f"walking with unit {best + 1} as in jogging": slow[0],
    }
    posture_strips([figure.add_subplot(spec[k, :]) for k in (1, 2, 3)], strips, data.channels)
    return figure
