"""Checks that the classes of environments share: each normalizes one parameter, or says whose, expected and found."""

import math
import numbers
import operator
from collections.abc import Callable, Iterable
from typing import Any

from pharos.environments.base import Environment
from pharos.errors import ParameterError


def integer(env: Environment, name: str, low: int, high: int | None = None) -> int:
    """Store parameter `name` of `env` as an int and return it; ParameterError unless low <= value <= high."""
    value = getattr(env, name)
    expected = f"expected an integer of at least {low}" if high is None else f"expected an integer from {low} to {high}"
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or number < low or (high is not None and number > high):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; {expected}")
    return store(env, name, int(number))


def number(env: Environment, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Store parameter `name` of `env` as a float; ParameterError unless finite and low <= value <= high."""
    value = getattr(env, name)
    if not is_real(value) or not low <= value <= high:
        bounds = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected a finite number{bounds}")
    return store(env, name, float(value))


def truth(env: Environment, name: str) -> bool:
    """Store parameter `name` of `env` as a bool and return it; ParameterError unless it is True, False, 0 or 1."""
    value = getattr(env, name)
    if isinstance(value, str) or value not in (True, False):
        raise ParameterError(f"{type(env).__name__}: {name}={value!r}; expected True or False")
    return store(env, name, bool(value))


def is_real(value: object) -> bool:
    """Whether `value` is a finite real number (and not a bool)."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def store(env: Environment, name: str, value: Any) -> Any:
    """Set a field of a frozen dataclass while it is being made."""
    object.__setattr__(env, name, value)
    return value


def integers(env: Environment, name: str, expected: str, allowed: Callable[[int], bool]) -> tuple[int, ...]:
    """Store parameter `name` of `env`, a number, a sequence or text such as "1,2,3", as a non-empty tuple of ints."""
    found = getattr(env, name)
    try:
        if isinstance(found, str):
            values = tuple(int(part) for part in found.split(","))
        else:
            values = tuple(map(operator.index, found)) if isinstance(found, Iterable) else (operator.index(found),)
    except (TypeError, ValueError):
        values = ()
    if not values or not all(map(allowed, values)):
        raise ParameterError(f"{type(env).__name__}: {name}={found!r}; expected integers, each {expected}")
    return store(env, name, values)
