"""Predictions as labelled arrays, for xarray, NetCDF files and whoever reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from zoo.prediction.prediction import Prediction

if TYPE_CHECKING:
    import xarray

__all__ = ["dataset"]


def dataset(
    prediction: Prediction,
    groups: Mapping[str, Sequence[str]] | None = None,
    *,
    levels: Sequence[float] = (0.5, 0.9),
) -> xarray.Dataset:
    """Mean, standard deviation and central intervals with named axes, units and group columns.

    ``lower`` and ``upper`` have a ``level`` axis in front; a deterministic prediction has the mean
    alone. Time is in s from the start of the movement where the rate is known, else in frames.

    >>> import torch
    >>> from zoo.prediction.predictive import Predictive
    >>> p = Prediction(predictive=Predictive(location=torch.zeros(1, 2, 3, 1), noise=torch.ones(1)),
    ...     axes=("sequence", "time", "channel"), names=("hip",), units=("rad",), task="forecast",
    ...     rate=10.0, offset=5)
    >>> found = dataset(p, {"trial": ["a", "b"]})
    >>> dict(found.sizes), found.time.values.tolist()
    ({'sequence': 2, 'time': 3, 'channel': 1, 'level': 2}, [0.5, 0.6, 0.7])
    """
    import numpy as np
    import xarray

    axes, last = prediction.axes, prediction.axes[-1]
    arrays = {"mean": (axes, prediction.mean.numpy())}
    coordinates: dict[str, object] = {last: list(prediction.names)}
    coordinates["unit"] = (last, list(prediction.units))
    for column, values in (groups or {}).items():
        coordinates[column] = (axes[0], list(values))
    if "time" in axes:
        seconds = prediction.seconds
        frames = np.arange(prediction.shape[1]) + prediction.offset
        coordinates["time"] = frames if seconds is None else seconds.numpy()
    if prediction.has_spread:
        arrays["std"] = (axes, prediction.std.numpy())
        intervals = [prediction.interval(level) for level in levels]
        for i, end in enumerate(("lower", "upper")):
            arrays[end] = (("level", *axes), np.stack([ends[i].numpy() for ends in intervals]))
        coordinates["level"] = list(levels)
    description = {"task": prediction.task, "time_unit": "s" if prediction.rate else "frame"}
    return xarray.Dataset(arrays, coordinates, description)
