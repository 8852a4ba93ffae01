"""Skeleton of an entry whose parameters maximise the log evidence."""

import zoo

ENTRY = zoo.Entry(
    name="linear",
    summary="Linear regression of every target, prior and noise by their evidence",
    model="docs.skeleton.marginal_likelihood.model:Linear",
    guide="zoo.guides.exact:ExactPosterior",
    inference=zoo.MarginalLikelihood(iterations=100),
    data="pairs",
    dataset="uci/concrete",
)
