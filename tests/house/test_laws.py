"""The laws can be broken: models that are wrong on purpose fail them."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
from laws import check_exact, check_program, check_uniform, judged
from support import run_of
from torch import Tensor

from zoo.models.frames.pca import PCA
from zoo.prediction.predictive import Predictive
from zoo.runs.run import Run
from zoo.types import Batch


class Flipped(PCA):
    """Its posterior mean has the wrong sign."""

    def _posterior(self, batch: Batch) -> tuple[Tensor, Tensor]:
        mean, covariance = super()._posterior(batch)
        return -mean, covariance


class Narrow(PCA):
    """Its bands are half as wide as they should be."""

    def impute(self, batch: Batch, posterior: Any, *, draws: int) -> Predictive:
        """The imputation with half its standard deviations."""
        answer = super().impute(batch, posterior, draws=draws)
        assert answer.noise is not None and answer.epistemic is not None
        return replace(answer, noise=answer.noise / 2, epistemic=answer.epistemic / 2)


class Mute(PCA):
    """Its program raises."""

    def forward(self, batch: Batch) -> Tensor:
        """Nothing."""
        raise NotImplementedError


class Deaf(PCA):
    """Its program observes whatever it is asked."""

    def forward(self, batch: Batch) -> Tensor:
        """The program of observed data."""
        return super().forward(replace(batch, observed=True))


def broken(kind: type[PCA]) -> Run:
    """A trained run of pca whose model is of a broken kind."""
    run = run_of("pca")
    model, guide = copy.deepcopy((run.model, run.assembly.guide))
    model.__class__ = kind
    return replace(run, assembly=replace(run.assembly, model=model, guide=guide))


def test_the_whole_one_passes() -> None:
    run = broken(PCA)
    check_program(run)
    check_exact(run)
    check_uniform(judged(run, "impute joints"))


@pytest.mark.parametrize("task", ["impute joints"])
@pytest.mark.parametrize("kind", [Flipped, Narrow])
def test_wrong_answers_are_not_calibrated(kind: type[PCA], task: str) -> None:
    with pytest.raises(AssertionError, match="not uniform"):
        check_uniform(judged(broken(kind), task))


def test_a_wrong_posterior_moves_the_bound() -> None:
    with pytest.raises(AssertionError, match="the bound moves"):
        check_exact(broken(Flipped))


def test_a_program_that_raises_or_draws_nothing_is_refused() -> None:
    with pytest.raises(NotImplementedError):
        check_program(broken(Mute))
    with pytest.raises(AssertionError, match="observed although"):
        check_program(broken(Deaf))
