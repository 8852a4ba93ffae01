"""Guides: variational families, one file each; none knows a model by name."""
