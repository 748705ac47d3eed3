"""Rules called in Python: where Numba cannot compile them, and to name the state in which compiled ones failed."""

import numbers

import numpy as np

from pharos.environment import Environment
from pharos.errors import RuleError


def interpreted_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Call the rules in each state.

    Args:
        rows: N states, D integers each.
    Returns:
        (N * A, D) int64, row i * A + a the successor of state i by action a, terminal states leading to themselves; and
        (N,) bool, which states are terminal.
    Raises:
        RuleError: a rule raised an exception or left the declared ranges; names the state and the action.
    """
    quick = _small_successors(env, rows)
    if quick is not None:
        return quick
    actions = range(env.num_actions)
    transition, is_terminal = env.transition, env.is_terminal
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
        _check_successor(env, tuple(rows[i]), action, out[j])
    return following, terminal


def _small_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray] | None:
    """The same for integers from 0 to 255, the usual case: each successor becomes bytes at once, and no list is kept.

    None where a rule raises, an integer is another or a range is left: rules are pure, so that the caller can ask again.
    """
    transition, is_terminal, actions = env.transition, env.is_terminal, range(env.num_actions)
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
    if len(data) != len(out) * len(components) or len({len(part) for part in out}) != 1:
        return None
    following = np.frombuffer(data, np.uint8).reshape(len(out), -1).astype(np.int64)
    outside = (following < components.low) | (following > components.high)
    return None if outside.any() else (following, terminal)


def _array(out: list[list[int]]) -> np.ndarray:
    try:
        return np.array(out, np.int64)
    except (ValueError, TypeError, OverflowError):
        return np.empty((0, 0), np.int64)


def _check_successor(env: Environment, state: tuple[int, ...], action: int, out: list[int]) -> None:
    components = env.components
    where = f"{env}: action {env.actions[action]!r} in state {state}"
    if len(out) != len(components):
        raise RuleError(f"{where} leaves {len(out)} components in `out`; expected {len(components)}")
    for name, value, low, high in zip(components.names, out, components.low, components.high, strict=True):
        if not isinstance(value, numbers.Real) or not low <= value <= high:
            raise RuleError(f"{where} leads to {name} = {value!r}; declared: {low} to {high}")
