"""movezoo: a probabilistic programming model zoo for movement.

Every name below is imported on first use, so that ``import zoo`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from zoo.version import __version__

if TYPE_CHECKING:
    from zoo.cards import card
    from zoo.catalogue import list_models, register
    from zoo.datasets.joined import concatenate
    from zoo.datasets.library import list_data, load_data
    from zoo.datasets.records import Pairs, Sequences
    from zoo.ensemble import Ensemble, fit_ensemble
    from zoo.evaluation.table import Table
    from zoo.fitting import fit
    from zoo.player import play
    from zoo.prediction import Prediction, Predictive
    from zoo.questions import Setup
    from zoo.registry import Entry
    from zoo.run import Run, create, evaluate, load
    from zoo.strategies import Exact, MarginalLikelihood, Svi
    from zoo.types import Batch, Layout, Posterior, Sites

__all__ = [
    "Batch",
    "Ensemble",
    "Entry",
    "Exact",
    "Layout",
    "MarginalLikelihood",
    "Pairs",
    "Posterior",
    "Prediction",
    "Predictive",
    "Run",
    "Sequences",
    "Setup",
    "Sites",
    "Svi",
    "Table",
    "__version__",
    "card",
    "concatenate",
    "create",
    "evaluate",
    "fit",
    "fit_ensemble",
    "list_data",
    "list_models",
    "load",
    "load_data",
    "play",
    "register",
]

_HOME = {
    "Batch": "zoo.types",
    "Ensemble": "zoo.ensemble",
    "Entry": "zoo.registry",
    "Exact": "zoo.strategies",
    "Layout": "zoo.types",
    "MarginalLikelihood": "zoo.strategies",
    "Pairs": "zoo.datasets.records",
    "Posterior": "zoo.types",
    "Prediction": "zoo.prediction",
    "Predictive": "zoo.prediction",
    "Run": "zoo.run",
    "Sequences": "zoo.datasets.records",
    "Setup": "zoo.questions",
    "Sites": "zoo.types",
    "Svi": "zoo.strategies",
    "Table": "zoo.evaluation.table",
    "card": "zoo.cards",
    "concatenate": "zoo.datasets.joined",
    "create": "zoo.run",
    "evaluate": "zoo.run",
    "fit": "zoo.fitting",
    "fit_ensemble": "zoo.ensemble",
    "list_data": "zoo.datasets.library",
    "list_models": "zoo.catalogue",
    "load": "zoo.run",
    "load_data": "zoo.datasets.library",
    "play": "zoo.player",
    "register": "zoo.catalogue",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'zoo' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
