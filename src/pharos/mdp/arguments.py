"""Checks of arguments: each error names the argument, the value found, and the first entry that is wrong.

`require_mdp` suggests what to write if a function gets something that an MDP can be made of. The others check the parts
of a TabularMDP.
"""

import functools
import math
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.system.wording import capped

P = ParamSpec("P")
R = TypeVar("R")


def require_mdp(function: Callable[P, R]) -> Callable[P, R]:
    """The function with a check: ParameterError, with a remedy, unless its first argument is a TabularMDP."""

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        from pharos.mdp.tabular import TabularMDP  # which imports files of this package that use this function

        value = args[0] if args else kwargs.get("mdp")
        if not isinstance(value, TabularMDP) and (args or "mdp" in kwargs):
            raise ParameterError(
                f"{function.__name__}: found {capped(repr(value), 60)}; expected a TabularMDP: write {_remedy(value)}"
            )
        return function(*args, **kwargs)

    return checked


def _remedy(value: object) -> str:
    from pharos.environments import Environment
    from pharos.state_space import StateSpace  # which takes longer to load than all that chance needs

    if isinstance(value, StateSpace):
        return "space.mdp(gamma=0.99)"
    if isinstance(value, Environment):
        return "pharos.build(env).mdp(gamma=0.99)"
    if isinstance(value, str):
        return f"pharos.build({value!r}).mdp(gamma=0.99)"
    return "pharos.build(env).mdp(gamma=0.99), or TabularMDP.from_arrays(...)"


def array_argument(value: object, name: str, dtype: npt.DTypeLike | None = None) -> np.ndarray:
    """The argument `name` as an array. ParameterError if it is none, such as lists of several lengths."""
    try:
        return np.asarray(value, dtype)
    except (ValueError, TypeError) as error:
        raise ParameterError(f"{name}: {capped(error)}; expected an array of numbers") from None


def checked_next_states(next_states: object) -> np.ndarray:
    """(S, A) int32 or int64: the next state of each action, -1 for the end.

    Raises:
        ParameterError: it is not a table of states. The first wrong entry is named.
    """
    table = array_argument(next_states, "next_states")
    if table.ndim != 2 or table.size == 0 or table.dtype.kind not in "iu":
        raise ParameterError(
            f"next_states has shape {table.shape} and type {table.dtype}; expected integers of shape (states, actions)"
        )
    outside = (table < -1) | (table >= len(table))
    if outside.any():
        s, a = map(int, np.argwhere(outside)[0])
        raise ParameterError(
            f"next_states[{s}, {a}] is {table[s, a]}; expected a state from 0 to {len(table) - 1}, or -1 for the end"
        )
    return np.ascontiguousarray(table, np.int32 if len(table) < 2**31 else np.int64)


STEPS_EXPECTED = "a whole number of steps, at least 1"


def whole_number(
    value: object, name: str, expected: str = "a whole number, at least 1", least: int = 1, most: float = math.inf
) -> int:
    """The number. ParameterError unless it is whole, and in [least, most]."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise ParameterError(f"{name} is {value!r}; expected {expected}")
    return int(value)


def check_gamma(gamma: object) -> None:
    """ParameterError unless it is a discount."""
    if not (isinstance(gamma, int | float | np.floating) and math.isfinite(gamma) and 0 <= gamma <= 1):
        raise ParameterError(f"gamma is {gamma!r}; expected a number in [0, 1]")


def check_horizon(horizon: object) -> None:
    """ParameterError unless it is a number of steps, or None."""
    if horizon is not None:
        whole_number(horizon, "horizon", f"{STEPS_EXPECTED} and below 2^31, or None", most=2**31 - 1)


def terminal_states(terminal: npt.ArrayLike | None, default: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """(S,) bool, the terminal states: those given, which must be among the allowed ones, or the default."""
    if terminal is None:
        return default
    mask = np.asarray(terminal, np.bool_)
    if mask.shape != allowed.shape or (mask & ~allowed).any():
        raise ParameterError(
            f"terminal has shape {mask.shape}; expected {allowed.shape}, true only where a state leads to itself (or "
            "to -1) with reward 0 by every action"
        )
    return mask


def start_of(initial: npt.ArrayLike, num_states: int) -> tuple[np.ndarray, np.ndarray]:
    """(start states (K,), their probabilities (K,)) of a state, several states, or (S,) probabilities."""
    start = np.asarray(initial)
    if start.dtype.kind in "iu" and start.ndim == 0:
        states, probabilities = start.reshape(1), np.ones(1)
    elif start.dtype.kind in "iu" and start.ndim == 1 and len(start):
        states, counts = np.unique(start, return_counts=True)
        probabilities = counts / counts.sum()
    elif start.dtype.kind == "f" and start.shape == (num_states,):
        if not (np.isfinite(start).all() and (start >= 0).all() and abs(start.sum() - 1) < 1e-9):
            raise ParameterError(f"initial sums to {start.sum()}; expected {num_states} probabilities that sum to 1")
        states = np.flatnonzero(start)
        probabilities = start[states]
    else:
        raise ParameterError(
            f"initial has shape {start.shape} and type {start.dtype}; expected a state, several states, or "
            f"({num_states},) probabilities"
        )
    if (states < 0).any() or (states >= num_states).any():
        raise ParameterError(
            f"initial names state {states[(states < 0) | (states >= num_states)][0]}; expected 0 to {num_states - 1}"
        )
    return states.astype(np.int64), np.asarray(probabilities, np.float64)
