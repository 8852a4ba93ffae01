"""Typed records of movement data: ragged sequences with missing entries, and regression pairs."""

from zoo.datasets.records.checks import Groups
from zoo.datasets.records.pairs import Pairs
from zoo.datasets.records.sequences import Sequences

__all__ = ["Groups", "Pairs", "Sequences", "check_record"]


def check_record(data: object, what: str) -> None:
    """Refuse what is no record, and say how it becomes one.

    >>> check_record([1.0, 2.0], "fit")
    Traceback (most recent call last):
    TypeError: fit takes Sequences or Pairs; got list: zoo.Sequences.from_arrays(...) makes one
    """
    if isinstance(data, Sequences | Pairs):
        return
    remedy = "zoo.Sequences.from_arrays(...) makes one"
    if isinstance(data, str):
        remedy = f"zoo.load_data({data!r}) reads one"
    raise TypeError(f"{what} takes Sequences or Pairs; got {type(data).__name__}: {remedy}")
