"""Entries of other installed packages, found by the entry point that they name."""

from __future__ import annotations

import warnings
from importlib.metadata import entry_points

from zoo.contract.registry import Entry, Registry
from zoo.errors import BrokenPluginWarning

__all__ = ["GROUP", "discover"]

GROUP = "movezoo.models"


def discover(registry: Registry) -> None:
    """Register what installed packages offer under the entry point group ``movezoo.models``.

    The object that an entry point names is a :class:`~zoo.contract.registry.Entry` or a list of
    them. A package that fails to give them is named in a BrokenPluginWarning, and the others are
    taken.

    >>> registry = Registry()
    >>> discover(registry)
    """
    for point in entry_points(group=GROUP):
        try:
            found = point.load()
            for entry in [found] if isinstance(found, Entry) else list(found):
                registry.register(entry)
        except (Exception, SystemExit) as error:
            package = point.dist.name if point.dist is not None else "an unknown package"
            warnings.warn(
                f"{point.name} of {package} ({point.value}) does not join the zoo: "
                f"{type(error).__name__}: {error}",
                BrokenPluginWarning,
                stacklevel=2,
            )
