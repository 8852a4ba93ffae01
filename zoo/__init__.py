"""movezoo: a probabilistic programming model zoo for movement.

Every name below is imported on first use, so that ``import zoo`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from zoo.version import __version__

if TYPE_CHECKING:
    from zoo.catalogue import list_models, register
    from zoo.contract.registry import Entry
    from zoo.contract.strategies import Exact, MarginalLikelihood, Svi
    from zoo.datasets.library import list_data, load_data
    from zoo.datasets.records import Pairs, Sequences
    from zoo.datasets.records.joined import concatenate
    from zoo.evaluation.questions import Setup
    from zoo.evaluation.table import Table
    from zoo.faces.cards import card
    from zoo.faces.play import play
    from zoo.prediction.prediction import Prediction
    from zoo.prediction.predictive import Predictive
    from zoo.runs.ensemble import Ensemble, fit_ensemble
    from zoo.runs.fitting import fit
    from zoo.runs.run import Run, create, evaluate, load
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
    "Ensemble": "zoo.runs.ensemble",
    "Entry": "zoo.contract.registry",
    "Exact": "zoo.contract.strategies",
    "Layout": "zoo.types",
    "MarginalLikelihood": "zoo.contract.strategies",
    "Pairs": "zoo.datasets.records",
    "Posterior": "zoo.types",
    "Prediction": "zoo.prediction.prediction",
    "Predictive": "zoo.prediction.predictive",
    "Run": "zoo.runs.run",
    "Sequences": "zoo.datasets.records",
    "Setup": "zoo.evaluation.questions",
    "Sites": "zoo.types",
    "Svi": "zoo.contract.strategies",
    "Table": "zoo.evaluation.table",
    "card": "zoo.faces.cards",
    "concatenate": "zoo.datasets.records.joined",
    "create": "zoo.runs.run",
    "evaluate": "zoo.runs.run",
    "fit": "zoo.runs.fitting",
    "fit_ensemble": "zoo.runs.ensemble",
    "list_data": "zoo.datasets.library",
    "list_models": "zoo.catalogue",
    "load": "zoo.runs.run",
    "load_data": "zoo.datasets.library",
    "play": "zoo.faces.play",
    "register": "zoo.catalogue",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'zoo' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
