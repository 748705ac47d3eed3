"""The interpreted engine: rules called in Python, if Numba cannot compile them, and to name a failing state."""

import multiprocessing
import numbers
import os
import signal
import sys
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import NamedTuple, NoReturn

import numpy as np

from pharos.environments import Environment
from pharos.errors import RuleError
from pharos.kernels.hash_table import COUNT, FIRST, find_states, insert_missing, slots_of
from pharos.rules.layout import Layout, pack_states, unpack_states
from pharos.system.arrays import SUM_TOLERANCE
from pharos.system.workers import without_interrupts


class Branches(NamedTuple):
    """Next states of N states by B branches each: A actions, or, with chance, outcome k of action a as branch a K + k.

    Attributes:
        next_states: (N B, D) int64, or uint8 if it suffices. Terminal states and impossible outcomes lead to the
            state itself.
        terminal: (N,) bool.
        probabilities: (N, B) float64, or None without chance.
    """

    next_states: np.ndarray
    terminal: np.ndarray
    probabilities: np.ndarray | None = None


def interpreted_branches(env: Environment, rows: list[list[int]]) -> Branches:
    """The branches of some states, by calling the rules in each.

    Args:
        rows: N states, D integers each.
    Raises:
        RuleError: a rule raised an exception or broke its contract. It names the state, the action and the outcome.
    """
    if env.has_chance or env.has_age:
        return _outcomes(env, rows)
    return Branches(*interpreted_successors(env, rows))


def interpreted_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """The successors of some states by a class without chance, by calling its rules in each.

    Args:
        rows: N states, D integers each.
    Returns:
        (N * A, D) int64, or uint8 if it suffices: row i * A + a the successor of state i by action a, terminal
        states leading to themselves. And (N,) bool, which states are terminal.
    Raises:
        RuleError: a rule raised an exception or left the declared ranges. It names the state and the action.
    """
    quick = _small_successors(env, rows)
    if quick is not None:
        return quick
    actions = range(env.num_actions)
    transition, is_terminal = _transition(env), env.is_terminal
    terminal = np.zeros(len(rows), np.bool_)
    out: list[list[int]] = []
    # call the rules; `out` tells at which action one failed
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
    # successors out of range, or all if some are no states: the first bad one is named
    next_states = _array(out)
    components = env.components
    if next_states.shape == (len(out), len(components)):
        outside = ((next_states < components.low) | (next_states > components.high)).any(axis=1)
        suspects = np.flatnonzero(outside)[:1].tolist()
    else:
        suspects = list(range(len(out)))
    for j in suspects:
        i, action = divmod(j, len(actions))
        check_successor(env, tuple(rows[i]), action, out[j])
    return next_states, terminal


def _small_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray] | None:
    """`interpreted_successors` for integers from 0 to 255, the usual case: no lists, successors become bytes.

    None if a rule raises, an integer is another or a range is left: rules are pure, so that the caller can call them
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
    next_states = np.frombuffer(data, np.uint8).reshape(len(out), -1)
    if (next_states.min(axis=0) < components.low).any() or (next_states.max(axis=0) > components.high).any():
        return None
    return next_states, terminal


def _transition(env: Environment) -> Callable[..., None]:
    """transition(state, action, out) of an instance without chance, whether its class takes outcomes or not."""
    if env.takes_outcomes():
        return lambda state, action, out: env.transition(state, action, 0, out)
    return env.transition


def _array(out: list[list[int]]) -> np.ndarray:
    """The successors as an array, an empty one if they are no integers of one length."""
    try:
        return np.array(out, np.int64)
    except (ValueError, TypeError, OverflowError):
        return np.empty((0, 0), np.int64)


def check_successor(env: Environment, state: tuple[int, ...], action: int, out: list[int], which: str = "") -> None:
    """Raise a RuleError if `out` is no state. `which`: the outcome, in words."""
    components = env.components
    where = f"{env}: {which}action {env.actions[action]!r} in state {state}"
    if len(out) != len(components):
        raise RuleError(f"{where} leaves {len(out)} components in `out`; expected {len(components)}")
    for name, value, low, high in zip(components.names, out, components.low, components.high, strict=True):
        if not isinstance(value, numbers.Real) or not low <= value <= high:
            raise RuleError(f"{where} leads to {name} = {value!r}; declared: {low} to {high}")


# Chance and ages ------------------------------------------------------------------------------------------------------


def _outcomes(env: Environment, rows: list[list[int]]) -> Branches:
    """`interpreted_branches` of a class with chance or an age."""
    terminal = np.zeros(len(rows), np.bool_)
    probabilities = np.zeros((len(rows), env.num_actions, env.outcomes))
    next_states = np.empty((len(rows), env.num_actions, env.outcomes, len(env.components)), np.int64)
    for i, row in enumerate(rows):
        state = tuple(row)
        next_states[i] = row
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
                next_states[i, action, outcome] = _outcome(env, state, action, outcome)
    flat = next_states.reshape(-1, len(env.components))
    return Branches(flat, terminal, probabilities.reshape(len(rows), -1) if env.has_chance else None)


def outcome_probabilities(env: Environment, state: tuple[int, ...], action: int) -> list[float]:
    """The probabilities of the K outcomes of an action. RuleError if they are no distribution."""
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
    """The next state by an outcome. RuleError if that is no state, or not older than `state`."""
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


EXPANDED_AT_ONCE = 4096  # states whose successors are Python objects at a time
_MOST_FILES = 1 << 16
_WORTH_SENDING = 64  # states that are worth sending to another process


class InterpretedExpansion:
    """`rules.Expansion`, interpreted: one thread, and as many processes that run rules as there are workers."""

    is_compiled = False

    def __init__(self, env: Environment, layout: Layout, workers: int = 1):
        self.env, self.layout = env, layout
        self.branches = env.num_actions * env.outcomes
        self._interpreters = Interpreters(env, workers)

    def threads(self, workers: int) -> int:
        return 1

    def explore(self, states, successors, terminal, probabilities, table, base, last, room, progress) -> None:
        first, count = int(progress[FIRST]), int(progress[COUNT])
        stop = min(last, count, first + min(EXPANDED_AT_ONCE, (room - count) // self.branches))
        rows = slice(first - base, stop - base)
        keys = np.empty(((stop - first) * self.branches, self.layout.num_words), np.uint64)
        indices = np.empty(len(keys), np.int64)
        self.expand_and_find(states, first, stop, first, keys, indices, terminal[rows], probabilities[rows], table)
        insert_missing(table, states, keys, indices, successors[rows], progress)

    def expand_and_find(self, states, start, stop, base, keys, indices, terminal, probabilities, table) -> None:
        for first in range(start, stop, EXPANDED_AT_ONCE):
            last = min(first + EXPANDED_AT_ONCE, stop)
            rows = slice(first - base, last - base)
            part = slice(rows.start * self.branches, rows.stop * self.branches)
            self._expand(states[first:last], keys[part], terminal[rows], probabilities[rows])
            find_states(table, states, keys[part], indices[part])
        size = (stop - base) * self.branches
        missing = np.flatnonzero(indices[:size] < 0)
        slots = np.empty(len(missing), np.int64)
        slots_of(keys[missing], len(table), slots)
        indices[missing] = -1 - slots

    def _expand(self, states: np.ndarray, keys: np.ndarray, terminal: np.ndarray, probabilities: np.ndarray) -> None:
        """Successors of packed states to keys, packed. Terminal states and impossible outcomes lead to the state."""
        layout = self.layout
        next_states, terminal[:], p = self._branches(unpack_states(layout, states))
        if p is not None:
            probabilities[:] = p
        keys[:] = pack_states(layout, next_states)

    def _branches(self, states: np.ndarray) -> Branches:
        return self._interpreters.branches(states)

    def close(self) -> None:
        """End the processes."""
        self._interpreters.close()


class InterpretedRewards:
    """`rules.TransitionRewards`, interpreted."""

    def __init__(self, env: Environment, layout: Layout):
        self.env, self.layout = env, layout

    def threads(self, workers: int) -> int:
        return 1

    def block(self, states, successors, terminal, start: int, stop: int) -> np.ndarray:
        out = np.zeros((stop - start, self.env.num_actions))
        rows = list(map(tuple, unpack_states(self.layout, states[start:stop]).tolist()))
        live = np.flatnonzero(~np.asarray(terminal[start:stop])).tolist()
        with np.errstate(all="ignore"):  # what is not finite is reported
            for a in range(self.env.num_actions):
                next_states = list(map(tuple, unpack_states(self.layout, states[successors[start:stop, a]]).tolist()))
                for i in live:
                    out[i, a] = self._reward(rows[i], a, next_states[i])
        return out

    def expected_block(self, states, outcomes, terminal, start, stop, ranks=(), largest=None) -> np.ndarray:
        num_actions = self.env.num_actions
        out = np.zeros((stop - start) * num_actions)
        rewards: list[list[float]] = [[] for _ in out]
        rows = list(map(tuple, unpack_states(self.layout, states[start:stop]).tolist()))
        which, successors, probabilities = outcomes
        next_states = list(map(tuple, unpack_states(self.layout, states[successors]).tolist()))
        ended = np.asarray(terminal[start:stop]).tolist()
        with np.errstate(all="ignore"):  # what is not finite is reported
            for j, (pair, probability) in enumerate(zip(which.tolist(), probabilities.tolist(), strict=True)):
                i, a = divmod(pair, num_actions)
                if not ended[i]:
                    rank = int(ranks[j]) if len(ranks) else len(rewards[pair])
                    rewards[pair].append(float(self._reward(rows[i], a, next_states[j], rank)))
                    out[pair] += probability * rewards[pair][-1]
        # equal rewards are not averaged, so that no rounding changes them
        for pair, values in enumerate(rewards):
            if values and values.count(values[0]) == len(values):
                out[pair] = values[0]
            elif largest is not None:
                largest[0] = max(largest[0], *map(abs, values), 0.0)
        return out.reshape(-1, num_actions)

    def _reward(self, state: tuple[int, ...], action: int, next_state: tuple[int, ...], rank: int = 0) -> float:
        """The reward of the possible outcome with this rank among the outcomes of (state, action), -1 without
        effect."""
        env = self.env
        try:
            if rank >= 0 and env.has_chance and env.pays_by_outcome():
                possible = [k for k in range(env.outcomes) if env.probability(state, action, k) > 0]
                rank = possible[rank]
            return env.reward_of(state, action, next_state, rank)
        except Exception as error:
            raise refused_reward(self.env, state, action, f"raises {error!r}") from error


class InterpretedAges:
    """`rules.Ages`, interpreted."""

    def __init__(self, env: Environment, layout: Layout):
        self.env, self.layout = env, layout

    def block(self, states, start: int, stop: int) -> np.ndarray:
        return np.array(
            [self.env.age(tuple(row)) for row in unpack_states(self.layout, states[start:stop]).tolist()], np.int64
        )


def refused_reward(env: Environment, state: tuple[int, ...], action: int, why: str) -> RuleError:
    """The error for a reward that is no finite number, or that raises."""
    return RuleError(f"{env}: reward of action {env.actions[action]!r} in state {state} {why}")


def blame(env: Environment, layout: Layout, suspects: np.ndarray, failure: BaseException | None) -> NoReturn:
    """Raise the error of compiled rules that failed or left the declared ranges in one of some packed states.

    It names the first state in which they fail interpreted.
    """
    rows = unpack_states(layout, suspects).tolist()
    if failure and not rows:  # they were not run yet: it is Numba's, of compiling them
        raise failure
    interpreted_branches(env, rows)
    raise RuleError(
        f"{env}: compiled rules {f'raise {failure!r}' if failure else 'read or write outside of the declared ranges'} "
        f"in one of the states from {tuple(rows[0])} to {tuple(rows[-1])}, interpreted they do not; "
        f"run pharos.check_environment to find out why"
    ) from failure


class Interpreters:
    """Processes that call the rules, each in a part of the states: Python runs on one processor at a time.

    They are forked, so that rules of any kind come along, even rules typed at a prompt. If the system cannot do that,
    or with one worker, there are none. They end with this process, however it ends.
    """

    def __init__(self, env: Environment, workers: int):
        self.env = env
        self._connections: list[Connection] = []
        if not sys.platform.startswith("linux"):
            return
        context = multiprocessing.get_context("fork")
        for _ in range(workers - 1):
            ours, theirs = context.Pipe()
            work = context.Process(target=_interpret, args=(env, theirs), daemon=True)
            with without_interrupts(forks=True), warnings.catch_warnings():
                # of threads, none of which hold anything that a rule needs
                warnings.simplefilter("ignore", DeprecationWarning)
                work.start()
            theirs.close()
            self._connections.append(ours)

    def branches(self, states: np.ndarray) -> Branches:
        """`interpreted_branches` of states (N, D) int64, shared between the processes if they are many."""
        shares = min(len(self._connections) + 1, len(states) // _WORTH_SENDING)
        if shares < 2:
            return interpreted_branches(self.env, states.tolist())
        parts = np.array_split(states, shares)
        requests = [
            _send(connection, part) for connection, part in zip(self._connections[: shares - 1], parts[1:], strict=True)
        ]
        answers = [interpreted_branches(self.env, parts[0].tolist())]
        for connection, part, is_sent in zip(self._connections[: shares - 1], parts[1:], requests, strict=True):
            answer = _received(connection, len(part), self.env) if is_sent else None
            answers.append(answer or interpreted_branches(self.env, part.tolist()))
        next_states, terminal, probabilities = zip(*answers, strict=True)
        all_probabilities = None if probabilities[0] is None else np.concatenate(probabilities)
        return Branches(np.concatenate(next_states), np.concatenate(terminal), all_probabilities)

    def close(self) -> None:
        """Let the processes end."""
        for connection in self._connections:
            connection.close()
        self._connections = []


def _send(connection: Connection, states: np.ndarray) -> bool:
    """Send states to a process. Return whether it is alive."""
    try:
        connection.send_bytes(np.ascontiguousarray(states).data)
    except OSError:  # it was killed
        return False
    return True


def _received(connection: Connection, rows: int, env: Environment) -> Branches | None:
    """The branches that another process sends. None if it was killed, or if a rule fails.

    This process then calls the rules itself, and raises the error.
    """
    try:
        data = connection.recv_bytes()
    except (EOFError, OSError):
        return None
    if not data:
        return None
    branches = rows * env.num_actions * env.outcomes
    size = branches * len(env.components)
    probabilities = None
    if env.outcomes > 1:
        probabilities = np.frombuffer(data, np.float64, branches).reshape(rows, -1)
        data = data[8 * branches :]
    terminal = np.frombuffer(data, np.bool_, rows)
    small = len(data) == rows + size
    next_states = np.frombuffer(data, np.uint8 if small else np.int64, size, offset=rows)
    return Branches(next_states.reshape(-1, len(env.components)), terminal, probabilities)


def _interpret(env: Environment, connection: Connection) -> None:
    """Loop of one of the processes: receive states, send their branches, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the builder's to handle
    os.closerange(
        3, connection.fileno()
    )  # the builder's lock, and the other ends of pipes, which would never look closed
    os.closerange(connection.fileno() + 1, _MOST_FILES)
    while True:
        try:
            data = connection.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            states = np.frombuffer(data, np.int64).reshape(-1, len(env.components))
            next_states, terminal, probabilities = interpreted_branches(env, states.tolist())
            small = next_states.size and next_states.min() >= 0 and next_states.max() < 256
            answer = terminal.tobytes() + next_states.astype(np.uint8 if small else np.int64).tobytes()
            answer = answer if probabilities is None else probabilities.tobytes() + answer
        except Exception:
            answer = b""
        try:
            connection.send_bytes(answer)
        except OSError:
            return
