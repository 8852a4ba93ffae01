"""Figures of predictions: reliability, PIT histogram, forecast bands, error over the lead time.

Every function gives a ``matplotlib.figure.Figure`` to save or show; nothing global is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from zoo.evaluation.answers import Answer, Groups
from zoo.evaluation.reliability import Reliability
from zoo.prediction.handing import band_panel
from zoo.prediction.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "forecast_bands", "pit_histogram", "reliability", "spread_over_time"]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_MARKERS = ("o", "s", "^", "D", "v", "P")
_GREY = "#777777"

Answered = (
    tuple[Prediction, Tensor]
    | tuple[Prediction, Tensor, Tensor | None]
    | tuple[Prediction, Tensor, Tensor | None, Groups | None]
)


def reliability(answers: Mapping[str, Answered | Reliability]) -> Figure:
    """Nominal against observed share of truths inside central intervals, a line an answer.

    An answer is (prediction, truth, mask, groups), or the reliability of its scores. Bars are two
    standard errors over groups: on the diagonal within them, the bands keep their promise.
    """
    figure = _figure(5.2, 5.0)
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=_GREY, linewidth=1, linestyle="--", label="perfect")
    for i, (name, answer) in enumerate(answers.items()):
        _reliability_line(axes, name, _reliability(answer), i)
    axes.set(
        xlabel="nominal level of the central interval (%)",
        ylabel="truths inside it (%)",
        xlim=(0, 100),
        ylim=(0, 100),
        aspect="equal",
    )
    axes.text(97, 4, "below the line: overconfident", ha="right", color=_GREY, fontsize=9)
    axes.text(3, 96, "above: too cautious", va="top", color=_GREY, fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(0, 0.93), frameon=False)
    return _clean(figure)


def pit_histogram(answer: Answered | Reliability, *, bins: int = 10) -> Figure:
    """Histogram of the PIT values F(y), flat where the prediction is calibrated."""
    found = _reliability(answer)
    figure = _figure(5.2, 3.4)
    axes = figure.subplots()
    counts = torch.histc(found.pit, bins, 0, 1) / len(found.pit) * bins
    centres = (torch.arange(bins) + 0.5) / bins
    axes.bar(centres.tolist(), counts.tolist(), width=0.92 / bins, color=COLOURS[0])
    axes.axhline(1, color=_GREY, linewidth=1, linestyle="--", label="calibrated")
    axes.set(xlabel="PIT value: predicted P(Y ≤ truth)", ylabel="relative frequency", xlim=(0, 1))
    axes.set_ylim(0, 1.25 * max(1.0, float(counts.max())))
    axes.set_title("heaps at both ends: overconfident; in the middle: too cautious", fontsize=9)
    axes.legend(frameon=False, loc="upper right")
    return _clean(figure)


def forecast_bands(
    prediction: Prediction,
    truth: Tensor | None = None,
    *,
    seen: int | None = None,
    mask: Tensor | None = None,
    sequence: int = 0,
    channels: Sequence[str] | None = None,
) -> Figure:
    """Mean with 50 % and 90 % bands of one movement beside the truth.

    ``truth`` holds whole movements (sequence, frame, channel); its first ``seen`` frames (default
    ``prediction.offset``) were shown to the model. Without ``channels`` the four that move most.
    """
    if prediction.axes[:2] != ("sequence", "time"):
        raise ValueError(f"bands over time need a prediction in time; it has {prediction.axes}")
    start = prediction.offset if seen is None else seen
    whole = None if truth is None else _known(truth, mask)[sequence]
    indices = _chosen(prediction, whole, sequence, channels)
    rows = (len(indices) + 1) // 2
    columns = min(2, len(indices))
    figure = _figure(5.2 * columns, 2.1 * rows + 1.0)
    panels = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    for axes, index in zip(panels, indices, strict=False):
        _bands(axes, prediction, whole, start, sequence, index)
    for axes in panels[len(indices) :]:
        axes.remove()
        panels[len(indices) - 2].tick_params(labelbottom=True)
    labels: dict[str, Artist] = {}
    for axes in figure.axes:
        labels |= {str(k): h for h, k in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.supxlabel("time (s)" if prediction.rate else "frame", fontsize=10)
    figure.legend(
        list(labels.values()), list(labels), loc="outside upper center", ncols=5, frameon=False
    )
    return _clean(figure)


def spread_over_time(
    prediction: Prediction,
    truth: Tensor,
    mask: Tensor | None = None,
    groups: Groups | None = None,
) -> Figure:
    """Predicted standard deviation beside the actual error over the lead time, root mean squares.

    Where the model splits its variance, the part of the observation noise is drawn as well. Units
    must agree over the channels.
    """
    if len(set(prediction.units)) > 1:
        raise ValueError("channels have several units; a common standard deviation needs one")
    answer = Answer.of(prediction, truth, mask, groups)
    figure = _figure(5.6, 3.4)
    axes = figure.subplots()
    time = _time(prediction)
    error = answer.truth - prediction.mean.double()
    axes.plot(time, _root_mean(error, answer), color="black", label="actual error")
    axes.plot(
        time,
        _root_mean(prediction.std, answer),
        color=COLOURS[0],
        label="predicted standard deviation",
    )
    if prediction.effective is not None:
        noise = _root_mean(prediction.aleatoric, answer)
        axes.plot(time, noise, color=COLOURS[0], linestyle=":", label="of which noise")
    axes.set(
        xlabel=_time_label(prediction),
        ylabel=f"root mean square{_in(prediction.units[0])}",
        ylim=(0, None),
    )
    axes.legend(frameon=False)
    return _clean(figure)


def _reliability(answer: Answered | Reliability) -> Reliability:
    return answer if isinstance(answer, Reliability) else Reliability.of(Answer.of(*answer))


def _reliability_line(axes: Axes, name: str, found: Reliability, i: int) -> None:
    nominal, observed = 100 * found.nominal, 100 * found.observed
    axes.plot(nominal.tolist(), observed.tolist(), color=COLOURS[i % len(COLOURS)], linewidth=1.8)
    picks = [9 + 10 * k + 2 * (i % 4) for k in range(9)] + [94]
    axes.errorbar(
        nominal[picks].tolist(),
        observed[picks].tolist(),
        yerr=None if found.error is None else (200 * found.error[picks]).tolist(),
        color=COLOURS[i % len(COLOURS)],
        marker=_MARKERS[i % len(_MARKERS)],
        markersize=4.5,
        linestyle="none",
        elinewidth=1,
        label=f"{name} ({found.groups} groups)",
    )


def _bands(
    axes: Axes,
    prediction: Prediction,
    whole: Tensor | None,
    start: int,
    sequence: int,
    index: int,
) -> None:
    frames = prediction.shape[1] if prediction.task == "forecast" else 0
    offset = start if frames else 0
    time = _time(prediction, offset)[: _length(prediction, sequence)]
    band_panel(axes, prediction, sequence, index, time)
    if whole is not None:
        rate = prediction.rate or 1.0
        when = [t / rate for t in range(len(whole))]
        path = whole[:, index].tolist()
        axes.plot(when, path, color="black", linewidth=1.1, linestyle="--", label="truth")
        if frames:
            axes.plot(when[:start], path[:start], color="black", linewidth=2, label="observed")
            axes.axvline(start / rate, color=_GREY, linewidth=0.8, linestyle=":")
    axes.set_title(prediction.names[index], fontsize=10, loc="left")
    axes.set_ylabel(prediction.units[index] or "value")


def _chosen(
    prediction: Prediction, whole: Tensor | None, sequence: int, channels: Sequence[str] | None
) -> list[int]:
    if channels is not None:
        return [prediction.channel(name) for name in channels]
    path = prediction.mean[sequence] if whole is None else whole
    movement = path.nan_to_num().double().std(0)
    count = min(4, len(prediction.names))
    return sorted(movement.topk(count).indices.tolist())


def _known(truth: Tensor, mask: Tensor | None) -> Tensor:
    return truth if mask is None else torch.where(mask.bool(), truth, torch.nan)


def _length(prediction: Prediction, sequence: int) -> int:
    return prediction.shape[1] if prediction.lengths is None else int(prediction.lengths[sequence])


def _time(prediction: Prediction, offset: int | None = None) -> list[float]:
    first = prediction.offset if offset is None else offset
    return [(first + t) / (prediction.rate or 1.0) for t in range(prediction.shape[1])]


def _time_label(prediction: Prediction) -> str:
    return "time (s)" if prediction.rate else "frame"


def _in(unit: str) -> str:
    return f" ({unit})" if unit else ""


def _root_mean(values: Tensor, answer: Answer) -> list[float]:
    squares = torch.where(answer.mask, values.double().square(), 0.0).sum((0, 2))
    return (squares / answer.mask.sum((0, 2))).sqrt().tolist()


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", dpi=110)


def _clean(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    return figure
