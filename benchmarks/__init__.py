"""Measurements against named peers; each command writes JSON under ``results/``."""
