"""Experiments of chapter 5: movement primitives in autoencoders."""
