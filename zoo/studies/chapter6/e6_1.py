"""E6.1: five movements in one VAE-DMP and each in its own (§6.3.1.1, Table 2, Fig. 45)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.runs.run import Run, create
from zoo.studies.chapter6.process_noise import NoiseShare, noise_share
from zoo.studies.kept import trained
from zoo.studies.result import Result, Section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["AE_DMP", "run"]

AE_DMP = {"walking": 3.3, "balance": 2.8, "kicking": 2.3, "tai chi": 3.4, "punching": 1.5}
DIMENSIONS = (2, 3, 5, 7)
UNIT = 1e-4
SEED = 0

Errors = dict[str, NDArray[np.float64]]


def run(*, quick: bool, progress: bool) -> Result:
    """Train every model of Fig. 45 and compare mean square errors of the reconstruction."""
    data = load_data("thesis-movements")
    names = [m.replace("_", " ") for m in data.groups["movement"]]
    single = [
        _fitted("vae-dmp-single", data[i : i + 1], 5, m, quick, progress)
        for i, m in enumerate(names)
    ]
    shared = {d: _fitted("vae-dmp", data, d, f"{d}d", quick, progress) for d in DIMENSIONS}
    errors: Errors = {
        "AE-DMP single (thesis)": np.array([AE_DMP[m] for m in names]),
        "VAE-DMP single 5-D": np.array(
            [_errors(r, data[i : i + 1])[0] for i, r in enumerate(single)]
        ),
        **{f"VAE-DMP {d}-D": _errors(r, data) for d, r in shared.items()},
    }
    rollouts = {
        "VAE-DMP single 5-D": np.array(
            [_rollout(r, data[i : i + 1])[0] for i, r in enumerate(single)]
        ),
        "VAE-DMP 5-D": _rollout(shared[5], data),
    }
    spreads = {f"VAE-DMP {d}-D": _spread(r, data) for d, r in shared.items()}
    spreads["VAE-DMP single 5-D"] = float(
        np.mean([_spread(r, data[i : i + 1]) for i, r in enumerate(single)])
    )
    noise = {
        "VAE-DMP single 5-D": [noise_share(r, data[i : i + 1])[0] for i, r in enumerate(single)],
        **{f"VAE-DMP {d}-D": noise_share(r, data) for d, r in shared.items()},
    }
    return _result(names, errors, rollouts, spreads, noise, [*single, *shared.values()])


def _fitted(
    name: str, data: Sequences, latent: int, label: str, quick: bool, progress: bool
) -> Run:
    settings: dict[str, Any] = {"epochs": 5} if quick else {}
    assembly = create(name, data, seed=SEED, latent_dim=latent, **settings)
    return trained(assembly, data, "E6.1", label, progress=progress)


def _errors(run: Run, data: Sequences) -> NDArray[np.float64]:
    """MSE of each movement's reconstruction by the filtered states, 1e-4 rad²."""
    return _mse(run.reconstruct(data, draws=200).mean.double().numpy(), data)


def _rollout(run: Run, data: Sequences) -> NDArray[np.float64]:
    """MSE of each movement rolled out from its first state, forcing and goal, 1e-4 rad²."""
    return _mse(run.generate(data, draws=200).mean.double().numpy(), data)


def _mse(mean: NDArray[np.float64], data: Sequences) -> NDArray[np.float64]:
    error = (mean - data.values.double().numpy()) ** 2
    mse: NDArray[np.float64] = error.mean((1, 2)) / UNIT
    return mse


def _spread(run: Run, data: Sequences) -> float:
    """Mean predicted standard deviation, rad."""
    return float(run.reconstruct(data, draws=200).std.mean())


def _result(
    names: list[str],
    errors: Errors,
    rollouts: Errors,
    spreads: Mapping[str, float],
    noise: Mapping[str, list[NoiseShare]],
    runs: list[Run],
) -> Result:
    rows = [(model, *map(float, e), float(e.mean())) for model, e in errors.items()]
    rows += [(f"{m}, roll-out only", *map(float, e), float(e.mean())) for m, e in rollouts.items()]
    reference = errors["AE-DMP single (thesis)"]
    single, shared = errors["VAE-DMP single 5-D"], errors["VAE-DMP 5-D"]
    return Result(
        title="reconstruction error of five movements, MSE in 1e-4 rad²",
        source="thesis",
        columns=("model", *names, "mean"),
        rows=tuple(rows),
        findings=(
            _compared("VAE-DMP single 5-D", single, reference, names),
            _compared("VAE-DMP 5-D, one model for all,", shared, reference, names),
            "Mean predicted standard deviation, rad: "
            + ", ".join(f"{m} {s:.4f}" for m, s in spreads.items()),
            "The states are those of the guide's filter, as in the thesis; 'roll-out only' starts "
            "from the first frame and has no noise to correct the path. Where both rows agree the "
            "model found the noise needless: the forcing term alone carries the movement.",
            _collapse(noise),
        ),
        sections=(_noise(names, noise),),
        seed=SEED,
        details={
            "trainings": "kept under runs/E6.1, continued when the command is repeated unchanged",
            "scored": "frames trained on, as in Table 2 and Fig. 45",
            "training_seconds": [round(sum(e["seconds"] for e in r.history), 1) for r in runs],
            "settings": [dict(r.assembly.settings) for r in runs],
        },
        cards=(
            _sentence("vae-dmp-single", single, reference),
            _sentence("vae-dmp", shared, reference),
        ),
        figure=_figure(names, errors),
    )


def _noise(names: list[str], noise: Mapping[str, list[NoiseShare]]) -> Section:
    """What ε (79) carries of every movement."""
    rows = [
        (model, name, s.nats, 100 * s.of_divergence, s.active, 100 * s.of_variance)
        for model, shares in noise.items()
        for name, s in zip(names, shares, strict=True)
    ]
    columns = ("model", "movement", "KL of ε, nats", "% of the KL", "active units")
    return Section(
        title="What the process noise ε (79) carries",
        columns=(*columns, "% of the path's variance"),
        rows=tuple(rows),
    )


def _collapse(noise: Mapping[str, list[NoiseShare]]) -> str:
    shares = [s for found in noise.values() for s in found]
    idle, lost = sum(s.active == 0 for s in shares), [100 * s.of_variance for s in shares]
    return (
        f"In {idle} of {len(shares)} movements no unit of ε is active (0.01 nats a frame); without "
        f"it the paths lose {np.mean(lost):.2g} % of their variance on average, and "
        f"{max(lost):.2g} % at most."
    )


def _compared(
    model: str, ours: NDArray[np.float64], theirs: NDArray[np.float64], names: list[str]
) -> str:
    worse = [n for n, a, b in zip(names, ours, theirs, strict=True) if a >= b]
    where = f"worse in {', '.join(worse)}" if worse else "better in every movement"
    return (
        f"{model} has a mean of {ours.mean():.2f} against {theirs.mean():.2f} of the published "
        f"AE-DMP and is {where}."
    )


def _sentence(model: str, ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> dict[str, str]:
    return {
        "model": model,
        "what": "reconstruction of the five movements, mean MSE, 5-D",
        "value": f"{ours.mean():.2f}e-4 rad²",
        "thesis": f"AE-DMP {theirs.mean():.2f}e-4 rad²",
    }


def _figure(names: list[str], errors: Errors) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(errors)
    for k, (model, values) in enumerate(errors.items()):
        colour = "0.35" if "thesis" in model else f"C{k - 1}"
        axes.bar(
            np.arange(len(names)) + (k - len(errors) / 2 + 0.5) * width,
            values,
            width,
            label=model,
            color=colour,
        )
    axes.set_yscale("log")
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("MSE / 1e-4 rad²")
    axes.set_title("Reconstruction error of five movements (70 frames × 50 joints)")
    figure.legend(loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure
