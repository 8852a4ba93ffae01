"""Experiments of chapter 6: movement primitives in latent dynamics."""
