"""Judging: bands from groups of their own, columns that can be far from 90, losses told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive
from zoo.studies.leaderboard import findings, judge, tables
from zoo.studies.leaderboard.cells import Cell, Found
from zoo.studies.leaderboard.judge import Judged
from zoo.studies.leaderboard.protocol import Fold, Protocol, Published
from zoo.studies.leaderboard.protocols import protocol

GROUPS, FRAMES, CHANNELS = 16, 40, 6
NAMES = tuple(f"joint_{i}" for i in range(CHANNELS))


def folds() -> list[Fold]:
    """Sixteen groups of one movement each in four folds."""
    parts = [tuple(range(k, GROUPS, 4)) for k in range(4)]
    return [
        Fold(
            judged=parts[k],
            calibration=parts[(k + 1) % 4],
            train=tuple(sorted(parts[(k + 2) % 4] + parts[(k + 3) % 4])),
        )
        for k in range(4)
    ]


def walks(seed: int = 0) -> Tensor:
    """Movements that are smooth in time, with a tempo and a size of their own."""
    generator = torch.Generator().manual_seed(seed)
    phase = 6 * torch.rand(GROUPS, 1, CHANNELS, generator=generator, dtype=torch.float64)
    size = 1 + 0.2 * torch.randn(GROUPS, 1, 1, generator=generator, dtype=torch.float64)
    return size * torch.sin(torch.linspace(0, 9, FRAMES).double()[:, None] + phase)


def prediction(mean: Tensor, noise: float = 1e-3) -> Prediction:
    """Gaussian forecasts."""
    return Prediction(
        predictive=Predictive(location=mean[None], noise=torch.tensor([noise]).to(mean)),
        axes=("sequence", "time", "channel"),
        names=NAMES,
        units=("rad",) * CHANNELS,
        task="forecast",
    )


def found(mean: Tensor, truth: Tensor, noise: float = 1e-3) -> Judged:
    """A forecaster judged in all folds."""
    answers = [(f, prediction(mean[list(f.calibration + f.judged)], noise)) for f in folds()]
    return judge.judged(answers, truth, torch.ones_like(truth).bool(), list(range(GROUPS)))


def test_nothing_is_fitted_on_the_judged_movements() -> None:
    """A judged truth blown up leaves its band its bits; one in its calibration part widens it."""
    truth = walks()
    mean = truth + 0.1 * walks(1)
    usual = found(mean, truth).scores["calibrated_width_90"]
    wild = truth.clone()
    wild[5] *= 1000
    moved = found(mean, wild).scores["calibrated_width_90"] != usual
    calibrated_on_5 = [row in folds()[0].judged for row in range(GROUPS)]
    assert moved.tolist() == calibrated_on_5


def test_hopeless_forecasts_are_told_from_good_ones() -> None:
    """All zeros and noise: bands as wide as the movements, and a CRPS to match."""
    truth = walks()
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(2)).double()
    good = found(truth + 0.1 * walks(1), truth).scores
    for mean in (torch.zeros_like(truth), noise):
        bad = found(mean, truth).scores
        assert bad["coverage_90"].mean() < 10
        assert bad["calibrated_coverage_90"].mean() == pytest.approx(90, abs=8)
        for name in ("calibrated_width_90", "calibrated_crps", "crps"):
            assert bad[name].mean() > 5 * good[name].mean()
        assert bad["calibrated_width_90"].mean() > 1.5 * float(truth.std())


def test_calibrated_coverage_can_be_far_from_what_is_said() -> None:
    """Groups of fold k err 3 times as much as those of fold k - 1: most bands are wrong."""
    truth, size = walks(), torch.tensor([3.0 ** (row % 4) for row in range(GROUPS)]).double()
    shifted = found(truth + 0.01 * size[:, None, None] * walks(1), truth)
    inside = shifted.scores["calibrated_coverage_90"]
    last = np.arange(GROUPS) % 4 == 3
    assert (inside[~last] > 99).all()
    assert (inside[last] < 30).all()
    even = found(truth + 0.1 * walks(1), truth).scores["calibrated_coverage_90"]
    assert even.mean() == pytest.approx(90, abs=5)


def test_an_overconfident_forecast_is_mended_and_stays_so_in_the_raw_columns() -> None:
    """Errors three times the stated standard deviation: raw far below 90, calibrated near."""
    truth = walks()
    error = 0.3 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(3)).double()
    scores = found(truth + error, truth, noise=0.1).scores
    assert scores["coverage_90"].mean() == pytest.approx(41.6, abs=3)
    assert scores["calibrated_coverage_90"].mean() == pytest.approx(90, abs=3)
    ratio = scores["calibrated_width_90"].mean() / scores["width_90"].mean()
    assert ratio == pytest.approx(3, rel=0.1)


def test_coverage_is_kept_by_group_channel_and_block() -> None:
    """Counted by hand in one cell; entries that were not asked for are left out."""
    truth = walks()
    mask = torch.ones_like(truth).bool()
    mask[:, :, 4] = False
    mean = truth + 0.1 * walks(1)
    answers = [(f, prediction(mean[list(f.calibration + f.judged)], 0.05)) for f in folds()]
    cube = judge.judged(answers, truth, mask, list(range(GROUPS))).coverage["raw"]
    assert cube.shape == (GROUPS, CHANNELS, judge.BLOCKS)
    assert np.isnan(cube[:, 4]).all() and not np.isnan(np.delete(cube, 4, 1)).any()
    first, last = judge.blocks(FRAMES)[2]
    inside = (0.1 * walks(1)[7, first:last, 3]).abs() <= 1.6448536 * 0.05
    assert cube[7, 3, 2] == pytest.approx(100 * float(inside.double().mean()))


def test_the_worst_channel_and_block_are_named() -> None:
    """One channel and the last frames of all err four times as much."""
    truth, error = walks(), 0.1 * walks(1)
    error[:, :, 2] *= 4
    error[:, 34:] *= 4
    mean = truth + error
    answers = [(f, prediction(mean[list(f.calibration + f.judged)], 0.1)) for f in folds()]
    seen = judge.judged(answers, truth, torch.ones_like(truth).bool(), list(range(GROUPS)))
    raw = Judged(
        scores={k: v for k, v in seen.scores.items() if not k.startswith("calibrated")},
        coverage={"raw": seen.coverage["raw"]},
    )
    row = tables.band_table(board({"dmp": raw})).rows[0]
    assert row[5].startswith("joint_2 ") and row[6].startswith("133–140 ")


def board(models: dict[str, Judged], name: str = "walk-setup-2", **options: Any) -> tables.Board:
    """A board of given scores, in the order of their errors."""
    order = sorted(models, key=lambda m: float(models[m].scores["mse"].mean()))
    return tables.Board(
        protocol=replace(protocol(name), **options),
        models={m: models[m] for m in order},
        units=("rad",) * CHANNELS,
        channels=NAMES,
        asked=NAMES,
        frames=FRAMES,
        seconds=dict.fromkeys(order, 1.0),
    )


def scored(degrees: float, inside: float) -> Judged:
    """Sixteen groups about an error in deg² and a calibrated coverage in per cent."""
    apart = np.linspace(0.9, 1.1, GROUPS)
    mse = np.deg2rad(np.deg2rad(degrees)) * apart
    return Judged(scores={"mse": mse, "calibrated_coverage_90": inside * apart**0.1}, coverage={})


def sentences(asked: tables.Board) -> tuple[str, ...]:
    """The findings of a board whose cells were computed."""
    cells = [
        Found(
            cell=Cell(protocol="x", model="mean", settings=((),), seed=0, number=k, fold=fold),
            prediction=None,
            error="",
            seconds=0.0,
        )
        for k, fold in enumerate(folds())
    ]
    return findings.findings(asked, cells, list(range(GROUPS)))


def one(lines: Sequence[str], word: str) -> str:
    """The only line with a word."""
    (line,) = (each for each in lines if word in each)
    return line


def test_where_we_lose_is_told() -> None:
    """Baselines that beat a model; published figures below our best; coverage outside 90 ± 3."""
    models = {
        "promp-rhythmic": scored(4.5, 90.0),
        "kernel-ridge": scored(6.0, 92.0),
        "dmp": scored(8.0, 94.5),
        "mean+dvbf": scored(9.0, 80.0),
        "mean": scored(40.0, 90.0),
    }
    told = sentences(board(models, "walk-setup-2-published"))
    assert "kernel-ridge (6 deg²) beats dmp, mean+dvbf." in one(told, "Where we lose")
    assert "Latent NSF 3.41; SDE Matching 4.26. They" in one(told, "Published figures")
    assert "not the same test set" in one(told, "Published figures")
    bands = one(told, "Calibrated")
    assert "3 of 5 entries (promp-rhythmic, kernel-ridge, mean)" in bands
    assert "outside: dmp 94.5 %, mean+dvbf 80.0 %" in bands
    design = one(told, "in 4 folds")
    assert "at least 8 movements" in design and "at most 80 %" in design
    nothing = sentences(board({k: models[k] for k in ("promp-rhythmic", "mean")}))
    assert "no baseline beats any other" in one(nothing, "Where we lose")
    assert not [line for line in nothing if "Published figures" in line]


def test_published_figures_stand_beside_ours_in_both_units() -> None:
    """1 deg² is (π/180)² rad²; each row says which walks it was judged on."""
    asked: Protocol = protocol("walk-setup-1-published")
    shown = board({"mean": scored(40.0, 90.0)}, asked.name, published=(Published("Rival", 3.0),))
    head, rows = tables.error_columns(shown), tables.error_rows(shown)
    assert head[:4] == ("model", "judged on", "MSE / deg² ± 95 %", "MSE / rad² ± 95 %")
    assert rows[0][:2] == ("mean", "35_01–16, held out") and rows[0][2].startswith("40 ± ")
    assert rows[1][:3] == ("Rival (published)", "35_31–34", 3.0)
    assert rows[1][3] == pytest.approx(3 * (np.pi / 180) ** 2)
    assert {len(row) for row in rows} == {len(head)}
    assert "judged on" not in tables.error_columns(board({"mean": scored(40.0, 90.0)}))
