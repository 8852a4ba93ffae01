"""Settings: frozen, keyword-only records whose fields say what they take."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import wraps
from numbers import Integral
from typing import Annotated, Any, TypeVar, dataclass_transform, get_type_hints

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass, is_pydantic_dataclass

__all__ = ["Count", "Layers", "Positive", "Share", "made", "settings"]

T = TypeVar("T")

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Layers = Annotated[
    Count | tuple[Count, ...], BeforeValidator(lambda v: tuple(v) if isinstance(v, list) else v)
]

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_NEEDED = {
    "int_type": "a whole number",
    "float_type": "a number",
    "bool_type": "True or False",
    "string_type": "text",
    "tuple_type": "a tuple",
    "finite_number": "finite",
    "literal_error": "{expected}",
    "greater_than": "above {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "below {lt:g}",
    "less_than_equal": "at most {le:g}",
}


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field,))
def settings(kind: type[T]) -> type[T]:
    """Make a class with annotated fields a pydantic dataclass: frozen, keyword-only and strict.

    Nothing is converted but a whole number where any number is asked, and a list where a tuple
    of :data:`Layers` is. A ``__post_init__`` may check what concerns two fields. Raises a
    ValueError that names the setting, what is needed and what came.

    >>> @settings
    ... class Config:
    ...     latent_dim: Count = 5
    ...     noise: Positive | None = None
    >>> Config(noise=2)
    Config(latent_dim=5, noise=2.0)
    >>> Config(latent_dim=0)
    Traceback (most recent call last):
    ValueError: latent_dim must be at least 1; got 0
    >>> Config(latent_dim="3")
    Traceback (most recent call last):
    ValueError: latent_dim must be a whole number; got '3'
    """
    strict: Any = dataclass(frozen=True, kw_only=True, config=_STRICT)(kind)
    strict.__init__ = _told(strict.__init__)
    made: type[T] = strict
    return made


def made(kind: type[T], given: Mapping[str, Any]) -> T:
    """A record of the settings ``given``; the fields of a plain dataclass are checked as strictly.

    Raises a ValueError that names the setting, what is needed and what came.

    >>> from dataclasses import make_dataclass
    >>> made(make_dataclass("Config", [("order", int)]), {"order": True})
    Traceback (most recent call last):
    ValueError: order must be a whole number; got True
    """
    try:
        return kind(**(given if is_pydantic_dataclass(kind) else _checked(kind, given)))
    except ValidationError as error:
        raise ValueError(_reason(error)) from None


def _told(checked: Callable[..., None]) -> Callable[..., None]:
    """An ``__init__`` of pydantic whose errors are one sentence."""

    @wraps(checked)
    def init(self: object, **given: Any) -> None:
        try:
            checked(self, **{name: _whole(value) for name, value in given.items()})
        except ValidationError as error:
            raise ValueError(_reason(error)) from None

    return init


def _whole(value: Any) -> Any:
    """A whole number of numpy as Python's."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else value


def _checked(kind: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a plain dataclass as JSON keeps them, so that a loaded run has the same."""
    hints = get_type_hints(kind, include_extras=True)
    values = {}
    for name in (f.name for f in fields(kind) if f.name in given):
        try:
            text = json.dumps(given[name], default=lambda array: array.tolist())
            values[name] = TypeAdapter(hints[name]).validate_json(text, strict=True)
        except ValidationError as error:
            raise ValueError(_reason(error, name)) from None
    return values


def _reason(error: ValidationError, name: str | None = None) -> str:
    """What is wrong with the first bad setting; of several types, the one that it nearly met."""
    errors = error.errors()
    first = errors[0]
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    name = name or str(first["loc"][0])
    if first["type"] == "unexpected_keyword_argument":
        return f"there is no setting {name!r}; got {first['input']!r}"
    same = [e for e in errors if not e["loc"] or str(e["loc"][0]) == str(first["loc"][0])]
    bounds = [e for e in same if not e["type"].endswith("_type")] or same
    needed = dict.fromkeys(_needed(e["type"], e["msg"], e.get("ctx", {})) for e in bounds)
    return f"{name} must be {' or '.join(needed)}; got {bounds[0]['input']!r}"


def _needed(kind: str, message: str, context: Mapping[str, Any]) -> str:
    if kind == "greater_than" and context["gt"] == 0:
        return "positive"
    return _NEEDED.get(kind, message).format(**context)
