"""Generative models, one file each; none knows a guide."""
