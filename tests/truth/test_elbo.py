"""The bound by another road: Pyro's own estimators, and a model whose evidence is known."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor, nn

from zoo.datasets.records import Sequences
from zoo.inference.elbo import bound, check, tight_bound
from zoo.inference.loader import Loader
from zoo.types import Batch


class Factors(nn.Module):
    """z ~ N(0, I), u ~ N(0, I) for each movement, x ~ N(W z + V u, σ²)."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor([[1.0, 0.5, -0.3], [0.2, -1.0, 0.7]]))
        self.v = nn.Parameter(torch.tensor([[0.3, 0.1, 0.4]]))
        self.log_sigma = nn.Parameter(torch.tensor(-0.5))

    def forward(self, batch: Batch) -> None:
        rows = len(batch.movements)
        with pyro.plate("movements", batch.total_sequences, subsample=torch.arange(rows)):
            u = pyro.sample("u", dist.Normal(torch.zeros(rows, 1), 1.0).to_event(1))
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            z = pyro.sample("z", dist.Normal(torch.zeros(len(batch), 2), 1.0).to_event(1))
            mean = (z @ self.w + u[batch.sequence] @ self.v)[:, None].expand_as(batch.values)
            x = dist.Normal(mean, self.log_sigma.exp())
            mask = True if batch.mask is None else batch.mask
            pyro.sample("x", x.mask(mask).to_event(2), obs=batch.values)


class Guide(nn.Module):
    """Amortised z, and u from the mean of the movement."""

    def __init__(self) -> None:
        super().__init__()
        self.z, self.u = nn.Linear(3, 4), nn.Linear(3, 2)

    def forward(self, batch: Batch) -> None:
        rows = len(batch.movements)
        with pyro.plate("movements", batch.total_sequences, subsample=torch.arange(rows)):
            pyro.sample("u", _normal(self.u(batch.movements.mean(1))))
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            pyro.sample("z", _normal(self.z(batch.values.mean(1))))


def _normal(out: Tensor) -> dist.Distribution:
    mean, log_scale = out.chunk(2, -1)
    return dist.Normal(mean, log_scale.exp()).to_event(1)


def data(missing: bool = True) -> Sequences:
    """Four short movements, some entries missing."""
    values = np.random.default_rng(0).normal(size=(4, 6, 3))
    if missing:
        values[1, 2, 0] = np.nan
    return Sequences.from_arrays(values, rate=1.0).to(dtype=torch.float32)


def parts(missing: bool = True) -> tuple[Factors, Guide, Batch]:
    """Model, guide and a batch that does not hold all movements or windows."""
    torch.manual_seed(1)
    loader = Loader(data(missing), batch_size=5, window=2, seed=2)
    return Factors(), Guide(), loader.take(torch.tensor([0, 3, 6, 7, 11]))


@pytest.mark.parametrize("missing", [False, True])
def test_equals_trace_elbo_with_its_gradients(missing: bool) -> None:
    model, guide, batch = parts(missing)
    torch.manual_seed(5)
    ours = bound(model, guide, batch)
    torch.manual_seed(5)
    theirs = Trace_ELBO().differentiable_loss(model, guide, batch)
    torch.testing.assert_close(ours.loss, theirs)
    torch.testing.assert_close(ours.elbo, -theirs)
    parameters = [*model.parameters(), *guide.parameters()]
    torch.testing.assert_close(
        torch.autograd.grad(ours.loss, parameters), torch.autograd.grad(theirs, parameters)
    )


def test_closed_form_kl_equals_mean_field_elbo() -> None:
    model, guide, batch = parts()
    torch.manual_seed(5)
    ours = tight_bound(model, guide, batch)
    torch.manual_seed(5)
    theirs = TraceMeanField_ELBO().differentiable_loss(model, guide, batch)
    torch.testing.assert_close(ours.loss, theirs)
    assert set(ours.terms) == {"p(x)", "kl(u)", "kl(z)"}


def test_closed_form_kl_is_the_mean_of_the_sampled_one() -> None:
    model, guide, batch = parts()
    with torch.no_grad():
        torch.manual_seed(0)
        sampled = torch.stack([bound(model, guide, batch).kl for _ in range(150)])
        exact = tight_bound(model, guide, batch).kl
    standard_error = sampled.std() / math.sqrt(len(sampled))
    assert abs(sampled.mean() - exact) < 5 * standard_error


def test_tempering_scales_the_model_and_leaves_the_guide() -> None:
    """(87) by another road: Pyro's estimator with a scale on the model alone."""
    model, guide, batch = parts()
    torch.manual_seed(5)
    hot = bound(model, guide, batch, c=0.1)
    torch.manual_seed(5)
    theirs = Trace_ELBO().differentiable_loss(poutine.scale(model, 0.1), guide, batch)
    torch.testing.assert_close(hot.loss, theirs)
    torch.manual_seed(5)
    plain = bound(model, guide, batch, c=1.0)
    torch.testing.assert_close(hot.reconstruction, plain.reconstruction)
    torch.testing.assert_close(hot.kl, plain.kl)


def test_tempered_closed_form_is_the_mean_of_the_sampled_bound() -> None:
    model, guide, batch = parts()
    with torch.no_grad():
        torch.manual_seed(0)
        sampled = torch.stack([bound(model, guide, batch, c=0.1).loss for _ in range(150)])
        torch.manual_seed(0)
        closed = torch.stack([tight_bound(model, guide, batch, c=0.1).loss for _ in range(150)])
    standard_error = (sampled - closed).std() / math.sqrt(len(sampled))
    assert abs((sampled - closed).mean()) < 5 * standard_error


def test_warm_up_scales_the_kl() -> None:
    model, guide, batch = parts()
    torch.manual_seed(5)
    for estimator in (bound, tight_bound):
        warm = estimator(model, guide, batch, beta=0.3)
        torch.testing.assert_close(warm.loss.detach(), 0.3 * warm.kl - warm.reconstruction)


def test_sites_without_reparameterised_draws_are_named() -> None:
    def model(batch: Batch) -> None:
        pyro.sample("k", dist.Bernoulli(0.5))

    with pytest.raises(ValueError, match=r"site 'k' of the guide is Bernoulli"):
        check(model, model, parts()[2])


def test_unmatched_sites_are_named() -> None:
    model, guide, batch = parts()
    check(model, guide, batch)
    with pytest.raises(ValueError, match="the guide has no site for u, z of the model"):
        check(model, lambda batch: None, batch)
    with pytest.raises(ValueError, match="the model has no latent site for u, z of the guide"):
        check(lambda batch: None, guide, batch)


def test_broken_terms_are_named() -> None:
    model, guide, batch = parts()
    with torch.no_grad():
        guide.z.bias[3] = torch.nan
    with pyro.validation_enabled(False):
        assert "p(z)" in bound(model, guide, batch).broken()
