"""Entries by name: what an entry is, and how one joins the zoo."""

from __future__ import annotations

import difflib
import fnmatch
import importlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from zoo.contract.methods import methods
from zoo.contract.strategies import Inference
from zoo.display import facts
from zoo.errors import UnknownNameError

__all__ = ["CAPABILITIES", "Entry", "Part", "Registry", "Scaling", "load", "named_well"]

Part = str | type
Scaling = Literal["standard", "center", "range", "none"]
Data = Literal["sequences", "pairs"]
CAPABILITIES = ("regress", "represent", "reconstruct", "forecast", "impute", "generate", "act")
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One selectable model: generative model + guide + inference.

    ``name``: small letters, digits and single hyphens; ``summary``: one line for ``zoo list``;
    ``thesis``: the section it is of, or where it is from. ``model`` and ``guide`` are import paths
    ``module:Class``, which are read and not imported by ``zoo list``, or the classes themselves,
    such as those of a notebook; ``guide`` is None for a baseline. ``inference`` is
    :class:`~zoo.contract.strategies.Svi`, :class:`~zoo.contract.strategies.Exact` or
    :class:`~zoo.contract.strategies.MarginalLikelihood`; ``data`` the kind of records; ``dataset``
    the data set that ``zoo fit`` takes where none is named; ``scaling`` how the run scales data;
    ``config`` overrides defaults of the model's and the guide's ``Config``.

    What the classes must have is written in :mod:`zoo.contract.parts` and
    :mod:`zoo.contract.capabilities`; an entry of each inference is in ``docs/skeleton``.

    >>> class Mine:
    ...     def forecast(self, batch, posterior, *, horizon, draws): ...
    >>> from zoo.contract.strategies import Exact
    >>> Entry(name="my-own", summary="nothing yet", model=Mine, guide=None, inference=Exact(),
    ...     data="sequences").capabilities
    ('forecast',)
    """

    name: str
    summary: str
    model: Part
    guide: Part | None
    inference: Inference
    data: Data
    thesis: str = "not in the thesis"
    dataset: str | None = None
    scaling: Scaling = "standard"
    config: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what no command could use, and say what is needed."""
        if not named_well(self.name):
            raise ValueError(
                "name must be small letters and digits with single hyphens between, such as "
                f"'factor-analysis'; got {self.name!r}"
            )
        for what in ("model", "guide"):
            _check_part(self.name, what, getattr(self, what))
        if not isinstance(self.inference, get_args(Inference)):
            raise TypeError(
                f"{self.name}: inference must be zoo.Svi(…), zoo.Exact() or "
                f"zoo.MarginalLikelihood(…); got {self.inference!r}"
            )
        for what, kinds in (("data", get_args(Data)), ("scaling", get_args(Scaling))):
            value = getattr(self, what)
            if value not in kinds:
                raise ValueError(f"{self.name}: {what} is one of {', '.join(kinds)}; got {value!r}")

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "what it is": self.summary,
            "from": self.thesis,
            "guide": self.posterior,
            "inference": type(self.inference).__name__,
            "data": self.data,
            "can": self.capabilities,
        }
        return facts(self.name, rows)

    @property
    def posterior(self) -> str:
        """The guide in words, such as ``exact posterior``, or ``none``."""
        if self.guide is None:
            return "none"
        name = self.guide.__name__ if isinstance(self.guide, type) else self.guide.split(":")[1]
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()

    @property
    def capabilities(self) -> tuple[str, ...]:
        """Tasks that the model's class has a method for."""
        known = dir(self.model) if isinstance(self.model, type) else methods(self.model)
        return tuple(c for c in CAPABILITIES if c in known)

    @property
    def importable(self) -> bool:
        """Whether another process can import the classes: not those of a notebook."""
        kinds = [part for part in (self.model, self.guide) if isinstance(part, type)]
        return all(
            hasattr(sys.modules.get(k.__module__), "__file__") and "<locals>" not in k.__qualname__
            for k in kinds
        )


class Registry:
    """Entries by name; a name can be taken once.

    ``discover`` is called once, before entries that are not given here are first asked for; it
    registers those of other packages.
    """

    def __init__(
        self,
        entries: Iterable[Entry] = (),
        *,
        discover: Callable[[Registry], None] | None = None,
    ) -> None:
        """Hold ``entries`` in order."""
        self._entries: dict[str, Entry] = {}
        self._joined: set[str] = set()
        for entry in entries:
            self._add(entry)
        self._discover = discover

    @property
    def joined(self) -> tuple[Entry, ...]:
        """Entries that were registered after the first ones."""
        return tuple(entry for entry in self if entry.name in self._joined)

    def register(self, entry: Entry, *, replace: bool = False) -> None:
        """Add an entry from outside; a name that is taken is refused.

        ``replace`` takes it in place of one that was registered from outside before. A model that
        cannot be found, or has no method that answers a task, is refused.
        """
        if not isinstance(entry, Entry):
            raise TypeError(f"a zoo.Entry is needed; got {type(entry).__name__}")
        self._complete()
        if not entry.capabilities:
            raise ValueError(
                f"{entry.name}: {entry.model} answers no task; give it a method "
                f"{', '.join(CAPABILITIES)}"
            )
        if replace and entry.name in self._joined:
            del self._entries[entry.name]
        self._add(entry)
        self._joined.add(entry.name)

    def __getitem__(self, name: str) -> Entry:
        """The entry of that name; an unknown name lists the nearest ones."""
        if not isinstance(name, str):
            raise TypeError(f"a model is named by text, such as 'vae-dmp'; got {name!r}")
        if name not in self._entries:
            self._complete()
        if name not in self._entries:
            near = difflib.get_close_matches(name, self._entries, n=3, cutoff=0.4)
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise UnknownNameError(f"no model {name!r}{hint} (`zoo list` names all)")
        return self._entries[name]

    def __iter__(self) -> Iterator[Entry]:
        """Entries in the order of registration."""
        self._complete()
        return iter(self._entries.values())

    def _repr_html_(self) -> str:
        rows = {e.name: f"{e.summary}; can {', '.join(e.capabilities)}" for e in self}
        return facts("Models", rows)

    def names(self, pattern: str = "*", *, can: str | None = None) -> list[str]:
        """Names that match a glob and, where ``can`` is given, have that capability."""
        if not isinstance(pattern, str):
            raise TypeError(f"a pattern of names is text, such as '*dmp*'; got {pattern!r}")
        if can is not None and not (isinstance(can, str) and can in CAPABILITIES):
            raise UnknownNameError(f"no capability {can!r}; there are {', '.join(CAPABILITIES)}")
        return [
            e.name
            for e in self
            if fnmatch.fnmatch(e.name, pattern) and (can is None or can in e.capabilities)
        ]

    def _complete(self) -> None:
        """Let entries of other packages join, once."""
        discover, self._discover = self._discover, None
        if discover is not None:
            discover(self)

    def _add(self, entry: Entry) -> None:
        if entry.name in self._entries:
            way = "replace=True takes this one" if entry.name in self._joined else "take another"
            raise ValueError(f"model {entry.name!r} is registered already: {way}")
        self._entries[entry.name] = entry


def load(part: Part) -> Any:
    """The class behind ``module:Class``; a class is itself."""
    if isinstance(part, type):
        return part
    module, _, name = part.partition(":")
    return getattr(importlib.import_module(module), name)


def named_well(name: object) -> bool:
    """Whether an entry may have this name.

    >>> named_well("factor-analysis"), named_well("Factor analysis")
    (True, False)
    """
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def _check_part(entry: str, what: str, part: object) -> None:
    """A class, an import path, or None for a guide."""
    if isinstance(part, type) or (part is None and what == "guide"):
        return
    if not isinstance(part, str) or not _PATH.fullmatch(part):
        raise ValueError(f"{entry}: {what} must be a class or 'module:Class'; got {part!r}")
