"""Dynamics as pure functions of tensors."""
