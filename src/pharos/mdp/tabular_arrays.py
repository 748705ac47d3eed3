"""The parts that a TabularMDP is made of, checked: each error names the argument, and the first entry that is wrong."""

import math
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.rewards import Rewards


def as_array(value: Any, name: str, dtype: Any = None) -> np.ndarray:
    """An array of what a user gave under a name; ParameterError where it is none, such as lists of several lengths."""
    try:
        return np.asarray(value, dtype)
    except (ValueError, TypeError) as error:
        raise ParameterError(f"{name}: {' '.join(str(error).split())[:200]}; expected an array of numbers") from None


def checked_next_states(next_states: Any) -> np.ndarray:
    """(S, A) int32 or int64: where each action leads, -1 for the end.

    Raises:
        ParameterError: it is not a table of states; the first wrong entry is named.
    """
    table = as_array(next_states, "next_states")
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


def check_gamma(gamma: Any) -> None:
    """ParameterError unless it is a discount."""
    if not (isinstance(gamma, int | float | np.floating) and math.isfinite(gamma) and 0 <= gamma <= 1):
        raise ParameterError(f"gamma is {gamma!r}; expected a number in [0, 1]")


def check_horizon(horizon: Any) -> None:
    """ParameterError unless it is a number of steps, or None."""
    if horizon is not None and not (isinstance(horizon, int | np.integer) and 1 <= horizon < 2**31):
        raise ParameterError(
            f"horizon is {horizon!r}; expected a whole number of steps, at least 1 and below 2^31, or None"
        )


def rewards_of_shape(rewards: Any, shape: tuple[int, ...]) -> Rewards:
    """Rewards (S, A) of this shape; ParameterError where they have another, or one is not finite."""
    array = as_array(rewards, "rewards", np.float64)
    if array.shape != shape:
        raise ParameterError(f"rewards have shape {array.shape}; expected {shape}, one for each state and action")
    return Rewards.from_array(array)


def expected_over_outcomes(rewards: Any, probabilities: np.ndarray) -> np.ndarray:
    """(S, A) expected rewards: those given, or the mean of those of the outcomes, (S, A, K).

    Raises:
        ParameterError: they have neither shape, or one of a possible outcome is not finite.
    """
    array, shape = as_array(rewards, "rewards", np.float64), probabilities.shape
    if array.shape == shape[:2]:
        return array
    if array.shape != shape:
        raise ParameterError(
            f"rewards have shape {array.shape}; expected {shape[:2]}, one for each state and action, or {shape}, one "
            "for each outcome"
        )
    possible = probabilities > 0
    wrong = possible & ~np.isfinite(array)
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"the reward of state {s}, action {a}, outcome {k} is {array[s, a, k]}; expected a finite number"
        )
    return (probabilities * np.where(possible, array, 0.0)).sum(axis=2)


def terminal_states(terminal: Any, default: np.ndarray, allowed: np.ndarray) -> np.ndarray:
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


def start_of(initial: Any, num_states: int) -> tuple[np.ndarray, np.ndarray]:
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
