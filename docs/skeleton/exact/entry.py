"""Skeleton of an entry in closed form: its guide is the ready-made exact posterior."""

import zoo

ENTRY = zoo.Entry(
    name="posture",
    summary="Every movement is a posture of its own with noise, exact",
    model="docs.skeleton.exact.model:Posture",
    guide="zoo.guides.exact:ExactPosterior",
    inference=zoo.Exact(),
    data="sequences",
    dataset="robot-arm/reaching",
)
