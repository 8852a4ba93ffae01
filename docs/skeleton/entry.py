"""Skeleton of an entry: these ten lines go into ``zoo/catalogue.py``, with ``zoo.`` paths."""

from zoo.registry import Entry
from zoo.strategies import Svi

ENTRY = Entry(
    name="factor-analysis",
    summary="linear latent frames with a noise level per channel",
    thesis="§2.1.5.3",
    model="docs.skeleton.model:FactorModel",
    guide="docs.skeleton.guide:FrameGuide",
    inference=Svi(epochs=200, batch_size=64, learning_rate=1e-2),
    data="sequences",
    dataset="thesis-movements",
)
