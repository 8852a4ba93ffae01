"""FITC at the size of thesis §3.3.4: N = 10,000 images of 111 × 105, M = 500, 8 targets, one core.

Compares with a hand-written FITC under torch autograd and L-BFGS that is given the same cached
distances, and with one evaluation of gpytorch's SGPR. ``python -m benchmarks.sparse_gp``.
"""

from __future__ import annotations

import math
import time
import warnings
from typing import Any

import gpytorch
import numpy as np
import torch
import typer
from torch import Tensor

from benchmarks.harness import interleave, ratio, report, store
from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs
from zoo.inference.marginal import evaluator, fit_marginal
from zoo.models.processes.sparse_gp import Config, SparseGaussianProcess

SEED = 0


def images(items: int, features: int, targets: int) -> Pairs:
    """Simulated images driven by 6 latent variables, and noisy smooth targets of these."""
    rng = np.random.default_rng(SEED)
    latent = rng.normal(size=(items, 6))
    loading = np.cumsum(rng.normal(size=(6, features)), 1) / math.sqrt(features)
    x = 0.5 + latent @ loading + 0.1 * rng.normal(size=(items, features))
    f = np.sin(latent @ rng.normal(size=(6, targets)))
    return Pairs.from_arrays(x, f + 0.1 * rng.normal(size=f.shape))


def model_of(data: Pairs, inducing: int, compare: bool) -> SparseGaussianProcess:
    """FITC, not yet conditioned."""
    return SparseGaussianProcess(data.layout, Config(inducing=inducing, compare=compare))


class Autograd(torch.nn.Module):
    """The same FITC bound by torch autograd: σ_f of every target is a parameter too."""

    def __init__(self, among: Tensor, across: Tensor, targets: Tensor, model: Any) -> None:
        super().__init__()
        self.among, self.across, self.y, self.jitter = among, across, targets, model.config.jitter
        self.log_length = torch.nn.Parameter(model.log_length.detach()[0].clone())
        self.log_noise = torch.nn.Parameter(model.log_noise.detach().clone())
        self.log_signal = torch.nn.Parameter(torch.zeros(targets.shape[1], dtype=torch.float64))

    def objective(self) -> Tensor:
        """−Σ_p log N(y_p; 0, σ_f²(Q + diag(K − Q) + ρI)) by the Woodbury identity."""
        scale = -0.5 * torch.exp(-2 * self.log_length)
        eye = torch.eye(len(self.among), dtype=torch.float64)
        factor = torch.linalg.cholesky(torch.exp(scale * self.among) + self.jitter * eye)
        k_uf = torch.exp(scale * self.across)
        v = torch.linalg.solve_triangular(factor, k_uf, upper=False)
        diagonal = 1 - v.square().sum(0) + 1e-6 + self.log_noise.exp()
        a = v / diagonal.sqrt()
        inner = torch.linalg.cholesky(eye + a @ a.mT)
        y = self.y / diagonal.sqrt()[:, None]
        c = torch.linalg.solve_triangular(inner, a @ y, upper=False)
        quadratic = y.square().sum(0) - c.square().sum(0)
        log_determinant = 2 * inner.diagonal().log().sum() + diagonal.log().sum()
        count = len(self.y)
        fit = quadratic * torch.exp(-2 * self.log_signal) + 2 * count * self.log_signal
        return 0.5 * (fit + log_determinant + count * math.log(2 * math.pi)).sum()


def autograd_of(data: Pairs, model: SparseGaussianProcess) -> Autograd:
    """The peer on the distances that ``model`` computes when it is conditioned."""
    with torch.random.fork_rng():
        torch.manual_seed(SEED)
        model.condition(data)
    among, across = model._need_training()[-2:]
    return Autograd(among, across.mT.contiguous(), data.targets, model)


class Clock:
    """Wall-clock and processor seconds since it was made."""

    def __init__(self) -> None:
        self.wall, self.processor = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        """Both, rounded to milliseconds."""
        wall, processor = time.perf_counter() - self.wall, time.process_time() - self.processor
        return {"seconds": round(wall, 3), "processor_seconds": round(processor, 3)}


def sgpr(data: Pairs, model: SparseGaussianProcess) -> Any:
    """One value and gradient of gpytorch's SGPR, targets batched, inducing inputs fixed."""
    x, y = data.inputs, data.targets.mT.contiguous()
    batch = torch.Size([len(y)])
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=batch)

    class Sgpr(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(x, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
            base = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(), batch_shape=batch)
            self.covar_module = gpytorch.kernels.InducingPointKernel(
                base, inducing_points=model.inducing.clone(), likelihood=likelihood
            )

        def forward(self, inputs: Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(inputs), self.covar_module(inputs)
            )

    peer = Sgpr().double()
    peer.covar_module.inducing_points.requires_grad_(False)
    peer.covar_module.base_kernel.base_kernel.lengthscale = model.length.item()
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, peer)
    peer.train()
    return lambda: (-evidence(peer(x), y).sum()).backward()


def fit_ours(data: Pairs, inducing: int, compare: bool) -> dict[str, Any]:
    """Everything from the raw data to a model that predicts."""
    model = model_of(data, inducing, compare)
    clock = Clock()
    rows = fit_marginal(model, data, MarginalLikelihood(optimizer="newton"), seed=SEED)
    return clock.read() | rows[-1] | {"report": model.report()}


def fit_autograd(data: Pairs, inducing: int) -> dict[str, Any]:
    """The hand-written peer, by scipy's L-BFGS from the same start; distances included."""
    from scipy.optimize import minimize

    model = model_of(data, inducing, False)
    clock = Clock()
    evaluate = evaluator(autograd_of(data, model))
    start = np.concatenate([[model.log_length.item(), model.log_noise.item()], np.zeros(8)])
    options = {"ftol": 1e-6, "gtol": 1e-6, "maxiter": 200}
    end = minimize(evaluate, start, jac=True, method="L-BFGS-B", options=options)
    return clock.read() | {"objective": float(end.fun), "evaluations": int(end.nfev)}


def main(items: int = 10_000, features: int = 11_655, inducing: int = 500, rounds: int = 5) -> None:
    """Time fits and single evaluations; print them and store results/benchmark_sparse_gp.json."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    data = images(items, features, 8)
    fits = {
        "fitc": fit_ours(data, inducing, compare=False),
        "torch autograd + L-BFGS": fit_autograd(data, inducing),
        "fitc with vfe beside it": fit_ours(data, inducing, compare=True),
    }
    for name, fit in fits.items():
        print(
            f"{name:28}{fit['seconds']:8.2f} s, of one core {fit['processor_seconds']:.2f} s, ",
            end="",
        )
        print(f"{fit['evaluations']} evaluations, −log p(y) = {fit['objective']:.3f}")
    model = model_of(data, inducing, compare=False)
    theirs = evaluator(autograd_of(data, model))
    ours = evaluator(model)
    x = np.array([model.log_length.item(), model.log_noise.item()])
    timings = interleave(
        {
            "fitc, value and gradient": lambda: ours(x),
            "torch autograd, the same": lambda: theirs(np.concatenate([x, np.zeros(8)])),
            "gpytorch SGPR": sgpr(data, model),
        },
        rounds=rounds,
        warmup=1,
    )
    report("one evaluation", timings)
    shape = {"items": items, "features": features, "inducing": inducing, "targets": 8}
    names = list(timings)
    ratios = {name: ratio(timings, name, names[0]) for name in names[1:]}
    times = [fits[k]["processor_seconds"] for k in ("torch autograd + L-BFGS", "fitc")]
    fitted = times[0] / times[1]
    payload = {"shape": shape, "fits": fits, "evaluations": timings, "ratios": ratios}
    payload["fit_ratio"] = fitted
    card = {
        "model": "fitc",
        "what": f"fit of {items} items × {features} inputs × 8 targets, {inducing} inducing",
        "value": f"{fits['fitc']['seconds']:.0f} s on one core, {fitted:.1f}× as fast as torch "
        "autograd with L-BFGS",
        "source": "simulated",
        "command": "python -m benchmarks.sparse_gp",
    }
    payload["cards"] = [card]
    path = store(
        "benchmark_sparse_gp", payload, label="simulated", libraries=["gpytorch"], seed=SEED
    )
    print(f"fit {fitted:.2f} × as fast as torch autograd with L-BFGS; written to {path.name}")


if __name__ == "__main__":
    typer.run(main)
