"""Asking the rules in Python, one state after the other, and naming the state, the action and the outcome where one
breaks its contract.
"""

import numbers
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pharos.environments import Environment
from pharos.errors import RuleError

SUM_TOLERANCE = 1e-9
"""By how much the probabilities of the outcomes of an action may sum to something else than 1."""


class Branches(NamedTuple):
    """What N states lead to by B branches each: A actions, or, with chance, outcome k of action a as branch a K + k.

    Attributes:
        following: (N B, D) int64, or uint8 where it suffices; terminal states lead to themselves, and so do impossible
            outcomes.
        terminal: (N,) bool.
        probabilities: (N, B) float64; None without chance.
    """

    following: np.ndarray
    terminal: np.ndarray
    probabilities: np.ndarray | None = None


def interpreted_branches(env: Environment, rows: list[list[int]]) -> Branches:
    """Call the rules in each state; see `Branches`.

    Args:
        rows: N states, D integers each.
    Raises:
        RuleError: a rule raised an exception or broke its contract; names the state, the action and the outcome.
    """
    if env.has_chance or env.has_age:
        return _outcomes(env, rows)
    return Branches(*interpreted_successors(env, rows))


def interpreted_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Call the rules of a class without chance in each state.

    Args:
        rows: N states, D integers each.
    Returns:
        (N * A, D) int64, or uint8 where it suffices: row i * A + a the successor of state i by action a, terminal
        states leading to themselves; and (N,) bool, which states are terminal.
    Raises:
        RuleError: a rule raised an exception or left the declared ranges; names the state and the action.
    """
    quick = _small_successors(env, rows)
    if quick is not None:
        return quick
    actions = range(env.num_actions)
    transition, is_terminal = _transition(env), env.is_terminal
    terminal = np.zeros(len(rows), np.bool_)
    out: list[list[int]] = []
    try:
        for i, row in enumerate(rows):
            state = tuple(row)
            if is_terminal(state):
                terminal[i] = True
                out.extend([row] * len(actions))
                continue
            for action in actions:
                successor = row.copy()
                out.append(successor)
                transition(state, action, successor)
    except Exception as error:
        action_name = (
            "" if len(out) % len(actions) == 0 else f" by action {env.actions[(len(out) - 1) % len(actions)]!r}"
        )
        raise RuleError(f"{env}: in state {state}{action_name} a rule raises {error!r}") from error
    following = _array(out)
    components = env.components
    if following.shape == (len(out), len(components)):
        outside = ((following < components.low) | (following > components.high)).any(axis=1)
        suspects = np.flatnonzero(outside)[:1].tolist()
    else:
        suspects = list(range(len(out)))
    for j in suspects:
        i, action = divmod(j, len(actions))
        check_successor(env, tuple(rows[i]), action, out[j])
    return following, terminal


def _small_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray] | None:
    """The same for integers from 0 to 255, the usual case: each successor becomes bytes at once, and no list is kept.

    None where a rule raises, an integer is another or a range is left: rules are pure, so that the caller can ask
    again.
    """
    transition, is_terminal, actions = _transition(env), env.is_terminal, range(env.num_actions)
    terminal = np.zeros(len(rows), np.bool_)
    out: list[bytes] = []
    try:
        for i, row in enumerate(rows):
            state = tuple(row)
            if is_terminal(state):
                terminal[i] = True
                out.extend([bytes(row)] * len(actions))
                continue
            for action in actions:
                successor = row.copy()
                transition(state, action, successor)
                out.append(bytes(successor))
    except Exception:
        return None
    components = env.components
    data = b"".join(out)
    if len(data) != len(out) * len(components) or len(set(map(len, out))) != 1:
        return None
    following = np.frombuffer(data, np.uint8).reshape(len(out), -1)
    if (following.min(axis=0) < components.low).any() or (following.max(axis=0) > components.high).any():
        return None
    return following, terminal


def _transition(env: Environment) -> Callable[..., None]:
    """transition(state, action, out) of an instance without chance, whether its class takes outcomes or not."""
    if env.takes_outcomes():
        return lambda state, action, out: env.transition(state, action, 0, out)
    return env.transition


def _array(out: list[list[int]]) -> np.ndarray:
    try:
        return np.array(out, np.int64)
    except (ValueError, TypeError, OverflowError):
        return np.empty((0, 0), np.int64)


def check_successor(env: Environment, state: tuple[int, ...], action: int, out: list[int], which: str = "") -> None:
    """RuleError where `out` is no state; `which` outcome it is, in words."""
    components = env.components
    where = f"{env}: {which}action {env.actions[action]!r} in state {state}"
    if len(out) != len(components):
        raise RuleError(f"{where} leaves {len(out)} components in `out`; expected {len(components)}")
    for name, value, low, high in zip(components.names, out, components.low, components.high, strict=True):
        if not isinstance(value, numbers.Real) or not low <= value <= high:
            raise RuleError(f"{where} leads to {name} = {value!r}; declared: {low} to {high}")


# Chance and ages ------------------------------------------------------------------------------------------------------


def _outcomes(env: Environment, rows: list[list[int]]) -> Branches:
    """The same for classes with chance or an age."""
    terminal = np.zeros(len(rows), np.bool_)
    probabilities = np.zeros((len(rows), env.num_actions, env.outcomes))
    following = np.empty((len(rows), env.num_actions, env.outcomes, len(env.components)), np.int64)
    for i, row in enumerate(rows):
        state = tuple(row)
        following[i] = row
        try:
            terminal[i] = env.is_terminal(state)
        except Exception as error:
            raise RuleError(f"{env}: in state {state} a rule raises {error!r}") from error
        if terminal[i]:
            probabilities[i, :, 0] = 1.0
            continue
        for action in range(env.num_actions):
            probabilities[i, action] = outcome_probabilities(env, state, action)
            for outcome in np.flatnonzero(probabilities[i, action]).tolist():
                following[i, action, outcome] = _outcome(env, state, action, outcome)
    flat = following.reshape(-1, len(env.components))
    return Branches(flat, terminal, probabilities.reshape(len(rows), -1) if env.has_chance else None)


def outcome_probabilities(env: Environment, state: tuple[int, ...], action: int) -> list[float]:
    """The probabilities of the K outcomes of an action; RuleError where they are no distribution."""
    probabilities = []
    for outcome in range(env.outcomes):
        where = f"{env}: probability of outcome {outcome} of action {env.actions[action]!r} in state {state}"
        try:
            probability = float(env.probability(state, action, outcome))
        except Exception as error:
            raise RuleError(f"{where} raises {error!r}") from error
        if not 0 <= probability <= 1 + SUM_TOLERANCE:
            raise RuleError(f"{where} is {probability!r}; expected a number from 0 to 1")
        probabilities.append(probability if probability > 0 else 0.0)
    total = 0.0
    for probability in probabilities:  # in the order of compiled rules
        total += probability
    if not abs(total - 1) <= SUM_TOLERANCE:
        raise RuleError(
            f"{env}: the probabilities of outcomes 0 to {env.outcomes - 1} of action {env.actions[action]!r} in state "
            f"{state} sum to {total!r}; expected 1"
        )
    return probabilities


def _outcome(env: Environment, state: tuple[int, ...], action: int, outcome: int) -> list[int]:
    """Where an outcome leads; RuleError where that is no state, or no older one."""
    which = f"outcome {outcome} of " if env.takes_outcomes() else ""
    out = list(state)
    try:
        if env.takes_outcomes():
            env.transition(state, action, outcome, out)
        else:
            env.transition(state, action, out)
        check_successor(env, state, action, out, which)
        if env.has_age and not env.age(tuple(out)) > env.age(state):
            raise RuleError(
                f"{env}: {which}action {env.actions[action]!r} leads from state {state} of age {env.age(state)} "
                f"to state {tuple(out)} of age {env.age(tuple(out))}; expected a larger one"
            )
    except RuleError:
        raise
    except Exception as error:
        raise RuleError(
            f"{env}: in state {state} by {which}action {env.actions[action]!r} a rule raises {error!r}"
        ) from error
    return out
