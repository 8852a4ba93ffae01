"""Scores against scoringrules, brute force and closed forms."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import scoringrules
import torch
from scipy import stats

from zoo.evaluation.answers import Answer, clusters, estimate
from zoo.evaluation.figures.bands import (
    forecast_bands,
    pit_histogram,
    reliability,
    spread_over_time,
)
from zoo.evaluation.proper import crps, energy_scores, variogram_scores
from zoo.evaluation.scores import SCORES, Scores, score
from zoo.evaluation.table import Table
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive

SHAPE = (4, 6, 3)
GROUPS = {"trial": ("a", "b", "c", "d")}


def prediction(shape: tuple[int, ...] = SHAPE, **parts: Any) -> Prediction:
    sequences = len(shape) == 3
    return Prediction(
        predictive=Predictive(**parts),
        axes=("sequence", "time", "channel") if sequences else ("item", "target"),
        names=tuple(f"joint_{i}" for i in range(shape[-1])),
        units=("rad",) * shape[-1],
        task="forecast" if sequences else "regress",
        rate=30.0 if sequences else None,
    )


def mixture(components: int, shape: tuple[int, ...] = SHAPE) -> tuple[Prediction, torch.Tensor]:
    """A mixture of joint paths and a truth that is not drawn from it."""
    generator = torch.Generator().manual_seed(components)
    location = torch.randn(components, *shape, generator=generator, dtype=torch.float64)
    noise = 0.1 + torch.rand(shape[-1], generator=generator, dtype=torch.float64)
    truth = 1.5 * torch.randn(shape, generator=generator, dtype=torch.float64)
    return prediction(shape, location=location, noise=noise, joint=True), truth


def noise_of(p: Prediction) -> torch.Tensor:
    noise = p.predictive.noise
    assert noise is not None
    return noise


def value(scores: Scores, name: str) -> float:
    found = scores[name]
    assert found is not None
    return found.value


def test_errors_are_those_of_numpy_on_known_entries() -> None:
    p, truth = mixture(3)
    mask = torch.rand(SHAPE, generator=torch.Generator().manual_seed(1)) < 0.7
    scores = score(p, truth, mask, GROUPS)
    squares = (truth - p.mean)[mask].square()
    assert value(scores, "mse") == pytest.approx(float(squares.mean()))
    assert value(scores, "mse_sd") == pytest.approx(float(squares.std(unbiased=False)))
    assert value(scores, "rmse") == pytest.approx(float(squares.mean().sqrt()))
    assert scores.entries == int(mask.sum())
    ratio = []
    for c in range(SHAPE[-1]):
        y, e = truth[..., c][mask[..., c]], (truth - p.mean)[..., c][mask[..., c]]
        ratio.append(float(1 - e.square().sum() / (y - y.mean()).square().sum()))
    assert [row["r2"] for row in scores.channels] == pytest.approx(ratio)
    assert value(scores, "r2") == pytest.approx(np.mean(ratio))


def test_a_constant_channel_has_no_r2() -> None:
    p, truth = mixture(3)
    truth[..., 1] = 0.3
    scores = score(p, truth)
    assert scores.channels[1]["r2"] is None
    others = [scores.channels[i]["r2"] for i in (0, 2)]
    assert value(scores, "r2") == pytest.approx(np.mean(others))


def test_what_is_not_known_changes_nothing() -> None:
    p, truth = mixture(5)
    mask = torch.ones(SHAPE, dtype=torch.bool)
    mask[1, 2:4] = False
    other, missing = truth.clone(), truth.clone()
    other[~mask], missing[~mask] = 99.0, torch.nan
    results = [score(p, y, m, GROUPS).to_json() for y, m in ((truth, mask), (other, mask))]
    assert results[0] == results[1] == score(p, missing, None, GROUPS).to_json()


def test_padding_of_shorter_movements_is_left_out() -> None:
    p, truth = mixture(5)
    lengths = torch.tensor([6, 4, 6, 3])
    inside = (torch.arange(6) < lengths[:, None])[..., None].expand(SHAPE)
    ragged = Prediction(
        predictive=p.predictive,
        axes=p.axes,
        names=p.names,
        units=p.units,
        task=p.task,
        lengths=lengths,
    )
    assert score(ragged, truth).to_json() == score(p, truth, inside).to_json()


@pytest.mark.parametrize("components", [1, 7, 25])
def test_crps_of_mixtures_is_exact(components: int) -> None:
    p, truth = mixture(components)
    noise = noise_of(p).expand(components, *SHAPE)
    theirs = scoringrules.crps_mixnorm(
        truth.numpy(), p.predictive.location.numpy(), noise.numpy(), m_axis=0
    )
    np.testing.assert_allclose(crps(p, truth).numpy(), theirs, rtol=1e-9)


def test_crps_of_many_components_is_unbiased() -> None:
    p, truth = mixture(100, (40, 6, 3))
    noise = noise_of(p).expand(100, 40, 6, 3)
    theirs = scoringrules.crps_mixnorm(
        truth.numpy(), p.predictive.location.numpy(), noise.numpy(), m_axis=0
    )
    difference = crps(p, truth).numpy() - theirs
    assert abs(difference.mean()) < 6 * difference.std() / math.sqrt(difference.size)
    assert difference.std() < 0.03 * theirs.mean()


def test_crps_of_draws_is_that_of_the_ensemble() -> None:
    p, truth = mixture(30)
    draws = prediction(location=p.predictive.location, joint=True)
    theirs = scoringrules.crps_ensemble(
        truth.numpy(), p.predictive.location.numpy(), m_axis=0, estimator="nrg"
    )
    np.testing.assert_allclose(crps(draws, truth).numpy(), theirs, rtol=1e-9)


def test_energy_and_variogram_scores_of_joint_draws() -> None:
    p, truth = mixture(20, (5, 1, 3))
    draws = p.sample(20)
    answer = Answer.of(p, truth)
    flat, y = draws.flatten(2).movedim(0, 1).numpy(), truth.flatten(1).numpy()
    apart = np.linalg.norm(flat[:, :, None] - flat[:, None], axis=-1).sum((1, 2)) / (2 * 20 * 19)
    by_hand = np.linalg.norm(flat - y[:, None], axis=-1).mean(1) - apart
    np.testing.assert_allclose(energy_scores(draws, answer).numpy(), by_hand, rtol=1e-6)
    plain = scoringrules.es_ensemble(y, flat)
    np.testing.assert_allclose(by_hand, plain - apart + apart * 19 / 20, rtol=1e-6)
    theirs = scoringrules.vs_ensemble(y, flat, p=0.5)
    total, pairs = variogram_scores(draws, answer)
    np.testing.assert_allclose(2 * total.numpy(), theirs, rtol=1e-9)
    assert pairs.tolist() == [3.0] * 5


def test_joint_scores_leave_unknown_entries_out() -> None:
    p, truth = mixture(20)
    mask = torch.ones(SHAPE, dtype=torch.bool)
    mask[..., 2] = False
    less = prediction(
        (*SHAPE[:2], 2), location=p.predictive.location[..., :2], noise=noise_of(p)[:2]
    )
    draws = p.sample(20)
    all_three, two = Answer.of(p, truth, mask), Answer.of(less, truth[..., :2])
    torch.testing.assert_close(energy_scores(draws, all_three), energy_scores(draws[..., :2], two))
    torch.testing.assert_close(
        variogram_scores(draws, all_three), variogram_scores(draws[..., :2], two)
    )


def test_interval_coverage_width_and_density_of_a_gaussian() -> None:
    shape = (200, 2)
    truth = torch.randn(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    p = prediction(shape, location=torch.zeros(1, *shape).double(), noise=torch.ones(1).double())
    scores = score(p, truth)
    half = stats.norm.ppf(0.95)
    assert value(scores, "width_90") == pytest.approx(2 * half)
    assert value(scores, "coverage_90") == pytest.approx(
        100 * float((truth.abs() <= half).double().mean())
    )
    penalty = 2 / 0.1 * (truth.abs() - half).clamp(min=0)
    assert value(scores, "interval_90") == pytest.approx(float((2 * half + penalty).mean()))
    assert value(scores, "nll") == pytest.approx(-stats.norm.logpdf(truth.numpy()).mean())
    assert scores["energy"] is None


def test_coverage_and_pit_are_nominal_on_data_from_the_model() -> None:
    shape = (300, 5, 2)
    generator = torch.Generator().manual_seed(5)
    location = torch.randn(40, *shape, generator=generator, dtype=torch.float64)
    p = prediction(shape, location=location, noise=torch.full((2,), 0.4).double(), joint=True)
    scores = score(p, p.sample(1, seed=9, joint=False)[0])
    for level in (50, 80, 90, 95):
        found = scores[f"coverage_{level}"]
        assert found is not None and found.error is not None
        assert abs(found.value - level) < 6 * found.error
    curve = scores.reliability
    assert curve is not None
    assert stats.kstest(curve.pit.numpy(), "uniform").pvalue > 1e-4
    assert value(scores, "calibration_error") < 2


def test_standard_errors_count_groups_not_entries() -> None:
    """The SE of a mean of m groups of n equal entries is that of m numbers."""
    offsets = torch.randn(30, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    truth = offsets[:, None, None].expand(30, 50, 1)
    p = prediction((30, 50, 1), location=torch.zeros(1, 30, 50, 1).double())
    found = score(p, truth)["mse"]
    assert found is not None
    by_hand = float(offsets.square().std() / math.sqrt(30))
    assert found.error == pytest.approx(by_hand)


def test_windows_of_one_movement_are_one_group() -> None:
    groups = {"trial": ("1", "1", "2"), "subject": ("a", "a", "a"), "start": ("0", "5", "0")}
    assert clusters(groups, 3).tolist() == [0, 0, 1]
    assert clusters(groups, 3, by="subject").tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match="no group column 'series'"):
        clusters(groups, 3, by="series")


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    x = torch.randn(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = estimate(torch.stack([x, torch.ones(20)], 1), lambda s: s[..., 0] / s[..., 1])
    assert found is not None
    assert found.error == pytest.approx(float(x.std() / math.sqrt(20)))


def test_the_standard_error_of_r2_leaves_out_a_group_and_its_mean() -> None:
    """By leaving out every group in turn and computing R² of the rest anew."""
    generator = torch.Generator().manual_seed(5)
    level = 3 * torch.randn(6, 1, 1, generator=generator, dtype=torch.float64)
    truth = level + torch.randn(6, 5, 1, generator=generator, dtype=torch.float64)
    guess = truth + 0.5 * torch.randn(6, 5, 1, generator=generator, dtype=torch.float64)

    def r2(rows: torch.Tensor) -> float:
        apart = (truth[rows] - truth[rows].mean()).square().sum()
        return float(1 - (truth[rows] - guess[rows]).square().sum() / apart)

    found = score(prediction((6, 5, 1), location=guess[None]), truth)["r2"]
    left_out = [r2(torch.arange(6) != i) for i in range(6)]
    assert found is not None
    assert found.value == pytest.approx(r2(torch.arange(6)))
    assert found.error == pytest.approx(np.std(left_out) * math.sqrt(5))


def test_a_deterministic_prediction_has_errors_only() -> None:
    p = prediction(location=torch.zeros(1, *SHAPE))
    scores = score(p, torch.ones(SHAPE), groups=GROUPS)
    assert set(scores.values) == {"mse", "mse_sd", "rmse"}
    assert scores.reliability is None


def test_wrong_shapes_are_named() -> None:
    p, truth = mixture(2)
    with pytest.raises(ValueError, match=r"truth has shape \(4, 5, 3\)"):
        score(p, truth[:, :5])
    with pytest.raises(ValueError, match="no entry"):
        score(p, truth, torch.zeros(SHAPE, dtype=torch.bool))


def test_the_table_is_readable_everywhere() -> None:
    p, truth = mixture(10)
    still = prediction(location=torch.zeros(1, *SHAPE))
    answers = [("forecast", score(p, truth)), ("reconstruct", score(still, truth))]
    table = Table.of("vae-dmp", "tiny", answers)
    text, markdown, page = str(table), table.to_markdown(), table._repr_html_()
    assert "vae-dmp on tiny" in text and "inside 90 % band" in text and "—" in text
    assert markdown.count("|\n") == len(table.body) + 2
    assert page.count("<tr>") == len(table.body) + 1
    kept = json.loads(json.dumps(table.to_json(), allow_nan=False))
    assert set(kept["answers"][0]["scores"]) == set(SCORES) - {"nll_raw"}
    joined = Table.join([table, Table.of("pca", "tiny", answers[:1])])
    assert joined.header[2:] == ["vae-dmp · forecast", "vae-dmp · reconstruct", "pca · forecast"]


def test_figures_draw_what_they_are_given() -> None:
    p, truth = mixture(10)
    whole = torch.cat([truth[:, :2], truth], 1)
    bands = forecast_bands(p, whole, seen=2, channels=["joint_2", "joint_0", "joint_1"])
    assert [a.get_title(loc="left") for a in bands.axes] == ["joint_2", "joint_0", "joint_1"]
    assert bands.axes[0].get_ylabel() == "rad"
    line = reliability({"a": (p, truth, None, GROUPS), "b": (p, truth)}).axes[0]
    assert "truths inside it (%)" in line.get_ylabel()
    assert pit_histogram((p, truth)).axes[0].patches
    assert len(spread_over_time(p, truth).axes[0].lines) == 3
