"""Checks of arguments, and the one rule for the sums of rows, in whatever form they were given.

Each error names the argument, the value found, and the first entry that is wrong. `require_mdp` suggests what to write
if a function gets something that an MDP can be made of. The others check the parts of a TabularMDP.

Sums of rows:

| sum of a row | what happens |
|---|---|
| within 1e-6 of 1 | the row is divided by its sum. What that may change is counted in the error bounds of values |
| lower | the rest ends the episode if the caller has said that rows may end, else an error |
| higher | an error |
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.system.arrays import rounding_of_sums
from pharos.system.wording import capped

P = ParamSpec("P")
R = TypeVar("R")
NumberOrArray = TypeVar("NumberOrArray", float, np.ndarray)
STEPS_EXPECTED = "a whole number of steps, at least 1"
ROUNDED = 1e-6
"""The sum of a row that was rounded differs from 1 by at most this."""


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
    """(start states (K,), their probabilities (K,)) of a state, several states, or (S,) probabilities.

    S integers of which one is 1 and the others are 0 are probabilities; of two states 0, 1 are the states.
    """
    start = np.asarray(initial)
    is_row = start.dtype.kind in "iu" and start.shape == (num_states,) and num_states > 2
    if is_row and start.max() == 1 and (np.sort(start)[:-1] == 0).all():
        start = start.astype(np.float64)
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


# Sums of rows ---------------------------------------------------------------------------------------------------------


class Residual(NamedTuple):
    """Distance to which the bounds of values cover other MDPs: what the sums of rows leave open.

    The MDP is the one with the divided rows P. Its values also hold, within their bounds, for every MDP with other rows
    P' and rewards r' that is as near as the sums say:

        sum over t of |P'(t | s, a) - P(t | s, a)| <= d      the end counts as an outcome; no other outcome is new
        |r'(s, a) - r(s, a)| <= e

    where d is the largest |sum - 1| of a row and e the same times the largest reward of an outcome of that row (0 if
    rewards were given for states and actions). The rows as they were given are such P', if what they lack ends the
    episode. With V' = T' V', |V' - V| <= |T' V' - T' V| + |T' V - T V| <= gamma |V' - V| + gamma d |V| + e in the
    maximum norm, hence |V' - V| <= (gamma d |V| + e) / (1 - gamma). With a horizon, or if no state is visited twice,
    the step from one backup to the next is the same, and the sum has as many terms as there are steps.

    Attributes:
        probabilities: d, the largest |sum - 1| of a row. rewards: e, in reward.
    """

    probabilities: float = 0.0
    rewards: float = 0.0

    def deviation(self, gamma: float, largest: NumberOrArray) -> NumberOrArray:
        """gamma d |V| + e: how far a backup of values up to `largest` may be from the backup of such an MDP."""
        return gamma * self.probabilities * largest + self.rewards

    def plus(self, other: "Residual") -> "Residual":
        """The distance to MDPs within one residual of an MDP that is within the other one."""
        return Residual(self.probabilities + other.probabilities, self.rewards + other.rewards)

    @staticmethod
    def of(residuals: np.ndarray, largest: np.ndarray | float = 0.0) -> "Residual":
        """The largest of |sum - 1| (N,) of all rows, and of its products with the largest reward of each row (N,)."""
        return Residual(float(residuals.max(initial=0.0)), float((residuals * largest).max(initial=0.0)))


def normalized_rows(
    probabilities: np.ndarray,
    rows: np.ndarray,
    count: int,
    refuse: Callable[[int, float], Exception],
    *,
    ends: bool | np.ndarray = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (probabilities (N,), |sum - 1| (count,) of the rows that were divided by their sums, else 0).

    Rows that sum to 1 up to the rounding of their entries keep every bit.

    Args:
        probabilities: (N,) finite numbers >= 0. rows: (N,) the row of each.
        refuse: (row, sum) -> the error to raise.
        ends: True: what lacks by more than 1e-6 ends the episode; or (count,) the probability that each row ends, a
            part of its sum.
    """
    most = int(np.bincount(rows, minlength=1).max())
    sums = np.bincount(rows, probabilities, minlength=count)
    if not isinstance(ends, bool):
        sums = sums + ends
    away, rounding = np.abs(sums - 1), rounding_of_sums(most)
    is_near = away <= ROUNDED + rounding
    wrong = ~is_near & ~((sums < 1) & (ends is True))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise refuse(row, float(sums[row]))
    is_divided = is_near & (away > rounding)
    if not is_divided.any():
        return probabilities, np.zeros(count)
    return probabilities / np.where(is_divided, sums, 1.0)[rows], np.where(is_divided, away + rounding, 0.0)


def rounding_hint(total: float) -> str:
    """The likely reason if a sum is nearly 1, for the end of a message; else empty."""
    is_near = abs(total - 1) <= 1e-2
    return ": were they rounded, or computed in float32? divide each row by its sum" if is_near else ""
