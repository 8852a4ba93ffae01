"""Minimisers of a smooth objective with few parameters: L-BFGS and a trust-region Newton method.

Both see the objective as a function from a vector to its value and gradient; a value that is not
finite sends them back to the best point so far with a smaller step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, OptimizeResult, minimize

from zoo.errors import TrainingError

__all__ = ["MINIMISERS", "Evaluate", "Report", "Vector", "l_bfgs", "newton"]

Vector = NDArray[np.float64]
Evaluate = Callable[[Vector], tuple[float, Vector]]
Report = Callable[[Vector, float, Vector], None]

_RETREATS = 20
_REACH = 1.0
_DIFFERENCE = 1e-4
_SMALLEST_RADIUS = 1e-8


class _NotFinite(Exception):
    """Leaves the optimiser; carries the point."""


def l_bfgs(
    evaluate: Evaluate, start: Vector, *, iterations: int, tolerance: float, report: Report
) -> Vector:
    """Minimise by L-BFGS-B in a box around the best point, moved on when the search reaches it.

    The box keeps the first line search, which knows no curvature yet, from leaping into a far
    valley; it halves after each value that is not finite.

    >>> quadratic = lambda x: (float(x @ x), 2 * x)
    >>> bool(abs(l_bfgs(quadratic, np.ones(3), iterations=9, tolerance=1e-9,
    ...     report=lambda *_: None)).max() < 1e-6)
    True
    """
    search = _Search(evaluate, report)
    search(start)
    reach, failures = _REACH, 0
    while search.iterations < iterations and failures < _RETREATS:
        try:
            end = search.run(reach, iterations - search.iterations, tolerance)
        except _NotFinite as failure:
            reach = 0.5 * float(np.abs(failure.args[0] - search.best).max())
            failures += 1
            continue
        if np.abs(end.x - end.start).max() < 0.99 * reach:
            return search.best
    if failures == _RETREATS:
        raise TrainingError(
            f"the objective was not finite on {failures} occasions, last within {reach:.1e} of "
            f"{search.best}; scale the data, or raise noise_floor or jitter"
        )
    return search.best


class _Search:
    """Best point and last gradient of one L-BFGS search."""

    def __init__(self, evaluate: Evaluate, report: Report) -> None:
        self.evaluate, self.report = evaluate, report
        self.value, self.iterations = np.inf, 0
        self.gradients: dict[bytes, Vector] = {}

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        value, gradient = self.evaluate(x)
        if not np.isfinite(value) or not np.isfinite(gradient).all():
            raise _NotFinite(x.copy())
        if value < self.value:
            self.best, self.value = x.copy(), value
        self.gradients[x.tobytes()] = gradient
        return value, gradient

    def run(self, reach: float, iterations: int, tolerance: float) -> Any:
        """One call of the optimiser from the best point, at most ``reach`` away from it."""
        start = self.best.copy()

        def follow(*, intermediate_result: OptimizeResult) -> None:
            x = np.array(intermediate_result.x)
            gradient = self.gradients[x.tobytes()]
            self.gradients.clear()
            self.iterations += 1
            self.report(x, float(intermediate_result.fun), gradient)

        end = minimize(
            self,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=Bounds(start - reach, start + reach),
            callback=follow,
            options={"maxiter": iterations, "ftol": tolerance, "gtol": tolerance},
        )
        end.start = start
        return end


def newton(
    evaluate: Evaluate, start: Vector, *, iterations: int, tolerance: float, report: Report
) -> Vector:
    """Minimise by Newton steps in a trust region; the Hessian follows the exact gradients.

    It starts from differences of gradients, one evaluation a parameter, and is kept up to date by
    the symmetric rank-one secant formula, which also learns from rejected steps. Ends after the
    full step whose predicted gain is below ``tolerance`` relative to the objective.

    >>> bowl = lambda x: (float((x**4).sum() + x @ x), 4 * x**3 + 2 * x)
    >>> bool(abs(newton(bowl, np.ones(2), iterations=50, tolerance=1e-12,
    ...     report=lambda *_: None)).max() < 1e-4)
    True
    """
    x = start.copy()
    value, gradient = evaluate(x)
    curvature = _differences(evaluate, x, gradient)
    radius = 1.0
    for _ in range(iterations):
        step, gain = _newton_step(curvature, gradient, radius)
        new_value, new_gradient = evaluate(x + step)
        usable = bool(np.isfinite(new_value) and np.isfinite(new_gradient).all())
        ratio = (value - new_value) / gain if usable and gain > 0 else -np.inf
        if usable:
            curvature = _secant(curvature, step, new_gradient - gradient)
        length = float(np.linalg.norm(step))
        small = length < 0.99 * radius and gain <= tolerance * max(1.0, abs(value))
        radius = _next_radius(radius, length, ratio)
        if ratio > 0:
            x, value, gradient = x + step, new_value, new_gradient
            report(x, value, gradient)
        if small or radius < _SMALLEST_RADIUS:
            break
    return x


MINIMISERS: dict[str, Callable[..., Vector]] = {"l-bfgs": l_bfgs, "newton": newton}


def _differences(evaluate: Evaluate, x: Vector, gradient: Vector) -> Vector:
    """Hessian by forward differences of the gradient; curvature 1 where one is not finite."""
    columns = []
    for i in range(len(x)):
        shift = np.zeros_like(x)
        shift[i] = _DIFFERENCE
        columns.append((evaluate(x + shift)[1] - gradient) / _DIFFERENCE)
    matrix = np.stack(columns, 1)
    matrix = 0.5 * (matrix + matrix.T)
    return matrix if np.isfinite(matrix).all() else np.eye(len(x))


def _newton_step(curvature: Vector, gradient: Vector, radius: float) -> tuple[Vector, float]:
    """Step against the gradient in units of |curvature|, and the gain that it predicts."""
    values, vectors = np.linalg.eigh(curvature)
    size = np.maximum(np.abs(values), 1e-8 * np.abs(values).max() + 1e-300)
    step = -vectors @ ((vectors.T @ gradient) / size)
    step *= min(1.0, radius / max(float(np.linalg.norm(step)), 1e-300))
    along = vectors.T @ step
    return step, float(-(gradient @ step) - 0.5 * (size * along**2).sum())


def _secant(curvature: Vector, step: Vector, change: Vector) -> Vector:
    residual = change - curvature @ step
    product = float(residual @ step)
    if abs(product) < 1e-8 * float(np.linalg.norm(residual) * np.linalg.norm(step)):
        return curvature
    updated: Vector = curvature + np.outer(residual, residual) / product
    return updated


def _next_radius(radius: float, length: float, ratio: float) -> float:
    if ratio < 0.1:
        return 0.25 * length
    return max(radius, 2 * length) if ratio > 0.75 else radius
