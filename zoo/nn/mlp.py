"""Fully connected networks in one breath."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

from torch import nn

__all__ = ["Activation", "activations", "mlp", "trunk", "widths"]

Activation = Literal["elu", "gelu", "relu", "sigmoid", "silu", "softplus", "tanh"]

activations: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "relu": nn.ReLU,
    "sigmoid": nn.Sigmoid,
    "silu": nn.SiLU,
    "softplus": nn.Softplus,
    "tanh": nn.Tanh,
}


def trunk(sizes: Sequence[int], activation: Activation = "relu") -> nn.Sequential:
    """Layers of the given sizes, each followed by the activation; one size alone is the identity.

    >>> trunk([50, 200, 100], "tanh")
    Sequential(
      (0): Linear(in_features=50, out_features=200, bias=True)
      (1): Tanh()
      (2): Linear(in_features=200, out_features=100, bias=True)
      (3): Tanh()
    )
    """
    _check(sizes, 1)
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), activations[activation]()]
    return nn.Sequential(*layers)


def mlp(sizes: Sequence[int], activation: Activation = "relu") -> nn.Sequential:
    """Layers of the given sizes with the activation between them and a linear output.

    >>> mlp([50, 200, 5], "tanh")
    Sequential(
      (0): Linear(in_features=50, out_features=200, bias=True)
      (1): Tanh()
      (2): Linear(in_features=200, out_features=5, bias=True)
    )
    """
    _check(sizes, 2)
    return nn.Sequential(*trunk(sizes[:-1], activation), nn.Linear(sizes[-2], sizes[-1]))


def widths(hidden: int | Sequence[int]) -> tuple[int, ...]:
    """Sizes of the hidden layers from a setting: one number is one layer, () is none.

    >>> widths(200), widths([36, 20]), widths(())
    ((200,), (36, 20), ())
    """
    sizes = (hidden,) if isinstance(hidden, int) else tuple(hidden)
    if any(size < 1 for size in sizes):
        raise ValueError(f"hidden layers must have at least 1 unit each; got {sizes}")
    return sizes


def _check(sizes: Sequence[int], least: int) -> None:
    if len(sizes) < least or any(size < 1 for size in sizes):
        raise ValueError(f"at least {least} layer sizes, all positive; got {list(sizes)}")
