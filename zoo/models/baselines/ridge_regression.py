"""Kernel ridge regression of many outputs, with errors of held-out groups in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zoo.movement.cross_validation import held_out_errors

__all__ = ["Kernel", "Problem", "held_out_squares", "predicted", "square_distances"]


@dataclass(frozen=True)
class Kernel:
    """k(x, x′) = exp(−‖x − x′‖²/(2ℓ²)) with ℓ² ``width``² mean squared distances, and λ."""

    width: float
    ridge: float

    def gram(self, distances: Tensor, unit: Tensor) -> Tensor:
        """K of squared distances, whose mean over training places is ``unit``."""
        return torch.exp(-distances / (2 * self.width**2 * unit))


@dataclass(frozen=True)
class Problem:
    """Inputs and outputs of training places; ``seen`` says which outputs are known."""

    inputs: Float[Tensor, "place feature"]
    outputs: Float[Tensor, "place target"]
    seen: Bool[Tensor, "place target"]
    group: Int[Tensor, " place"]


def square_distances(x: Tensor, y: Tensor) -> Float[Tensor, "row column"]:
    """‖x_i − y_j‖².

    >>> square_distances(torch.tensor([[0.0]]), torch.tensor([[3.0], [4.0]]))
    tensor([[ 9., 16.]])
    """
    both = x.square().sum(1)[:, None] + y.square().sum(1) - 2 * x @ y.mT
    return both.clamp(min=0)


def predicted(
    kernel: Kernel, problem: Problem, queries: Float[Tensor, "query feature"]
) -> tuple[Float[Tensor, "query target"], Float[Tensor, " target"]]:
    """Outputs of ``queries``, and the root mean square of the errors of held-out groups."""
    mean = _mean(problem)
    distances = square_distances(problem.inputs, problem.inputs)
    gram = kernel.gram(distances, _unit(distances))
    root = torch.linalg.cholesky(gram + kernel.ridge * torch.eye(len(gram), dtype=gram.dtype))
    inverse = torch.cholesky_inverse(root)
    error = held_out_errors(inverse, problem.outputs - mean, problem.group)
    near = kernel.gram(square_distances(queries, problem.inputs), _unit(distances))
    square = (error.square() * problem.seen).sum(0) / problem.seen.sum(0).clamp(min=1)
    return mean + near @ (inverse @ (problem.outputs - mean)), square.sqrt()


def held_out_squares(problem: Problem, kernels: Sequence[Kernel]) -> Float[Tensor, "kernel target"]:
    """Summed squared errors of held-out groups; kernels of one width share a decomposition."""
    distances = square_distances(problem.inputs, problem.inputs)
    centred = problem.outputs - _mean(problem)
    grams = {k.width: k.gram(distances, _unit(distances)) for k in kernels}
    parts = {width: torch.linalg.eigh(gram) for width, gram in grams.items()}
    squares = []
    for kernel in kernels:
        values, vectors = parts[kernel.width]
        inverse = (vectors / (values.clamp(min=0) + kernel.ridge)) @ vectors.mT
        error = held_out_errors(inverse, centred, problem.group)
        squares.append((error.square() * problem.seen).sum(0))
    return torch.stack(squares)


def _mean(problem: Problem) -> Float[Tensor, " target"]:
    mean: Tensor = (problem.outputs * problem.seen).sum(0) / problem.seen.sum(0).clamp(min=1)
    return mean


def _unit(distances: Tensor) -> Tensor:
    return distances.mean().clamp(min=torch.finfo(distances.dtype).tiny)
