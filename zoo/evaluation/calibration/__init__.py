"""Recalibration of bands on held-out groups."""
