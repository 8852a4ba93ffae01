"""Every entry of the zoo: model + guide + inference. The only place where a model meets a guide."""

from __future__ import annotations

from zoo.registry import Entry, Registry
from zoo.strategies import Exact, MarginalLikelihood, Svi

__all__ = ["CATALOGUE", "list_models"]

CATALOGUE = Registry(
    [
        Entry(
            name="pca",
            summary="Probabilistic principal components of single frames, exact",
            thesis="§4.3.2, Table 2",
            model="zoo.models.pca:PCA",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="thesis-movements",
        ),
    ]
)


def list_models(pattern: str = "*", *, can: str | None = None) -> list[str]:
    """Names of the models that match a glob and, optionally, have a capability.

    >>> list_models("vae-dmp", can="forecast")
    ['vae-dmp']
    """
    return CATALOGUE.names(pattern, can=can)
