"""Figures of predictions, of their scores and of postures."""
