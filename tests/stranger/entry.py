"""The entry of Gaussian-process factor analysis; a package names it as an entry point."""

import zoo

ENTRY = zoo.Entry(
    name="gpfa",
    summary="Linear latent trajectories that are Gaussian processes over time",
    model="stranger.gpfa:GPFA",
    guide="zoo.guides.exact:ExactPosterior",
    inference=zoo.MarginalLikelihood(iterations=100),
    data="sequences",
    dataset="robot-arm/reaching",
)
