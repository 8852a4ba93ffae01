"""Guides that a user may ask for in place of an entry's own, and how they are trained."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from zoo.contract.registry import Entry
from zoo.contract.strategies import Svi
from zoo.errors import UnknownNameError

__all__ = ["AUTOMATIC", "Name", "with_guide"]

Name = Literal["auto-delta", "auto-normal", "auto-multivariate-normal"]
AUTOMATIC = {
    "auto-delta": "zoo.guides.automatic:Delta",
    "auto-normal": "zoo.guides.automatic:Normal",
    "auto-multivariate-normal": "zoo.guides.automatic:MultivariateNormal",
}
_TRAINED = Svi(window=None, epochs=1000, batch_size=256, learning_rate=1e-2, max_steps=20_000)


def with_guide(entry: Entry, name: str | None) -> Entry:
    """The entry with an automatic guide, which minibatches of the bound train; None: its own.

    >>> from zoo.catalogue import CATALOGUE
    >>> with_guide(CATALOGUE["vfe"], "auto-normal").guide
    'zoo.guides.automatic:Normal'
    """
    if name is None:
        return entry
    if name not in AUTOMATIC:
        raise UnknownNameError(f"guide is one of {', '.join(AUTOMATIC)}; got {name!r}")
    return replace(entry, guide=AUTOMATIC[name], inference=_TRAINED)
