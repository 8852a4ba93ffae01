"""Every entry of the zoo: model + guide + inference. The only place where a model meets a guide."""

from __future__ import annotations

from dataclasses import replace

from zoo.contract.plugins import discover
from zoo.contract.registry import Entry, Registry
from zoo.contract.strategies import Exact, MarginalLikelihood, Svi

__all__ = ["CATALOGUE", "list_models", "register"]

_KEPT_OUT = 0.25
_AE_DMP = Svi(
    window=None,
    epochs=3000,
    learning_rate=1e-2,
    clip=100.0,
    max_steps=10_000,
    kept_out=_KEPT_OUT,
)
_VAE_DMP = Svi(
    window=10,
    epochs=1500,
    batch_size=64,
    learning_rate=5e-3,
    clip=100.0,
    temper_epochs=100,
    max_steps=30_000,
    kept_out=_KEPT_OUT,
)

CATALOGUE = Registry(
    [
        Entry(
            name="pca",
            summary="Probabilistic principal components of single frames, exact",
            thesis="§4.3.2, Table 2",
            model="zoo.models.frames.pca:PCA",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="dmp",
            summary="Dynamic movement primitives over whole movements, exact given their noise",
            thesis="§2.2.1, Table 2",
            model="zoo.models.primitives.dmp:DMP",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="dmp-rhythmic",
            summary="Rhythmic movement primitives, their tempo and phase found in the data",
            thesis="§2.2.1, (57), (58)",
            model="zoo.models.primitives.dmp:DMP",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="cmu-mocap/35-walk",
            config={"kind": "rhythmic", "kernels": 12},
        ),
        Entry(
            name="promp",
            summary="Probabilistic movement primitives: one t of all weights, of point estimates",
            thesis="rival, named in §6.1",
            model="zoo.models.primitives.promp:ProMP",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="pca-dmp",
            summary="Principal components with a primitive each, exact given point estimates",
            thesis="Table 2",
            model="zoo.models.primitives.pca_dmp:PcaDmp",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
            scaling="center",
        ),
        Entry(
            name="ae-dmp",
            summary="Dynamic movement primitives in the latent space of a denoising autoencoder",
            thesis="§5.2.1, (72)",
            model="zoo.models.primitives.ae_dmp:AeDmp",
            guide="zoo.guides.point:PointGuide",
            inference=_AE_DMP,
            data="sequences",
            dataset="robot-arm/reaching",
            scaling="range",
        ),
        Entry(
            name="sparse-ae-dmp",
            summary="AE-DMP with a Laplace prior on the latent path",
            thesis="§5.2.2, (73)",
            model="zoo.models.primitives.ae_dmp:AeDmp",
            guide="zoo.guides.point:PointGuide",
            inference=_AE_DMP,
            data="sequences",
            dataset="robot-arm/reaching",
            scaling="range",
            config={"prior": "laplace", "prior_scale": 0.03, "weight_scale": 0.3},
        ),
        Entry(
            name="ae-then-dmp",
            summary="An autoencoder, then movement primitives in its latent space, not integrated",
            thesis="§5.3.2, Table 2",
            model="zoo.models.primitives.ae_dmp:AeDmp",
            guide="zoo.guides.point:PointGuide",
            inference=_AE_DMP,
            data="sequences",
            dataset="robot-arm/reaching",
            scaling="range",
            config={"pretraining": 1.0},
        ),
        Entry(
            name="promp-rhythmic",
            summary="Probabilistic movement primitives on a circle, tempo and phase found",
            thesis="rival, named in §6.1",
            model="zoo.models.primitives.promp:ProMP",
            guide="zoo.guides.exact:ExactPosterior",
            inference=Exact(),
            data="sequences",
            dataset="cmu-mocap/35-walk",
            config={"kind": "rhythmic", "kernels": 12},
        ),
        Entry(
            name="vae",
            summary="Variational autoencoder of single frames",
            thesis="§2.1.5.3, §4.3.1",
            model="zoo.models.frames.vae:VAE",
            guide="zoo.guides.amortised:Amortised",
            inference=Svi(window=1, epochs=500),
            data="sequences",
            dataset="robot-arm/reaching",
            config={"noise": "constant"},
        ),
        Entry(
            name="vae-dynamics",
            summary="Variational autoencoder with linear dynamics and actions in latent space",
            thesis="§4.2.1.1, §4.3.1",
            model="zoo.models.frames.vae_dynamics:VAEDynamics",
            guide="zoo.guides.amortised:Amortised",
            inference=Svi(window=2, epochs=100),
            data="sequences",
            dataset="pendulum/images",
        ),
        Entry(
            name="vae-dmp",
            summary="Dynamic movement primitives in the latent space of a time-dependent VAE",
            thesis="§6.2",
            model="zoo.models.filters.vae_dmp:VaeDmp",
            guide="zoo.guides.filtering:FilteringGuide",
            inference=_VAE_DMP,
            data="sequences",
            dataset="robot-arm/reaching",
            scaling="center",
        ),
        Entry(
            name="vae-dmp-single",
            summary="VAE-DMP with 120 hidden units, for one movement a model",
            thesis="§6.3.1.1",
            model="zoo.models.filters.vae_dmp:VaeDmp",
            guide="zoo.guides.filtering:FilteringGuide",
            inference=replace(_VAE_DMP, epochs=4000, batch_size=32, temper_epochs=400),
            data="sequences",
            dataset="thesis-movements",
            scaling="center",
            config={"hidden": 120},
        ),
        Entry(
            name="vae-dmp-rhythmic",
            summary="VAE-DMP whose latent paths are limit cycles of any phase and tempo",
            thesis="§6.2 with (57), (58)",
            model="zoo.models.filters.vae_dmp_rhythmic:RhythmicVaeDmp",
            guide="zoo.guides.rhythmic:RhythmicGuide",
            inference=replace(_VAE_DMP, window=20, stride=5, epochs=600),
            data="sequences",
            dataset="cmu-mocap/35-walk",
            scaling="center",
        ),
        Entry(
            name="dvbf",
            summary="Deep variational Bayes filter with a locally linear transition, and actions",
            thesis="§6.2.1, (85)",
            model="zoo.models.filters.dvbf:Dvbf",
            guide="zoo.guides.sequential:SequentialGuide",
            inference=replace(
                _VAE_DMP, window=20, epochs=300, learning_rate=1e-3, clip=10.0, kept_out=0.0
            ),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="gp",
            summary="Exact Gaussian process for every target, type-II maximum likelihood",
            thesis="§2.1.6, §3.2.3",
            model="zoo.models.processes.gp:GaussianProcess",
            guide="zoo.guides.exact:ExactPosterior",
            inference=MarginalLikelihood(),
            data="pairs",
            dataset="uci/concrete",
        ),
        Entry(
            name="fitc",
            summary="Sparse Gaussian process with inducing inputs, FITC; VFE fitted beside it",
            thesis="§2.1.6, §3.3.4",
            model="zoo.models.processes.sparse_gp:SparseGaussianProcess",
            guide="zoo.guides.exact:ExactPosterior",
            inference=MarginalLikelihood(optimizer="newton"),
            data="pairs",
            dataset="uci/concrete",
        ),
        Entry(
            name="vfe",
            summary="Sparse Gaussian process with inducing inputs, the bound of Titsias (2009)",
            thesis="§2.1.6",
            model="zoo.models.processes.sparse_gp:SparseGaussianProcess",
            guide="zoo.guides.exact:ExactPosterior",
            inference=MarginalLikelihood(optimizer="newton"),
            data="pairs",
            dataset="uci/concrete",
            config={"bound": "vfe"},
        ),
        Entry(
            name="mean",
            summary="The training mean of every frame: the reference of R²",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.mean:Mean",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="last-value",
            summary="The last value held, with the standard deviation of every lead time",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.last_value:LastValue",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="ar",
            summary="Linear autoregression, lags and ridge by cross-validation of its forecasts",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.autoregression:Autoregression",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="nearest-neighbour",
            summary="The most similar places of training movements, continued and entered again",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.nearest_neighbour:NearestNeighbour",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="kernel-ridge",
            summary="Missing and future entries regressed on those observed, by kernel ridge",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.kernel_ridge:KernelRidge",
            guide=None,
            inference=Exact(),
            data="sequences",
            dataset="robot-arm/reaching",
        ),
        Entry(
            name="mean-regressor",
            summary="The training mean of every target: the reference of R²",
            thesis="baseline, not in the thesis",
            model="zoo.models.baselines.mean:MeanRegressor",
            guide=None,
            inference=Exact(),
            data="pairs",
            dataset="uci/concrete",
        ),
    ],
    discover=discover,
)


def list_models(pattern: str = "*", *, can: str | None = None) -> list[str]:
    """Names of the models that match a glob and, optionally, have a capability.

    >>> list_models("vae-dmp", can="forecast")
    ['vae-dmp']
    """
    return CATALOGUE.names(pattern, can=can)


def register(entry: Entry, *, replace: bool = False) -> None:
    """Let a model of your own join ``zoo.list_models``, ``zoo.create``, ``zoo.card`` and the rest.

    It stays for this process; a package joins every process, and the command line, by an entry
    point of the group ``movezoo.models``. A name that is taken is refused, unless ``replace`` says
    that an entry registered before is meant, such as by the same cell of a notebook.
    """
    CATALOGUE.register(entry, replace=replace)
