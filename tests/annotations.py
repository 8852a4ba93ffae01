"""A type checker of array annotations alone, for jaxtyping's import hook."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray

__all__ = ["arrays_checked"]


def arrays_checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` with those of its annotations checked that name an array's shape.

    Annotations of anything else are left to mypy: some name types that only exist for it.
    """
    hints = {name: hint for name, hint in function.__annotations__.items() if _of_arrays(hint)}
    if not hints:
        return function
    function.__annotations__ = hints
    checked: Callable[..., Any] = beartype(function)
    return checked


def _of_arrays(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(_of_arrays(part) for part in get_args(hint))
