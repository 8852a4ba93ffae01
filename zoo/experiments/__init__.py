"""Experiments of the thesis by id: each writes a table, its numbers and a figure."""

from __future__ import annotations

from zoo.experiments.result import EXPERIMENTS, Experiment, Result, run_experiment

__all__ = ["EXPERIMENTS", "Experiment", "Result", "run_experiment"]
