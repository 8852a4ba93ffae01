"""Ensembles: an equal mixture of the members, on disk as in memory, and honest about limits."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy.stats import norm
from support import movements

import zoo
from zoo.errors import DamagedRunError, FewGroupsWarning, NoJointSamplesError, NotCapableError
from zoo.evaluation.questions import Setup
from zoo.prediction.predictive import Predictive, pooled

SETUP = Setup(seen=12, horizon=12, draws=20)


def members(*names: str) -> tuple[zoo.Run, ...]:
    """Exact runs on the first six movements."""
    train = movements()[:6]
    return tuple(zoo.fit(zoo.create(name, train), train) for name in names)


def autoencoders(count: int) -> zoo.Ensemble:
    """Point-guided autoencoders that differ by their seed."""
    train = movements()[:6]
    settings = {"epochs": 2, "latent_dim": 2}
    made = [zoo.create("ae-dmp", train, seed=s, **settings) for s in range(count)]
    return zoo.fit_ensemble(made, train)


def test_the_distribution_is_the_average_of_the_members() -> None:
    """Density, distribution function and mean against the members', moments by hand."""
    runs = members("mean", "last-value", "ar")
    data, truth = movements()[6:].frames(0, 12), movements()[6:].values[:, 12:]
    parts = [r.forecast(data, horizon=12, seed=i) for i, r in enumerate(runs)]
    whole = zoo.Ensemble(members=runs).forecast(data, horizon=12)
    torch.testing.assert_close(whole.mean, sum(p.mean for p in parts) / 3)
    torch.testing.assert_close(whole.cdf(truth), sum(p.cdf(truth) for p in parts) / 3)
    density = sum(p.log_prob(truth).exp() for p in parts) / 3
    torch.testing.assert_close(whole.log_prob(truth), density.log())
    moment = sum(p.std**2 + p.mean**2 for p in parts) / 3
    torch.testing.assert_close(whole.std, (moment - whole.mean**2).sqrt())


def test_members_of_one_entry_differ_by_their_seed() -> None:
    """What a single point estimate does not know is the spread over several."""
    data = movements()[6:]
    ensemble = autoencoders(3)
    single = zoo.Ensemble(members=ensemble.members[:1]).reconstruct(data)
    assert float(single.epistemic.abs().max()) == 0
    parts = torch.stack([run.reconstruct(data).mean for run in ensemble.members])
    whole = ensemble.reconstruct(data)
    torch.testing.assert_close(whole.mean, parts.mean(0))
    torch.testing.assert_close(whole.epistemic, parts.std(0, correction=0))


def test_an_ensemble_is_calibrated_and_scored_like_a_run() -> None:
    """A correction is kept by task, used in forecasts, and counted by the evaluation."""
    ensemble = zoo.Ensemble(members=members("mean", "ar"))
    held_out = movements()[6:]
    ensemble.calibrate(held_out, method="scale", setup=SETUP)
    known = held_out.frames(0, 12)
    assert ensemble.forecast(known, horizon=12).recalibration is not None
    with pytest.warns(UserWarning, match="2 of 2 .* were calibrated on"):
        table = zoo.evaluate(ensemble, held_out, setup=SETUP)
    assert {row.task for row in table.rows} >= {"forecast"}


def test_an_ensemble_on_disk_predicts_the_same(tmp_path: Path) -> None:
    """Saved with its calibration, loaded again: equal bits; a foreign folder is refused."""
    ensemble = zoo.Ensemble(members=members("mean", "ar"))
    with pytest.warns(FewGroupsWarning, match="on 2 groups"):
        ensemble.calibrate(movements()[6:], setup=SETUP)
    again = zoo.Ensemble.load(ensemble.save(tmp_path / "both"))
    data = movements()[4:6].frames(0, 12)
    before, after = (e.forecast(data, horizon=12).interval(0.9) for e in (ensemble, again))
    assert torch.equal(before[0], after[0])
    assert torch.equal(before[1], after[1])
    with pytest.raises(DamagedRunError):
        zoo.Ensemble.load(tmp_path / "both" / "member-0")


def test_what_members_cannot_do_together_is_refused() -> None:
    """Tasks, layouts and emptiness by name; latents are not averaged."""
    with pytest.raises(NotCapableError, match="ensemble of pca"):
        zoo.Ensemble(members=members("pca", "mean")).forecast(movements(), horizon=2)
    assert "represent" not in zoo.Ensemble(members=members("pca")).capabilities
    with pytest.raises(ValueError, match="at least 1 member"):
        zoo.Ensemble(members=())
    other = movements().resampled(rate=15.0)
    with pytest.raises(ValueError, match="15 Hz"):
        zoo.Ensemble(members=(*members("mean"), zoo.fit(zoo.create("mean", other), other)))


def test_mixtures_of_unequal_parts_weigh_every_part_alike() -> None:
    """A Gaussian beside a mixture of three: the median solves the averaged equation."""
    one = Predictive(location=torch.zeros(1, 1, dtype=torch.float64), noise=torch.ones(1, 1, 1)[0])
    three = Predictive(
        location=torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64),
        epistemic=torch.full((3, 1), 0.5, dtype=torch.float64),
    )
    whole = pooled([one, three])
    assert whole.location.shape == (6, 1)
    spread = whole.spread
    assert spread is not None
    at = 0.7
    ours = norm.cdf((at - whole.location.numpy()) / spread.numpy()).mean()
    by_hand = norm.cdf(at) / 2 + norm.cdf((at - three.location.numpy()) / 0.5).mean() / 2
    assert ours == pytest.approx(by_hand, abs=1e-12)
    with pytest.raises(ValueError, match="shapes"):
        pooled([one, Predictive(location=torch.zeros(1, 2))])


def test_joint_draws_need_joint_members() -> None:
    """Marginals are always there; trajectories only where every member has them."""
    marginal = Predictive(location=torch.zeros(2, 1, 3, 1), noise=torch.ones(1, 1, 3, 1))
    joint = Predictive(location=torch.zeros(2, 1, 3, 1), noise=torch.ones(1, 1, 3, 1), joint=True)
    for parts, works in (((joint, joint), True), ((joint, marginal), False)):
        prediction = zoo.Prediction(
            predictive=pooled(parts),
            axes=("sequence", "time", "channel"),
            names=("x",),
            units=("rad",),
            task="forecast",
        )
        assert prediction.sample(4, joint=False).shape == (4, 1, 3, 1)
        if works:
            assert prediction.sample(4).shape == (4, 1, 3, 1)
        else:
            with pytest.raises(NoJointSamplesError):
                prediction.sample(4)
