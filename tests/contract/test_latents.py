"""Latent coordinates: of every model that has any, in one shape, there and back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from support import movements, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract.capabilities import Decodes
from zoo.errors import NotCapableError

NAMES = CATALOGUE.names(can="represent")
STRANGERS = {entry.name for entry in CATALOGUE.joined}
OTHER_COORDINATES = ("vae-dynamics",)


def decoder(name: str) -> zoo.Run:
    """A run that decodes; models of other packages need not."""
    run = run_of(name)
    if name in STRANGERS and not isinstance(run.model, Decodes):
        pytest.skip("offers no decode")
    return run


@pytest.mark.parametrize("name", NAMES)
def test_what_is_encoded_is_decoded_in_the_units_of_the_data(name: str) -> None:
    run, data = decoder(name), movements()
    mean, std = run.encode(data, draws=5)
    count = run.model.latent_dim
    assert mean.shape == std.shape == (*data.values.shape[:2], count)
    assert bool((std >= 0).all()) and bool(mean.isfinite().all())
    found = run.decode(mean)
    assert found.shape == tuple(data.values.shape)
    assert (found.names, found.units) == (data.channels, data.units)


@pytest.mark.parametrize("name", [n for n in NAMES if n not in OTHER_COORDINATES])
def test_a_reconstruction_is_its_representation_decoded(name: str) -> None:
    run, data = decoder(name), movements()
    latent, found = run.represent(data, draws=5).predictive, run.reconstruct(data, draws=5)
    z = latent.location if latent.draws is None or len(found.predictive.location) == 1 else None
    paths = latent.draws if z is None else z
    assert paths is not None
    decoded = torch.stack([run.decode(path).mean for path in paths])
    torch.testing.assert_close(decoded, found.predictive.location)


def test_latent_moments_are_those_of_the_representation() -> None:
    run, data = run_of("vae"), movements()
    mean, std = run.encode(data, draws=5)
    latent = run.represent(data, draws=5)
    assert torch.equal(mean, latent.mean) and torch.equal(std, latent.std)


def test_a_primitive_in_an_autoencoder_encodes_frame_by_frame() -> None:
    run, data = run_of("ae-dmp"), movements()
    mean, std = run.encode(data)
    backwards = replace(data, values=data.values.flip(1))
    torch.testing.assert_close(run.encode(backwards)[0], mean.flip(1))
    assert not bool(std.any())
    assert not torch.equal(run.represent(data).mean, mean)


def test_what_has_no_latent_coordinates_is_refused_by_name() -> None:
    data = movements()
    with pytest.raises(NotCapableError, match="promp cannot represent"):
        run_of("promp").encode(data)
    with pytest.raises(NotCapableError, match="promp cannot decode: it has no latent"):
        run_of("promp").decode(torch.zeros(1, 5, 2))
    both = zoo.Ensemble(members=(run_of("pca"), run_of("vae")))
    with pytest.raises(NotCapableError, match=r"ensemble of pca \+ vae cannot encode"):
        both.encode(data)
    with pytest.raises(NotCapableError, match=r"ensemble of pca \+ vae cannot decode"):
        both.decode(torch.zeros(1, 5, 2))


@pytest.mark.parametrize("shape", [(5, 2), (1, 5, 9)])
def test_latent_points_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(sequence, time, \d\) are needed; got shape"):
        run_of("pca").decode(torch.zeros(shape))


def test_every_model_that_represents_decodes() -> None:
    assert all(isinstance(run_of(name).model, Decodes) for name in NAMES)
