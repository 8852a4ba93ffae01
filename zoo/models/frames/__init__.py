"""Latent variables of single frames: linear, nonlinear, with dynamics."""
