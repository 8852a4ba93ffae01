"""Latent state-space models with filtering guides."""
