"""Experiments of the thesis by id: each writes a table, its numbers and a figure."""

from __future__ import annotations

from zoo.studies.result import EXPERIMENTS, Experiment, Result, run_experiment
from zoo.studies.stored import Stored, stored

__all__ = ["EXPERIMENTS", "Experiment", "Result", "Stored", "run_experiment", "stored"]
