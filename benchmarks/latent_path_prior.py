"""What forecasts in vae-dmp: its networks, its own prior, or the latent path prior.

``python -m benchmarks.latent_path_prior`` writes ``results/latent_path_prior.json``, ``.md`` and
``.png``: walks of CMU 35, 100 frames observed and 200 forecast, two folds of four.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor, nn

import zoo
from zoo.datasets.records import Sequences
from zoo.datasets.records.scaling import Scaler
from zoo.evaluation.scores import score
from zoo.evaluation.tasks import answered
from zoo.inference.harness import kept_out
from zoo.inference.loader import whole
from zoo.models.filters.vae_dmp import VaeDmp
from zoo.models.frames.pca import PCA
from zoo.models.frames.pca import Config as PcaConfig
from zoo.models.primitives import ae_dmp
from zoo.movement.paths import PathPrior
from zoo.movement.response import Response
from zoo.prediction.prediction import Prediction
from zoo.runs.run import Run
from zoo.streams import seeded
from zoo.studies.chapter6.process_noise import NoiseShare, noise_share
from zoo.studies.leaderboard.protocols import protocol
from zoo.studies.result import Result, write_result
from zoo.types import Batch, Layout, Posterior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["main"]

FOLDS, JUDGED = 4, (1, 3)
SEED, DRAWS, PRIOR_DRAWS = 0, 48, 4000
SETTINGS: dict[str, Any] = {"window": 20, "stride": 5, "epochs": 60}
COMPONENTS = (5, 8)
SHOWN = ("mse", "crps", "nll", "coverage_90")
DEGREES = np.degrees(1.0) ** 2


@dataclass(frozen=True)
class OwnPaths(PathPrior):
    """A single Gaussian over whole paths, of any covariance."""

    dense: Tensor = field(kw_only=True)

    @property
    def covariance(self) -> Tensor:
        """As given."""
        return self.dense


class OwnPrior(VaeDmp):
    """Forecasts by p(w), p(z^goal), p(z_1), p(ż_1), p(ε) of the program, (76)–(78).

    All are independent; what enters the path is their mean and variance after g. ``aggregated``
    takes those of the training movements' posteriors instead of N(0, I).
    """

    aggregated = False

    def _prior(self, length: int, rows: Tensor | None = None) -> PathPrior:
        mixture = super()._prior(length, rows)
        mean, variance = self._moments()
        u, parts = self.prior_movements.double(), self._responses(length)
        φ, noise = parts
        time, latent = len(φ), u.shape[-1]
        dense = torch.zeros(time, latent, time, latent, dtype=torch.float64)
        for d in range(latent):
            dense[:, d, :, d] = (φ * variance[:, d]) @ φ.mT
        gain = self.w_noise.detach().double()
        dense += torch.einsum("ts,ij->tisj", noise @ noise.mT, gain.mT @ gain)
        path = (φ @ mean)[None]
        known = mixture.independent, torch.zeros_like(path), mixture.observation
        return OwnPaths(path, *known, bandwidth=0.0, dense=dense)

    def _moments(self) -> tuple[Tensor, Tensor]:
        """Mean and variance of w, goal, first position and velocity, in the space of z*."""
        u = self.prior_movements.double()
        if self.aggregated:
            return u.mean(0), u.var(0)
        mean, variance = torch.zeros_like(u[0]), torch.ones_like(u[0])
        z = self.embed(torch.randn(PRIOR_DRAWS, u.shape[-1])).double()
        mean[-3:-1], variance[-3:-1] = z.mean(0), z.var(0)
        variance[-1] = self.config.velocity_scale**2
        return mean, variance

    def _responses(self, length: int) -> tuple[Tensor, Tensor]:
        """Of the path to w, goal and first state, and to the noise of every step."""
        response = Response.of(self.system, length, torch.float64)
        basis = self.config.w_scale * self.kernels_at(length - 1)
        force = torch.cat([basis, torch.ones(length - 1, 1), torch.eye(length - 1)], dim=1)
        force = self.system.stiffness * nn.functional.pad(force.double(), (0, 2))
        start = torch.zeros(2, force.shape[1], dtype=torch.float64)
        start[0, -2] = start[1, -1] = 1.0
        φ = response.product(start, force)[0]
        known = self.kernels + 1
        return torch.cat([φ[:, :known], φ[:, -2:]], dim=1), φ[:, known:-2]


class AggregatedPrior(OwnPrior):
    """Independent Gaussians over w, goal and first state like those of the training movements."""

    aggregated = True


class LinearPaths(ae_dmp.AeDmp):
    """The latent path prior over principal components: encoder and decoder are linear."""

    std: Tensor

    def __init__(self, layout: Layout, pca: PCA) -> None:
        """Primitives in the latent space of a fitted ``pca``."""
        latent = pca.loading.shape[1]
        super().__init__(layout, ae_dmp.Config(latent_dim=latent, hidden=latent, kernels=50))
        linear = nn.Linear(latent, len(layout.channels))
        linear.weight.data, linear.bias.data = pca.loading.float(), pca.mean.float()
        self.decoder = nn.Sequential(linear)
        self.register_buffer("std", pca.noise.float().expand(len(layout.channels)).clone())

    @property
    def σ(self) -> Tensor:
        """One standard deviation for every channel."""
        return self.std

    def learn_noise(self, batch: Batch, posterior: Posterior) -> None:
        """Of movements that the components were not found on."""
        error = self.decoder(posterior.encode(batch.values).mean) - batch.values
        self.std = torch.maximum(error.square().mean((0, 1)).sqrt(), self.std)


@dataclass(frozen=True)
class LinearGuide:
    """Encodings by least squares, and the primitive of every path."""

    model: LinearPaths

    def encode(self, values: Tensor, mask: Tensor | None = None) -> torch.distributions.Normal:
        """Components of frames."""
        linear = cast(nn.Linear, self.model.decoder[0])
        inverse = torch.linalg.pinv(linear.weight.detach())
        mean = (values - linear.bias.detach()) @ inverse.mT
        return torch.distributions.Normal(mean, torch.full_like(mean, 1e-3))

    def draw(self, batch: Batch, draws: int) -> dict[str, Tensor]:
        """θ of whole movements."""
        return {"theta": self.model.imitate(self.encode(batch.values).mean, None)[None]}


def linear_forecast(train: Sequences, test: Sequences, components: int) -> Prediction:
    """PCA and the path prior, on the same movements and with the same ones kept out."""
    asked = protocol("walk-setup-2")
    shell = zoo.create("vae-dmp", train, **SETTINGS)
    scaler = Scaler.fit(train, shell.scaling)
    known, held_out = kept_out(shell.model, shell.inference, train, None, SEED)
    pca = PCA(train.layout, PcaConfig(latent_dim=components))
    pca.condition(scaler.apply(known))
    model = LinearPaths(train.layout, pca).eval()
    guide = LinearGuide(model)
    with seeded(SEED), torch.no_grad():
        model.learn_noise(_whole(scaler, held_out), guide)
        model.learn_prior(_whole(scaler, train), guide)
        first = _whole(scaler, test.first(asked.seen))
        found = model.forecast(first, guide, horizon=asked.horizon, draws=DRAWS)
    scale, shift = scaler.channel_scale.float(), scaler.channel_shift.float()
    return Prediction(
        predictive=found.affine(scale, shift),
        axes=("sequence", "time", "channel"),
        names=train.channels,
        units=train.units,
        task="forecast",
    )


def _whole(scaler: Scaler, data: Sequences) -> Batch:
    return whole(scaler.apply(data).to(dtype=torch.float32))


def with_prior(run: Run, kind: type[VaeDmp]) -> Run:
    """The same trained networks, another prior."""
    model = copy.copy(run.model)
    model.__class__ = kind
    return replace(run, assembly=replace(run.assembly, model=model))


def judged(data: Sequences, fold: int) -> tuple[dict[str, dict[str, float]], list[NoiseShare], str]:
    """Scores of every arm on a fold; what ε carries of its movements; the shape of the mixture."""
    rows = range(len(data))
    test = data[[i for i in rows if i % FOLDS == fold]]
    question = protocol("walk-setup-2").question(test)
    train = data[[i for i in rows if i % FOLDS != fold]]
    run = zoo.fit(zoo.create("vae-dmp", train, seed=SEED, **SETTINGS), train)
    runs = {
        "vae-dmp: latent path prior": run,
        "vae-dmp: aggregated p(w), p(goal), ε": with_prior(run, AggregatedPrior),
        "vae-dmp: p(w), p(goal), ε of the program": with_prior(run, OwnPrior),
    }
    found = {n: answered(r, question, draws=DRAWS, seed=SEED) for n, r in runs.items()}
    for count in COMPONENTS:
        found[f"PCA-{count}: latent path prior"] = linear_forecast(train, test, count)
    truth, mask = question.truth, question.mask
    scores = {n: _scores(p, truth, mask) for n, p in found.items()}
    shape = ", ".join(f"{v:.2g}" for v in cast(Any, run.model).prior_shape.tolist())
    return scores, noise_share(run, test), shape


def _scores(prediction: Prediction, truth: Tensor, mask: Tensor) -> dict[str, float]:
    found = score(prediction, truth, mask)
    return {name: e.value for name in SHOWN if (e := found[name]) is not None}


def main() -> None:
    """Train on two folds, judge every arm, store the table."""
    began = time.monotonic()
    torch.set_num_threads(1)
    data = protocol("walk-setup-2").load()
    folds = [judged(data, fold) for fold in JUDGED]
    names = list(folds[0][0])
    mean = {n: {s: float(np.mean([f[0][n][s] for f in folds])) for s in SHOWN} for n in names}
    rows = [_row(n, [f[0][n]["mse"] for f in folds], mean[n]) for n in names]
    result = Result(
        title="walks, 100 frames observed and 200 forecast: networks and priors apart",
        source="public",
        columns=(
            "arm",
            "MSE, deg²",
            *(f"fold {f}" for f in JUDGED),
            "CRPS, rad",
            "NLL",
            "90 % band holds, %",
        ),
        rows=tuple(rows),
        findings=(
            *_findings(mean),
            *_noise([s for f in folds for s in f[1]], [f[2] for f in folds]),
        ),
        seed=SEED,
        details={"settings": SETTINGS, "folds": list(JUDGED), "of": FOLDS},
        command="python -m benchmarks.latent_path_prior",
        figure=_figure(mean),
    )
    found = write_result(result, "latent_path_prior", Path("results"), time.monotonic() - began)
    print(found.markdown())


def _row(name: str, folds: Sequence[float], mean: dict[str, float]) -> tuple[Any, ...]:
    errors = (DEGREES * mse for mse in (mean["mse"], *folds))
    return (name, *errors, *(mean[s] for s in SHOWN[1:]))


def _findings(mean: dict[str, dict[str, float]]) -> tuple[str, ...]:
    ours = mean["vae-dmp: latent path prior"]
    linear = min((n for n in mean if n.startswith("PCA")), key=lambda n: mean[n]["mse"])
    ratio = mean[linear]["mse"] / ours["mse"]
    verdict = "does as well or better" if ratio <= 1.05 else "does worse"
    own = {n.split(": ")[1]: mean[n]["mse"] / ours["mse"] for n in mean if "ε" in n}
    told = " and ".join(f"{value:.3g} × ({name})" for name, value in own.items())
    needed = "carries" if min(own.values()) > 1.05 else "does not carry"
    return (
        f"The path prior over principal components {verdict}: {linear} has {ratio:.2f} × the MSE "
        "of vae-dmp's own latent space.",
        f"Without the path prior the MSE of vae-dmp is {told}: the mixture around the training "
        f"movements' latent paths {needed} the forecasts.",
    )


def _noise(shares: Sequence[NoiseShare], shapes: Sequence[str]) -> tuple[str, ...]:
    active = sorted(s.active for s in shares)
    lost = [100 * s.of_variance for s in shares]
    return (
        f"ε of these movements: {active[0]}–{active[-1]} active units of 5, "
        f"{100 * np.mean([s.of_divergence for s in shares]):.0f} % of the KL; without it the paths "
        f"lose {np.mean(lost):.2g} % of their variance.",
        f"Shapes h, λ, ν of the mixture, by fold: {'; '.join(shapes)} (h = 1 is one Gaussian).",
    )


def _figure(mean: dict[str, dict[str, float]]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    axes.barh(list(mean), [DEGREES * m["mse"] for m in mean.values()], color="0.45")
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("MSE / deg²")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
