"""Gaussian processes, exact and sparse."""
