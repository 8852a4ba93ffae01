"""A model, a guide and an inference strategy bound to the layout of some data, not yet trained."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast, get_args, get_type_hints

import pyro
import torch
from torch import nn

from zoo.arguments import seed_of
from zoo.catalogue import CATALOGUE
from zoo.contract import automatic
from zoo.contract.registry import Entry, Part, Scaling, load
from zoo.contract.settings import made
from zoo.contract.strategies import Inference, Svi
from zoo.datasets.records import Pairs, Sequences, check_record
from zoo.display import facts
from zoo.errors import UnknownNameError
from zoo.inference.elbo import Program
from zoo.streams import seeded
from zoo.types import Batch, Layout

__all__ = ["Assembly", "assemble", "create", "options"]


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """What ``zoo.create`` returns: everything that training needs but the data.

    ``settings`` are the keywords that the user gave; with the entry, the layout and the seed they
    determine the initial parameters bit for bit.
    """

    entry: Entry
    layout: Layout
    model: nn.Module
    guide: nn.Module | None
    inference: Inference
    settings: Mapping[str, Any]
    scaling: Scaling
    seed: int
    device: str

    def __repr__(self) -> str:
        """Entry, layout and settings in one line."""
        given = "".join(f", {k}={v!r}" for k, v in self.settings.items())
        return (
            f"Assembly of {self.entry.name} for {len(self.layout.channels)} channels or targets: "
            f"{self.parameters()} parameters, {type(self.inference).__name__}, "
            f"seed={self.seed}{given}"
        )

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "what it is": self.entry.summary,
            "channels or targets": self.layout.channels,
            "can": self.entry.capabilities,
            "parameters": self.parameters(),
            "guide": "none" if self.guide is None else type(self.guide).__name__,
            "inference": type(self.inference).__name__,
            "scaling": self.scaling,
            "seed": self.seed,
            "settings given": tuple(f"{k}={v!r}" for k, v in self.settings.items()),
        }
        return facts(f"{self.entry.name}, not trained yet", rows)

    @property
    def dtype(self) -> torch.dtype:
        """Number type that the model computes in."""
        return self.model.dtype  # type: ignore[return-value]

    def parameters(self) -> int:
        """Number of trainable numbers in model and guide."""
        modules = [self.model] + ([] if self.guide is None else [self.guide])
        return sum(p.numel() for m in modules for p in m.parameters() if p.requires_grad)

    def programs(self) -> tuple[Program, Program]:
        """Model and guide for Pyro's own inference, their parameters in its parameter store.

        ``pyro.infer.SVI`` learns what it finds there; of the bare modules it finds nothing. The
        names are those of the parts, so that ``pyro.clear_param_store()`` comes before another
        training. The guide of an entry without one draws nothing.

        >>> import numpy as np, pyro, torch, zoo
        >>> from pyro.infer import SVI, Predictive, Trace_ELBO
        >>> from zoo.inference.loader import whole
        >>> x = np.random.default_rng(0).normal(size=(4, 20, 3))
        >>> data = zoo.Sequences.from_arrays(x, rate=30.0).to(dtype=torch.float32)
        >>> assembly, batch = zoo.create("vae", data, latent_dim=2), whole(data)
        >>> model, guide = assembly.programs()
        >>> loss = SVI(model, guide, pyro.optim.Adam({"lr": 1e-3}), Trace_ELBO()).step(batch)
        >>> model(batch.unobserved()).shape
        torch.Size([4, 20, 3])
        >>> prior = Predictive(model, num_samples=7, parallel=True)
        >>> prior(batch.unobserved())["x"].shape
        torch.Size([7, 4, 20, 3])
        >>> posterior = Predictive(model, guide=guide, num_samples=7, parallel=True)
        >>> posterior(batch.unobserved())["x"].shape
        torch.Size([7, 4, 20, 3])
        """
        return partial(_registered, "model", self.model), partial(_registered, "guide", self.guide)


def _registered(name: str, part: nn.Module | None, batch: Batch) -> Any:
    if part is None:
        return None
    pyro.module(name, part)
    return part(batch)


def create(
    name: str,
    data: Sequences | Pairs,
    *,
    seed: int = 0,
    device: str = "cpu",
    **settings: Any,
) -> Assembly:
    """Bind the entry ``name`` to the layout of ``data``; keywords override its settings.

    Every keyword goes to each part that has a field of that name: the model's and the guide's
    ``Config`` and the inference strategy. An unknown keyword or model lists the nearest names.
    Fewer ``epochs`` than the entry's shorten its tempering and warm-up in proportion, unless these
    are given too. ``guide="auto-normal"`` (or ``"auto-delta"``, ``"auto-multivariate-normal"``)
    replaces the entry's guide by one that Pyro makes, trained on minibatches of the bound; models
    whose latent sites belong to single windows, movements or items refuse it.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> zoo.create("pca", data, latent_dim=2).model.config.latent_dim
    2
    """
    entry = CATALOGUE[name]
    check_record(data, "create")
    return assemble(entry, data.layout, settings, seed=seed_of(seed), device=device)


def assemble(
    entry: Entry, layout: Layout, settings: Mapping[str, Any], *, seed: int, device: str
) -> Assembly:
    """Build model and guide of ``entry`` for ``layout`` from a seed."""
    if layout.kind != entry.data:
        raise ValueError(f"{entry.name} needs {entry.data}; got {layout.kind}")
    entry = automatic.with_guide(entry, settings.get("guide"))
    known = {*options(entry), "guide"}
    for key in settings:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=3, cutoff=0.4) or sorted(known)
            raise UnknownNameError(
                f"{entry.name} has no setting {key!r}; nearest: {', '.join(near)}"
            )
    values = {**entry.config, **settings}
    model_class = _part(entry, entry.model, "config_class", "dtype")
    guide_class = None if entry.guide is None else _part(entry, entry.guide, "config_class")
    with seeded(seed):
        model = model_class(layout, _config(entry, model_class.config_class, values))
        guide = None
        if guide_class is not None:
            guide = guide_class(layout, model, _config(entry, guide_class.config_class, values))
    model = model.to(device=_usable(device), dtype=model_class.dtype)
    guide = None if guide is None else guide.to(device=device, dtype=model_class.dtype)
    return Assembly(
        entry=entry,
        layout=layout,
        model=model,
        guide=guide,
        inference=_strategy(entry, values),
        settings=dict(settings),
        scaling=_scaling(values.get("scaling", entry.scaling)),
        seed=seed,
        device=device,
    )


def options(entry: Entry) -> dict[str, tuple[str, Any, Any]]:
    """Settings of an entry: name → (part, type, default), from the parts' own dataclasses."""
    found: dict[str, tuple[str, Any, Any]] = {}
    for part, path in (("guide", entry.guide), ("model", entry.model)):
        if path is not None:
            config_class = _part(entry, path, "config_class").config_class
            kinds = get_type_hints(config_class)
            for field in dataclasses.fields(config_class):
                default = entry.config.get(field.name, field.default)
                found[field.name] = (part, kinds[field.name], default)
    kinds = get_type_hints(type(entry.inference))
    for field in dataclasses.fields(entry.inference):
        found[field.name] = ("inference", kinds[field.name], getattr(entry.inference, field.name))
    if getattr(load(entry.model), "global_sites", ()):
        found["guide"] = ("guide", automatic.Name, None)
    found["scaling"] = ("data", Scaling, entry.scaling)
    return found


def _part(entry: Entry, part: Part, *needed: str) -> Any:
    """The class of a model or guide, with the class attributes that it cannot do without."""
    kind = load(part)
    for name in needed:
        if not hasattr(kind, name):
            raise TypeError(
                f"{entry.name}: {kind.__name__} needs a class attribute {name} "
                "(see zoo.contract.parts.GenerativeModel and Guide)"
            )
    if not dataclasses.is_dataclass(kind.config_class):
        raise TypeError(
            f"{entry.name}: config_class of {kind.__name__} must be a dataclass with the settings; "
            f"got {kind.config_class!r}"
        )
    return kind


def _scaling(kind: Any) -> Scaling:
    if not isinstance(kind, str) or kind not in get_args(Scaling):
        raise ValueError(f"scaling is one of {', '.join(get_args(Scaling))}; got {kind!r}")
    return cast(Scaling, kind)


def _config(entry: Entry, kind: type, values: Mapping[str, Any]) -> Any:
    names = {f.name for f in dataclasses.fields(kind)}
    return _validated(entry, kind, {k: v for k, v in values.items() if k in names})


def _strategy(entry: Entry, values: Mapping[str, Any]) -> Inference:
    """The entry's strategy under other settings; fewer epochs shorten the whole schedule."""
    base = entry.inference
    epochs = values.get("epochs")
    if isinstance(base, Svi) and epochs is not None:
        checked = _validated(entry, Svi, {"epochs": epochs})
        base = base.lasting(checked.epochs)
    kept = dataclasses.asdict(base)
    kept.update({k: v for k, v in values.items() if k in kept})
    strategy: Inference = _validated(entry, type(base), kept)
    return strategy


def _usable(device: str) -> str:
    if not isinstance(device, str | torch.device):
        raise TypeError(f"device must be text, such as 'cpu' or 'cuda'; got {device!r}")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device {device!r} cannot be used here: {reason}") from None
    return device


def _validated(entry: Entry, kind: type, values: Mapping[str, Any]) -> Any:
    try:
        return made(kind, values)
    except ValueError as error:
        raise ValueError(f"{entry.name}: {error}") from None
