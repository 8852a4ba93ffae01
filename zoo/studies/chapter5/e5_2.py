"""E5.2: what the f_target term does, smoothness of latent paths, R² of joints (Fig. 34–36)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.library import load_data
from zoo.datasets.records import Sequences
from zoo.runs.run import Run, create
from zoo.studies.chapter5 import e5_1
from zoo.studies.kept import trained
from zoo.studies.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["run"]

OFF = 1e-9
WITH, WITHOUT, APART = "with f_target", "without", "non-integrated"
SEED = 0

Column = NDArray[np.float64]
Paths = dict[tuple[str, str], tuple[Column, Column]]


def run(*, quick: bool, progress: bool) -> Result:
    """AE-DMP with and without its second term, and the two parts trained one after the other."""
    data = load_data("thesis-movements")
    names = [str(m).replace("_", " ") for m in data.groups["movement"]]
    paths: Paths = {}
    accuracy: dict[str, list[Column]] = {}
    for i, name in enumerate(names):
        one = data[i : i + 1]
        runs = {
            WITH: e5_1.fitted("ae-dmp", one, name, quick, progress),
            WITHOUT: _without(one, name, quick, progress),
            APART: e5_1.fitted("ae-then-dmp", one, name, quick, progress),
        }
        for label, found in runs.items():
            paths[name, label] = _latent(found, one)
        rest = {"DMP": "dmp", "PCA-DMP": "pca-dmp"}
        plain = {k: e5_1.fitted(m, one, name, quick, progress) for k, m in rest.items()}
        shown = {"AE-DMP": runs[WITH], APART: runs[APART], **plain}
        for label, found in shown.items():
            accuracy.setdefault(label, []).append(_r2(found, one))
    return _result(names, paths, accuracy)


def _without(data: Sequences, label: str, quick: bool, progress: bool) -> Run:
    settings: dict[str, Any] = {"penalty": OFF} | ({"epochs": 20} if quick else {})
    assembly = create("ae-dmp", data, seed=SEED, **settings)
    return trained(assembly, data, "E5.2", label, progress=progress)


def _latent(run: Run, data: Sequences) -> tuple[Column, Column]:
    """Encoded path and its roll-out by the DMP, (time, latent)."""
    encoded, _ = run.encode(data)
    rolled = run.represent(data, draws=1).mean
    return encoded[0].double().numpy(), rolled[0].double().numpy()


def _r2(run: Run, data: Sequences) -> Column:
    """√R² of every joint, 0 where it is negative or the joint does not move."""
    truth = data.values[0].double().numpy()
    error = ((run.reconstruct(data).mean[0].double().numpy() - truth) ** 2).sum(0)
    spread = ((truth - truth.mean(0)) ** 2).sum(0)
    share = 1 - error / np.maximum(spread, 1e-12)
    root: Column = np.sqrt(share.clip(0, 1))
    return root


def _misfit(found: tuple[Column, Column]) -> float:
    """RMS of encoded path less roll-out, over the standard deviation of the path."""
    encoded, rolled = found
    apart, spread = encoded - rolled, encoded - encoded.mean(0)
    return float(np.sqrt((apart**2).mean() / (spread**2).mean()))


def _jerk(found: tuple[Column, Column]) -> float:
    """RMS of third differences of the encoded path over that of first differences."""
    path = found[0]
    return float(
        np.sqrt((np.diff(path, n=3, axis=0) ** 2).mean() / (np.diff(path, axis=0) ** 2).mean())
    )


def _result(names: list[str], paths: Paths, accuracy: dict[str, list[Column]]) -> Result:
    labels = (WITH, WITHOUT, APART)
    measures = {"misfit of the DMP": _misfit, "jerkiness of the path": _jerk}
    found = {
        (what, label): [of(paths[name, label]) for name in names]
        for what, of in measures.items()
        for label in labels
    }
    rows: list[tuple[object, ...]] = [
        (f"{what}, {label}", *values, float(np.mean(values)))
        for (what, label), values in found.items()
    ]
    for label, roots in accuracy.items():
        means = [float(r.mean()) for r in roots]
        rows.append((f"√R², mean of joints, {label}", *means, float(np.mean(means))))
    misfit = {label: float(np.mean(found["misfit of the DMP", label])) for label in labels}
    jerk = {label: float(np.mean(found["jerkiness of the path", label])) for label in labels}
    return Result(
        title="the f_target term, smoothness of latent paths and R² of joints",
        source="thesis",
        columns=("quantity", *names, "mean"),
        rows=tuple(rows),
        findings=(
            f"The DMP misses the encoded path by {misfit[WITH]:.3f} of its spread with the term, "
            f"by {misfit[WITHOUT]:.3f} without (Fig. 34), by {misfit[APART]:.3f} where "
            "autoencoder and DMP are not integrated.",
            f"Third over first differences of the encoded path: {jerk[WITH]:.2f} with the term, "
            f"{jerk[WITHOUT]:.2f} without, {jerk[APART]:.2f} not integrated (Fig. 35: smooth "
            "against jerky).",
            "The thesis gives no numbers for Fig. 34–36. Without means λ = 1e-9 in place of 1e-3.",
        ),
        seed=SEED,
        figure=_figure(names, paths, accuracy),
    )


def _figure(names: list[str], paths: Paths, accuracy: dict[str, list[Column]]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8.5), layout="constrained")
    spec = figure.add_gridspec(3, 3, height_ratios=(1, 1, 1.3))
    for row, name in enumerate(("walking", "kicking")):
        for column, label in enumerate((WITH, WITHOUT, APART)):
            axes = figure.add_subplot(spec[row, column])
            _compared(axes, paths[name, label])
            axes.set_title(f"{name}, {label}", fontsize=10)
            if row == column == 0:
                axes.legend(fontsize=8, frameon=False)
    axes = figure.add_subplot(spec[2, :])
    stack = np.concatenate([np.stack(roots) for roots in accuracy.values()])
    image = axes.imshow(stack, cmap="gray_r", vmin=0, vmax=1, aspect="auto")
    axes.set_yticks(range(len(stack)), [f"{m}, {n}" for m in accuracy for n in names], fontsize=7)
    for k in range(1, len(accuracy)):
        axes.axhline(k * len(names) - 0.5, color="C3", lw=0.8)
    axes.set(xlabel="joint", title="√R² of every joint (Fig. 36)")
    figure.colorbar(image, ax=axes)
    return figure


def _compared(axes: Axes, found: tuple[Column, Column]) -> None:
    """The latent dimension in which the path varies most."""
    encoded, rolled = found
    wide = int(encoded.var(0).argmax())
    axes.plot(encoded[:, wide], color="C3", lw=1, label="encoded")
    axes.plot(rolled[:, wide], color="C0", lw=1, label="DMP")
    axes.set(xlabel="frame", ylabel=f"hidden neuron {wide + 1}")
    axes.spines[["top", "right"]].set_visible(False)
