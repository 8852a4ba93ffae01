"""A model whose evidence and posterior are known, for the tests of the harness."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import nn

from zoo.datasets.records import Sequences
from zoo.types import Batch

__all__ = ["Factors", "Recognition", "evidence", "frames"]

LOADINGS = torch.tensor([[1.0, 0.5, -0.5, 0.0], [0.0, 1.0, 1.0, 0.5]])


class Factors(nn.Module):
    """z ~ N(0, I), x ~ N(W z, σ²) with orthogonal rows of W, so that the posterior is diagonal."""

    def __init__(self) -> None:
        super().__init__()
        self.loadings = nn.Parameter(LOADINGS.clone())
        self.log_sigma = nn.Parameter(torch.tensor(math.log(0.5)))

    def forward(self, batch: Batch) -> None:
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            z = pyro.sample("z", dist.Normal(torch.zeros(len(batch), 2), 1.0).to_event(1))
            x = dist.Normal((z @ self.loadings)[:, None], self.log_sigma.exp())
            pyro.sample("x", x.to_event(2), obs=batch.values)


class Recognition(nn.Module):
    """q(z|x): a mean linear in x and one spread for each dimension."""

    def __init__(self, scale: float = 0.3) -> None:
        super().__init__()
        self.mean = nn.Linear(4, 2)
        self.log_scale = nn.Parameter(torch.full((2,), math.log(scale)))

    def forward(self, batch: Batch) -> None:
        mean = self.mean(batch.values[:, 0])
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            pyro.sample("z", dist.Normal(mean, self.log_scale.exp()).to_event(1))


def frames(movements: int = 10, seed: int = 0, length: int = 10) -> Sequences:
    """Draws of the model, a frame a datum."""
    rng = np.random.default_rng(seed)
    shape = (movements, length)
    clean = rng.normal(size=(*shape, 2)) @ LOADINGS.numpy()
    values = clean + 0.5 * rng.normal(size=(*shape, 4))
    return Sequences.from_arrays(values, rate=1.0).to(dtype=torch.float32)


def evidence(model: Factors, data: Sequences) -> float:
    """Exact log p(x) per frame."""
    w, sigma = model.loadings.detach(), model.log_sigma.detach().exp()
    covariance = w.T @ w + sigma.square() * torch.eye(4)
    normal = torch.distributions.MultivariateNormal(torch.zeros(4), covariance)
    return float(normal.log_prob(data.values.flatten(0, 1)).mean())
