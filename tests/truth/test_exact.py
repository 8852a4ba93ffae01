"""Exact posteriors with sites that depend on each other, by enumeration and dense Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from scipy.special import logsumexp
from scipy.stats import norm
from torch import Tensor, nn

from zoo.datasets.records import Sequences
from zoo.guides.exact import Config, ExactPosterior
from zoo.inference.elbo import bound
from zoo.inference.loader import whole
from zoo.types import Batch, Sites

SCALES = torch.tensor([0.5, 2.0, 4.0], dtype=torch.float64)


class Timed(nn.Module):
    """k ~ Categorical(1/3), w ~ N(0, s_k²), x ~ N(w, 1): two sites, the second given the first."""

    def forward(self, batch: Batch) -> None:
        rows = len(batch.movements)
        x = batch.movements[:, 0, 0]
        with pyro.plate("movements", batch.total_sequences, subsample=torch.arange(rows)):
            k = pyro.sample("timing", dist.Categorical(torch.ones(3, dtype=torch.float64)))
            w = pyro.sample("w", dist.Normal(0.0, SCALES[k]))
            pyro.sample("x", dist.Normal(w, 1.0), obs=batch.given(x))

    def posterior_sites(self, batch: Batch) -> Sites:
        x = batch.movements[:, 0, 0]
        evidence = dist.Normal(0.0, (SCALES.square() + 1).sqrt()).log_prob(x[:, None])

        def weights(drawn: dict[str, Tensor]) -> dist.Normal:
            gain = SCALES.square() / (SCALES.square() + 1)
            chosen = gain[drawn["timing"]]
            return dist.Normal(chosen * x, chosen.sqrt())

        of = {"timing": lambda _: dist.Categorical(logits=evidence), "w": weights}
        return Sites(plate="movements", size=batch.total_sequences, rows=len(x), of=of)


def test_a_later_site_is_given_the_values_drawn_before() -> None:
    values = np.array([0.3, -2.0, 5.0])
    batch = whole(Sequences.from_arrays(values[:, None, None], rate=1.0).to(dtype=torch.float64))
    each = norm.logpdf(values[:, None], scale=np.sqrt(SCALES.numpy() ** 2 + 1))
    evidence = (logsumexp(each, axis=1) - math.log(3)).sum()
    model = Timed()
    guide = ExactPosterior(batch.movements, model, Config())  # type: ignore[arg-type]
    found = [float(bound(model, guide, batch).elbo) for _ in range(20)]
    np.testing.assert_allclose(found, evidence, rtol=1e-12)
    half = replace(batch, total_sequences=6)
    np.testing.assert_allclose(float(bound(model, guide, half).elbo), 2 * evidence, rtol=1e-12)
