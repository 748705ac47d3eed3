"""The interpreted engine: rules called in Python, where Numba cannot compile them, and to name the state in which they
failed.
"""

import multiprocessing
import numbers
import os
import signal
import sys
import warnings
from multiprocessing.connection import Connection
from typing import NoReturn

import numpy as np

from pharos.environments import Environment
from pharos.errors import RuleError
from pharos.kernels.hash_table import COUNT, FIRST, find, insert_missing, slots_of
from pharos.kernels.packing import pack_rows, unpack_rows
from pharos.rules.layout import Layout, unpack

BLOCK = 4096  # states whose successors are Python objects at a time
_MOST_FILES = 1 << 16
_SHARE = 64  # states that are worth sending to another process


class InterpretedExploration:
    """See `rules.Exploration`. One thread asks; the rules themselves run in as many processes as there are workers."""

    is_compiled = False

    def __init__(self, env: Environment, layout: Layout, workers: int = 1):
        self.env, self.layout = env, layout
        self._interpreters = Interpreters(env, workers)

    def threads(self, workers: int) -> int:
        return 1

    def explore(self, states, successors, terminal, table, base, last, room, progress) -> None:
        first, count, num_actions = int(progress[FIRST]), int(progress[COUNT]), self.env.num_actions
        stop = min(last, count, first + min(BLOCK, (room - count) // num_actions))
        keys = np.empty(((stop - first) * num_actions, self.layout.num_words), np.uint64)
        found = np.empty(len(keys), np.int64)
        self.expand_and_find(states, first, stop, first, keys, found, terminal[first - base : stop - base], table)
        insert_missing(table, states, keys, found, successors[first - base : stop - base], progress)

    def expand_and_find(self, states, start, stop, base, keys, found, terminal, table) -> None:
        for first in range(start, stop, BLOCK):
            last = min(first + BLOCK, stop)
            rows = slice(first - base, last - base)
            part = slice(rows.start * self.env.num_actions, rows.stop * self.env.num_actions)
            self._expand(states[first:last], keys[part], terminal[rows])
            find(table, states, keys[part], found[part])
        size = (stop - base) * self.env.num_actions
        missing = np.flatnonzero(found[:size] < 0)
        slots = np.empty(len(missing), np.int64)
        slots_of(keys[missing], len(table), slots)
        found[missing] = -1 - slots

    def _expand(self, states: np.ndarray, keys: np.ndarray, terminal: np.ndarray) -> None:
        """Successors of packed states to keys, packed; terminal states lead to themselves."""
        layout = self.layout
        unpacked = np.empty((len(states), len(layout.word)), np.int64)
        unpack_rows(layout.word, layout.shift, layout.mask, layout.low, states, unpacked)
        following, terminal[:] = self._successors(unpacked)
        keys[:] = 0
        pack_rows(layout.word, layout.shift, layout.low, following, keys)

    def _successors(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._interpreters.successors(states)

    def close(self) -> None:
        """End the processes."""
        self._interpreters.close()


class InterpretedRewards:
    """See `rules.Rewards`."""

    def __init__(self, env: Environment, layout: Layout):
        self.env, self.layout = env, layout

    def threads(self, workers: int) -> int:
        return 1

    def block(self, states, successors, terminal, start: int, stop: int) -> np.ndarray:
        out = np.zeros((stop - start, self.env.num_actions))
        rows = list(map(tuple, unpack(self.layout, states[start:stop]).tolist()))
        going = np.flatnonzero(~np.asarray(terminal[start:stop])).tolist()
        with np.errstate(all="ignore"):  # what is not finite is reported
            for a in range(self.env.num_actions):
                following = list(map(tuple, unpack(self.layout, states[successors[start:stop, a]]).tolist()))
                for i in going:
                    try:
                        out[i, a] = self.env.reward(rows[i], a, following[i])
                    except Exception as error:
                        raise refused_reward(self.env, rows[i], a, f"raises {error!r}") from error
        return out


def refused_reward(env: Environment, state: tuple[int, ...], action: int, why: str) -> RuleError:
    """The error for a reward that is none."""
    return RuleError(f"{env}: reward of action {env.actions[action]!r} in state {state} {why}")


def blame(env: Environment, layout: Layout, suspects: np.ndarray, failure: BaseException | None) -> NoReturn:
    """Compiled rules failed or left the declared ranges in one of some packed states: name the first where they do
    interpreted.
    """
    rows = unpack(layout, suspects).tolist()
    interpreted_successors(env, rows)
    raise RuleError(
        f"{env}: compiled rules {f'raise {failure!r}' if failure else 'read or write outside of the declared ranges'} "
        f"in one of the states from {tuple(rows[0])} to {tuple(rows[-1])}, interpreted they do not; "
        f"run pharos.check_environment to find out why"
    ) from failure


def interpreted_successors(env: Environment, rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Call the rules in each state.

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

    None where a rule raises, an integer is another or a range is left: rules are pure, so that the caller can ask
    again.
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
    if len(data) != len(out) * len(components) or len(set(map(len, out))) != 1:
        return None
    following = np.frombuffer(data, np.uint8).reshape(len(out), -1)
    if (following.min(axis=0) < components.low).any() or (following.max(axis=0) > components.high).any():
        return None
    return following, terminal


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


class Interpreters:
    """Processes that call the rules, each in a part of the states: Python runs on one processor at a time.

    They are forked, so that rules of any kind come along, those typed at a prompt too; where the system cannot do that,
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
            with warnings.catch_warnings():  # of threads, none of which hold anything that a rule needs
                warnings.simplefilter("ignore", DeprecationWarning)
                work.start()
            theirs.close()
            self._connections.append(ours)

    def successors(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `interpreted_successors` of states (N, D) int64, shared between the processes where they are many."""
        shares = min(len(self._connections) + 1, len(states) // _SHARE)
        if shares < 2:
            return interpreted_successors(self.env, states.tolist())
        parts = np.array_split(states, shares)
        asked = [
            _send(connection, part) for connection, part in zip(self._connections[: shares - 1], parts[1:], strict=True)
        ]
        found = [interpreted_successors(self.env, parts[0].tolist())]
        for connection, part, is_asked in zip(self._connections[: shares - 1], parts[1:], asked, strict=True):
            answer = _received(connection, len(part), self.env) if is_asked else None
            found.append(answer or interpreted_successors(self.env, part.tolist()))
        return np.concatenate([each for each, _ in found]), np.concatenate([ended for _, ended in found])

    def close(self) -> None:
        """Let the processes end."""
        for connection in self._connections:
            connection.close()
        self._connections = []


def _send(connection: Connection, states: np.ndarray) -> bool:
    try:
        connection.send_bytes(np.ascontiguousarray(states).data)
    except OSError:  # it was killed
        return False
    return True


def _received(connection: Connection, rows: int, env: Environment) -> tuple[np.ndarray, np.ndarray] | None:
    """What another process found; None where it was killed, or where a rule fails, which this process shall find out
    itself.
    """
    try:
        data = connection.recv_bytes()
    except (EOFError, OSError):
        return None
    if not data:
        return None
    terminal = np.frombuffer(data, np.bool_, rows)
    size = rows * env.num_actions * len(env.components)
    small = len(data) == rows + size
    following = np.frombuffer(data, np.uint8 if small else np.int64, size, offset=rows)
    return following.reshape(-1, len(env.components)), terminal


def _interpret(env: Environment, connection: Connection) -> None:
    """What one of the processes does until the other end is closed."""
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
            following, terminal = interpreted_successors(env, states.tolist())
            small = following.size and following.min() >= 0 and following.max() < 256
            answer = terminal.tobytes() + following.astype(np.uint8 if small else np.int64).tobytes()
        except Exception:
            answer = b""
        try:
            connection.send_bytes(answer)
        except OSError:
            return
