"""Every entry of the zoo: model + guide + inference. The only place where a model meets a guide."""

from __future__ import annotations

from dataclasses import replace

from zoo.registry import Entry, Registry
from zoo.strategies import Exact, MarginalLikelihood, Svi

__all__ = ["CATALOGUE", "list_models"]

_VAE_DMP = Svi(
    window=10,
    epochs=1500,
    batch_size=64,
    learning_rate=5e-3,
    clip=100.0,
    temper_epochs=100,
    max_steps=30_000,
)

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
        Entry(
            name="dmp",
            summary="Dynamic movement primitives as an exact Gaussian over whole movements",
            thesis="§2.2.1, Table 2",
            model="zoo.models.dmp:DMP",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="dmp-rhythmic",
            summary="Rhythmic movement primitives, their tempo and phase found in the data",
            thesis="§2.2.1, (57), (58)",
            model="zoo.models.dmp:DMP",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="cmu-mocap/35-walk",
            config={"kind": "rhythmic", "kernels": 12},
        ),
        Entry(
            name="promp",
            summary="Probabilistic movement primitives: joint Gaussian of all weights, exact",
            thesis="rival, named in §6.1",
            model="zoo.models.promp:ProMP",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="vae",
            summary="Variational autoencoder of single frames",
            thesis="§2.1.5.3, §4.3.1",
            model="zoo.models.vae:VAE",
            guide="zoo.guides.amortised:Amortised",
            inference=Svi(window=1, epochs=500),
            data="sequences",
            dataset="thesis-movements",
            config={"noise": "constant"},
        ),
        Entry(
            name="vae-dynamics",
            summary="Variational autoencoder with linear dynamics and actions in latent space",
            thesis="§4.2.1.1, §4.3.1",
            model="zoo.models.vae_dynamics:VAEDynamics",
            guide="zoo.guides.amortised:Amortised",
            inference=Svi(window=2, epochs=100),
            data="sequences",
            dataset="pendulum/images",
        ),
        Entry(
            name="vae-dmp",
            summary="Dynamic movement primitives in the latent space of a time-dependent VAE",
            thesis="§6.2",
            model="zoo.models.vae_dmp:VaeDmp",
            guide="zoo.guides.filtering:FilteringGuide",
            inference=_VAE_DMP,
            data="sequences",
            dataset="thesis-movements",
            scaling="center",
        ),
        Entry(
            name="vae-dmp-single",
            summary="VAE-DMP with 120 hidden units, for one movement a model",
            thesis="§6.3.1.1",
            model="zoo.models.vae_dmp:VaeDmp",
            guide="zoo.guides.filtering:FilteringGuide",
            inference=replace(_VAE_DMP, epochs=4000, batch_size=32, temper_epochs=400),
            data="sequences",
            dataset="thesis-movements",
            scaling="center",
            config={"hidden": 120},
        ),
        Entry(
            name="gp",
            summary="Exact Gaussian process for every target, type-II maximum likelihood",
            thesis="§2.1.6, §3.2.3",
            model="zoo.models.gp:GaussianProcess",
            guide=None,
            inference=MarginalLikelihood(),
            data="pairs",
            dataset="uci/concrete",
        ),
        Entry(
            name="fitc",
            summary="Sparse Gaussian process with inducing inputs, FITC; VFE fitted beside it",
            thesis="§2.1.6, §3.3.4",
            model="zoo.models.sparse_gp:SparseGaussianProcess",
            guide=None,
            inference=MarginalLikelihood(optimizer="newton"),
            data="pairs",
            dataset="uci/concrete",
        ),
        Entry(
            name="vfe",
            summary="Sparse Gaussian process with inducing inputs, the bound of Titsias (2009)",
            thesis="§2.1.6",
            model="zoo.models.sparse_gp:SparseGaussianProcess",
            guide=None,
            inference=MarginalLikelihood(optimizer="newton"),
            data="pairs",
            dataset="uci/concrete",
            config={"bound": "vfe"},
        ),
        Entry(
            name="mean",
            summary="The training mean of every frame: the zero line of a sceptic",
            thesis="baseline, not in the thesis",
            model="zoo.models.mean:Mean",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="last-value",
            summary="The last value held, with the spread of every lead time",
            thesis="baseline, not in the thesis",
            model="zoo.models.last_value:LastValue",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="ar",
            summary="Linear autoregression of every channel, or of all, exact",
            thesis="baseline, not in the thesis",
            model="zoo.models.autoregression:Autoregression",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="nearest-neighbour",
            summary="The most similar training movements, continued",
            thesis="baseline, not in the thesis",
            model="zoo.models.nearest_neighbour:NearestNeighbour",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="kernel-ridge",
            summary="Missing and future entries regressed on those seen, by kernel ridge",
            thesis="baseline, not in the thesis",
            model="zoo.models.kernel_ridge:KernelRidge",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="mean-regressor",
            summary="The training mean of every target: the zero line of regression",
            thesis="baseline, not in the thesis",
            model="zoo.models.mean:MeanRegressor",
            guide=None,
            inference=Exact(),
            data="pairs",
            dataset="uci/concrete",
        ),
    ]
)


def list_models(pattern: str = "*", *, can: str | None = None) -> list[str]:
    """Names of the models that match a glob and, optionally, have a capability.

    >>> list_models("vae-dmp", can="forecast")
    ['vae-dmp']
    """
    return CATALOGUE.names(pattern, can=can)
