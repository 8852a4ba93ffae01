"""Data sets by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from zoo.datasets.split import nearest
from zoo.datasets.tables import is_file
from zoo.errors import UnknownNameError

__all__ = ["list_data", "load_data", "means_file"]

FILES = "zoo.datasets.tables:load"
LOADERS = {
    "robot-arm": "zoo.datasets.robot_arm:load",
    "robot-arm/held-out": "zoo.datasets.robot_arm:load_held_out",
    "robot-arm/reaching": "zoo.datasets.reaching:load",
    "pendulum": "zoo.datasets.pendulum:load",
    "pendulum/images": "zoo.datasets.pendulum:load_images",
    "thesis-movements": "zoo.datasets.thesis_movements:load",
}


@dataclass(frozen=True, kw_only=True)
class Family:
    """Data sets ``family/member`` whose loader takes the member; ``listed`` are the named ones."""

    loader: str
    listed: tuple[str, ...]


FAMILIES = {
    "cmu-mocap": Family(
        loader="zoo.datasets.cmu_mocap:load",
        listed=("35-walk", "35-run", "49-balance", "07", "08", "35", "49"),
    ),
    "uci": Family(loader="zoo.datasets.uci:load", listed=("concrete", "energy", "yacht")),
}


def list_data() -> list[str]:
    """Names of the data sets; families take more members, such as ``cmu-mocap/35_01``.

    >>> "cmu-mocap/35-walk" in list_data()
    True
    """
    members = [f"{name}/{member}" for name, f in FAMILIES.items() for member in f.listed]
    return [*LOADERS, *members]


def load_data(name: str | Path, *, folder: str | Path | None = None, **options: object) -> Any:
    """The data set of that name, or the movements in a file, as ``Sequences`` or ``Pairs``.

    A name that ends in .csv, .tsv, .txt, .npz or .parquet is a file of one's own, and a folder of
    such files holds movements too: see :func:`zoo.datasets.tables.load`. ``folder`` holds the
    files of a data set; without it ``$MOVEZOO_DATA`` does. ``options`` are those of the data set's
    own loader; an option it does not know is refused.

    >>> data = load_data("robot-arm/reaching", movements=3)
    >>> len(data), data.name
    (3, 'robot-arm/reaching')
    >>> load_data("tesis-movements")
    Traceback (most recent call last):
    zoo.errors.UnknownNameError: no data set 'tesis-movements'; did you mean thesis-movements?
    """
    loader, arguments = _loader(name)
    if folder is not None:
        options["folder"] = folder
    known = [
        p.name for p in inspect.signature(loader).parameters.values() if p.kind is p.KEYWORD_ONLY
    ]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"{name} takes no option {option!r}{nearest(option, known)}")
    return loader(*arguments, **options)


def means_file(name: str) -> bool:
    """Whether :func:`load_data` takes a name for a file or folder of one's own.

    >>> means_file("walk.csv"), means_file("robot-arm")
    (True, False)
    """
    return name not in LOADERS and name.partition("/")[0] not in FAMILIES and is_file(name)


def _loader(name: str | Path) -> tuple[Callable[..., Any], tuple[str, ...]]:
    if not isinstance(name, str | Path):
        raise TypeError(
            f"load_data takes the name of a data set or a file; got {type(name).__name__}: arrays "
            "become a record by zoo.Sequences.from_arrays"
        )
    if isinstance(name, Path):
        return _imported(FILES), (str(name),)
    if name in LOADERS:
        return _imported(LOADERS[name]), ()
    family, _, member = name.partition("/")
    if family in FAMILIES and member:
        return _imported(FAMILIES[family].loader), (member,)
    if means_file(name):
        return _imported(FILES), (name,)
    raise UnknownNameError(f"no data set {name!r}{nearest(name, list_data())}")


def _imported(path: str) -> Callable[..., Any]:
    module, _, function = path.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), function)
    return found
