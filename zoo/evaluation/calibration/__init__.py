"""Recalibration of bands on groups that the model never saw."""
