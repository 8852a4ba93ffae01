"""The variational autoencoder against closed forms: PPCA, (32) by hand, Gaussian conditioning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from zoo.contract.strategies import Svi
from zoo.datasets.records import Sequences
from zoo.guides.amortised import Amortised
from zoo.guides.amortised import Config as GuideConfig
from zoo.inference.elbo import bound, tight_bound
from zoo.inference.loader import Loader, whole
from zoo.inference.posterior import GuidePosterior
from zoo.inference.svi import fit_svi
from zoo.models.frames.denoising import conditional_draws
from zoo.models.frames.pca import PCA
from zoo.models.frames.pca import Config as PCAConfig
from zoo.models.frames.vae import VAE, Config
from zoo.types import Batch


def movements(channels: int = 6, seed: int = 0) -> Sequences:
    """Four sequences of 30 frames with two strong directions, about unit variance."""
    rng = np.random.default_rng(seed)
    loading = rng.normal(size=(2, channels)) / 1.5
    frames = rng.normal(size=(4, 30, 2)) @ loading + 0.3 * rng.normal(size=(4, 30, channels))
    return Sequences.from_arrays(frames, rate=30.0)


def pair(data: Sequences, config: Config) -> tuple[VAE, Amortised]:
    """`vae` and its guide with random parameters, in float64."""
    torch.manual_seed(0)
    model = VAE(data.layout, config)
    settings = GuideConfig(hidden=config.hidden, activation=config.activation)
    return model.double(), Amortised(data.layout, model, settings).double()


def holed(batch: Batch, seed: int = 1, share: float = 0.3) -> Batch:
    """The batch with random entries missing."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(batch.values.shape, generator=generator) > share
    return replace(batch, values=batch.values * mask, mask=mask)


def test_linear_vae_reaches_the_evidence_of_ppca() -> None:
    data = movements()
    pca = PCA(data.layout, PCAConfig(latent_dim=2))
    pca.condition(data)
    model, guide = pair(data, Config(latent_dim=2, hidden=(), noise="shared"))
    strategy = Svi(epochs=1200, batch_size=120, learning_rate=0.02)
    fit_svi(model, guide, data, strategy, seed=0)
    batch = replace(whole(data), total=len(data))
    with torch.no_grad():
        elbos = torch.stack([bound(model, guide, batch).elbo for _ in range(100)])
    gap = (pca.log_evidence(batch) - elbos.mean()) / 120
    error = elbos.std() / 120 / len(elbos) ** 0.5
    assert float(gap) > -6 * float(error)
    assert float(gap) < 0.01


def test_bound_is_equation_32_by_hand() -> None:
    data = movements()
    model, guide = pair(data, Config(latent_dim=3, hidden=(8,)))
    loader = Loader(data, batch_size=16, window=1)
    batch = loader.take(torch.arange(16))
    torch.manual_seed(3)
    ours = tight_bound(model, guide, batch)
    torch.manual_seed(3)
    q = guide.encode(batch.values)
    z = q.rsample()
    reconstruction = Normal(*model.decoder(z)).log_prob(batch.values).sum()
    kl = kl_divergence(q, Normal(torch.zeros_like(q.mean), 1.0)).sum()
    expected = (reconstruction - kl) * loader.total / 16
    torch.testing.assert_close(ours.elbo, expected.detach(), rtol=1e-12, atol=1e-9)


def test_full_mask_is_no_mask_and_missing_entries_do_not_matter() -> None:
    model, guide = pair(movements(), Config(latent_dim=3, hidden=(8,)))

    def loss(batch: Batch) -> Tensor:
        torch.manual_seed(0)
        return bound(model, guide, batch).loss

    dense = whole(movements())
    full = replace(dense, mask=torch.ones_like(dense.values, dtype=torch.bool))
    torch.testing.assert_close(loss(full), loss(dense), rtol=1e-12, atol=0)
    some = holed(dense)
    assert some.mask is not None
    other = replace(some, values=torch.where(some.mask, some.values, 7.0))
    torch.testing.assert_close(loss(other), loss(some), rtol=0, atol=0)
    assert loss(some).item() != loss(dense).item()


def test_a_frame_with_nothing_seen_adds_nothing_to_the_bound() -> None:
    model, guide = pair(movements(), Config(latent_dim=3, hidden=(8,)))
    batch = whole(movements())
    mask = torch.ones_like(batch.values, dtype=torch.bool)
    mask[:, -1] = False
    blind = replace(batch, mask=mask)
    short = replace(batch, values=batch.values[:, :-1])
    kls = [tight_bound(model, guide, b).kl for b in (blind, short)]
    torch.testing.assert_close(kls[0], kls[1])


def linear_gaussian() -> tuple[VAE, Amortised]:
    """A linear decoder with a known Gaussian marginal; its encoder is off in mean and spread."""
    model, guide = pair(movements(), Config(latent_dim=2, hidden=(), noise="constant"))
    head, encoder = model.decoder.head, guide.encoder.head
    with torch.no_grad():
        head.mean.weight.mul_(2.0)
        head.root.fill_(0.7)
        scaled = head.mean.weight / (head.root.square() + head.floor)[:, None]
        covariance = torch.linalg.inv(torch.eye(2).double() + scaled.T @ scaled)
        encoder.mean.weight.copy_(0.8 * covariance @ scaled.T / (0.49 + head.floor))
        encoder.mean.bias.fill_(0.2)
        encoder.root.weight.mul_(0.05)
        encoder.root.bias.copy_((1.5 * covariance.diagonal().sqrt()).sqrt())
    return model, guide


def test_chain_samples_the_gaussian_conditional_though_the_encoder_is_wrong() -> None:
    model, guide = linear_gaussian()
    draws = 3000
    frame = whole(movements()).values[0, 3]
    seen = torch.tensor([True, True, False, True, False, True])
    weight, bias = model.decoder.head.mean.weight, model.decoder.head.mean.bias
    sigma = model.decoder(torch.zeros(2).double())[1]
    torch.manual_seed(0)
    with torch.no_grad():
        z = conditional_draws(
            model.decoder,
            guide.encode,
            frame[None],
            seen[None],
            2,
            draws=draws,
            chains=draws,
            burn_in=60,
        )[:, 0]
    scaled = weight[seen] / sigma[seen, None]
    covariance = torch.linalg.inv(torch.eye(2).double() + scaled.T @ scaled)
    mean = covariance @ scaled.T @ ((frame - bias)[seen] / sigma[seen])
    error = (covariance.diagonal() / draws).sqrt()
    assert bool(((z.mean(0) - mean).abs() < 6 * error).all())
    outer = covariance.diagonal()[:, None] * covariance.diagonal() + covariance.square()
    assert bool(((torch.cov(z.T) - covariance).abs() < 6 * (outer / draws).sqrt()).all())


def test_imputation_is_gaussian_conditioning_by_hand() -> None:
    model, guide = linear_gaussian()
    model.config = Config(latent_dim=2, hidden=(), chains=2000, burn_in=60)
    batch = holed(whole(movements()[[0]]))
    assert batch.mask is not None
    torch.manual_seed(0)
    with torch.no_grad():
        prediction = model.impute(batch, GuidePosterior(guide), draws=2000)
    weight, bias = model.decoder.head.mean.weight, model.decoder.head.mean.bias
    sigma = model.decoder(torch.zeros(2).double())[1]
    covariance = weight @ weight.T + sigma.square().diag()
    assert prediction.noise is not None
    for t in range(0, 30, 5):
        o, h = batch.mask[0, t], ~batch.mask[0, t]
        if bool(o.all()) or not bool(o.any()):
            continue
        gain = covariance[h][:, o] @ torch.linalg.inv(covariance[o][:, o])
        mean = bias[h] + gain @ (batch.values[0, t] - bias)[o]
        variance = (covariance[h][:, h] - gain @ covariance[o][:, h]).diagonal()
        error = (variance / 2000).sqrt()
        assert bool(((prediction.location[:, 0, t, h].mean(0) - mean).abs() < 6 * error).all())
        ours = prediction.location[:, 0, t, h].var(0) + sigma[h].square()
        assert bool(((ours - variance).abs() < 6 * variance * (2 / 2000) ** 0.5).all())


def test_predictions_have_their_shapes_and_are_joint() -> None:
    data = movements()
    model, guide = pair(data, Config(latent_dim=2, hidden=(8,)))
    posterior, batch = GuidePosterior(guide), whole(data)
    with torch.no_grad():
        latent = model.represent(batch, posterior, draws=3)
        again = model.reconstruct(holed(batch), posterior, draws=3)
    torch.testing.assert_close(latent.location[0], guide.encode(batch.values).mean)
    assert latent.draws is not None and latent.draws.shape == (3, 4, 30, 2)
    assert again.joint and again.location.shape == (3, 4, 30, 6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"latent_dim": 0}, "latent_dim must be at least 1; got 0"),
        ({"hidden": (8, 0)}, "hidden must be at least 1; got 0"),
        ({"noise_floor": 0.0}, "noise_floor must be positive"),
    ],
)
def test_settings_without_a_meaning_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Config(**settings)  # type: ignore[arg-type]
