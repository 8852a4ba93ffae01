"""Skeleton of an entry that minibatches of the bound train."""

import zoo

ENTRY = zoo.Entry(
    name="factor-analysis",
    summary="linear latent frames with a noise level per channel",
    thesis="§2.1.5.3",
    model="docs.skeleton.svi.model:FactorModel",
    guide="docs.skeleton.svi.guide:FrameGuide",
    inference=zoo.Svi(epochs=200, batch_size=64, learning_rate=1e-2),
    data="sequences",
    dataset="thesis-movements",
)
