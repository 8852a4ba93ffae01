"""Typed records of movement data: ragged sequences with missing entries, and regression pairs."""

from zoo.datasets.checks import Groups
from zoo.datasets.pairs import Pairs
from zoo.datasets.sequences import Sequences

__all__ = ["Groups", "Pairs", "Sequences"]
