"""Dynamics that kernels read: the methods that are compiled, without temporary arrays.

Dynamics with one next state for each state and action: games, and whatever is deterministic.

Dynamics in which now and then nothing happens: nothing is copied, neither successors nor probabilities.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from pharos.kernels import bellman, graph, occupancy, outcomes
from pharos.mdp.dynamics import (
    BellmanEquation,
    Components,
    Dynamics,
    Order,
    Outcomes,
    PolicyStep,
    as_indices,
    count_of,
    shares_of,
    split,
)
from pharos.mdp.selection import Extreme, PolicyTable, Selection
from pharos.system.large_arrays import pieces_from_the_end, rows_with_room
from pharos.system.packed_indices import Indices, PackedIndices, blocks_of, holds_end, rows_of


class CompiledDynamics(Dynamics):
    """Transitions in arrays that kernels/outcomes.py knows how to read: each loop is written once for all of them."""

    sweeps_ranges = True

    @property
    @abstractmethod
    def for_kernels(self) -> Any:
        """The argument `transitions` of kernels."""

    @property
    def for_sweeps(self) -> Any:
        """The same for the loops in which solvers spend their time: what the compiler knows more of."""
        return self.for_kernels

    def lazy(self, p: float) -> Dynamics:

        return Lazy(self, p)

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray, runs: np.ndarray | None = None) -> None:
        rewards, gamma, chance, select = equation
        choice = _choice(select)
        if choice is None:
            return super().backup(equation, x, out, runs)
        tables = (self.for_sweeps, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        kernel, weights, x_, out_ = (
            (bellman.sticky_backup, chance.triple, x, out)
            if chance.is_sticky
            else (bellman.optimal_backup, chance.uniform, x[:, 0], out[:, 0])
        )
        out[-1] = 0.0
        arrays = (*tables, weights, choice, x_, out_, actions)
        whole = np.array([[0, self.num_states]])
        _shared(lambda part: kernel(*arrays, part), self, whole if runs is None else runs)

    def sweep(
        self, equation: BellmanEquation, x: np.ndarray, threads: int = 1, part: tuple[int, int] | None = None
    ) -> float:
        """part: the states [start, stop) alone."""
        return swept(self.for_sweeps, self.num_actions, equation, x, None, threads, part)

    def settle_components(
        self, equation: BellmanEquation, x: np.ndarray, parts: Components, target: float, settled: float, most: float
    ) -> None:
        choice, before = _choice(equation.select), float(max(x.max(), -x.min()))
        if choice is not None and not equation.chance.is_sticky:
            from pharos.kernels import components

            tables = (self.for_sweeps, equation.rewards.table, equation.rewards.palette, equation.gamma)
            actions, chance = bellman.actions_of(self.num_actions), equation.chance.uniform
            groups = (parts.order, parts.starts, parts.has_cycle)
            components.settle(*tables, chance, choice, x[:, 0], actions, *groups, target, settled, most, before)
            return
        for group in range(len(parts.has_cycle) - 1, -1, -1):
            start, stop = int(parts.starts[group]), int(parts.starts[group + 1])
            change, largest = math.inf, before
            while change > max(target, settled * largest):
                change = swept(self.for_sweeps, self.num_actions, equation, x, parts.order, part=(start, stop))
                largest += change
                most -= stop - start
                if most < 0 or not parts.has_cycle[group]:
                    break

    def components(self, live: np.ndarray, least: int) -> Components:
        from pharos.kernels import components  # which few need

        dtype = np.int32 if self.num_states < 2**31 else np.int64
        number, path, waiting = (np.empty(self.num_states, dtype) for _ in range(3))
        count = components.number_components(self.for_kernels, live, number, path, waiting)
        first, is_cyclic = np.zeros(count + 1, np.int64), np.zeros(count, np.bool_)
        order = np.empty(self.num_states, np.int64)
        components.component_order(self.for_kernels, live, number, first, is_cyclic, order)
        largest = int(np.diff(first).max(initial=0, where=is_cyclic))
        starts, has_cycle = components.joined(first, is_cyclic, least)
        return Components(order, starts, has_cycle, count, largest)

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: Order) -> None:
        swept(self.for_sweeps, self.num_actions, equation, x, order.states)

    def move(self, play: PolicyStep, now: np.ndarray, after: np.ndarray) -> float:
        if now.shape[1] != after.shape[1]:  # the first step of sticky actions
            return super().move(play, now, after)
        return occupancy.push(self.for_kernels, play.live, play.policy, play.chance.triple, now, after)

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        after = np.zeros((self.num_states, width))
        outcomes.pushed(self.for_kernels, np.ascontiguousarray(mass, np.float64), after)
        return after

    def settle(self, play: PolicyStep, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        weights = play.chance.triple
        return occupancy.settle(self.for_kernels, play.live, play.policy, weights, gamma, least, waiting, visits)

    def support(self, play: PolicyStep, reached: np.ndarray) -> None:
        occupancy.support(self.for_kernels, play.live, play.policy, play.chance.triple, reached)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        is_reached = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        is_reached[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, following = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.for_kernels, now, count, following, is_reached)
            now, following = following, now
            level += 1
        return is_reached

    def _edges(self, live: np.ndarray) -> Any:
        return self.for_kernels


def swept(
    transitions: Any,
    num_actions: int,
    equation: BellmanEquation,
    x: np.ndarray,
    order: np.ndarray | None,
    threads: int = 1,
    part: tuple[int, int] | None = None,
) -> float:
    """Replace each entry of x by its backup, from the last state of an order to the first; the largest change.

    Args:
        threads: each has a part of the states, where that is possible.
        part: the places [start, stop) of the order that are swept; None: all.
    """
    rewards, gamma, chance, select = equation
    others = (rewards.table, rewards.palette, gamma)
    tables = (transitions, *others)
    actions, scratch = bellman.actions_of(num_actions), np.empty(num_actions)
    choice, places = _choice(select), part or (0, rewards.shape[0])
    if choice is None:
        assert isinstance(select, PolicyTable)
        if chance.is_sticky:
            return bellman.sticky_policy_sweep(*tables, chance.triple, select.later, x, scratch, order, *places)
        weights = (float(chance.chosen), float(chance.uniform))
        return bellman.policy_sweep(*tables, *weights, select.later[:, 0], x[:, 0], order, *places)
    if chance.is_sticky:
        return bellman.sticky_sweep(*tables, chance.triple, choice, x, actions, scratch, order, *places)
    v, border = x[:, 0], rows_with_room(transitions, *places)

    def change_of(low: int, high: int) -> float:
        change = 0.0
        for piece, start, stop in pieces_from_the_end(transitions, low, high, border):
            largest = bellman.optimal_sweep(piece, *others, chance.uniform, choice, v, actions, order, start, stop)
            change = float(np.maximum(change, largest))
        return change

    low, high = places
    cuts = [low + (high - low) * i // threads for i in range(threads + 1)]
    if threads == 1:
        return change_of(*cuts)
    with ThreadPoolExecutor(threads) as pool:
        return float(np.max([*pool.map(change_of, cuts[:-1], cuts[1:])]))


def _choice(select: Selection) -> "float | np.ndarray | None":
    """The argument `choice` of kernels; None for policies that draw actions, or look back."""
    if isinstance(select, Extreme):
        return select.sign
    assert isinstance(select, PolicyTable)
    return None if select.actions is None else np.ascontiguousarray(select.actions, np.int64)


def _shared(block: Callable[[np.ndarray], None], dynamics: CompiledDynamics, runs: np.ndarray) -> None:
    """block(part) over the states of runs (R, 2), on all processors where there are enough states to share."""
    from pharos.system.workers import usable_workers

    workers = usable_workers(dynamics.workers) if count_of(runs) >= 1 << 16 else 1
    if workers == 1:
        return block(runs)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, shares_of(runs, workers)))


# Table ----------------------------------------------------------------------------------------------------------------


class Table(CompiledDynamics):
    """One next state for each state and action, as a table.

    Attributes:
        next_states: (S, A) int32, int64 or `PackedIndices`; -1: the episode ends there.
    """

    operations, mass, is_deterministic = 0, 1.0, True

    def __init__(self, next_states: Indices):
        self.next_states = next_states
        self.num_states, self.num_actions = next_states.shape
        self._has_ends: bool | None = None

    @property
    def for_kernels(self) -> Indices:
        return self.next_states

    @property
    def has_ends(self) -> bool:  # type: ignore[override]
        if self._has_ends is None:
            self._has_ends = holds_end(self.next_states)
        return self._has_ends

    def deterministic_table(self) -> Indices:
        return self.next_states

    def arrays(self) -> dict[str, np.ndarray]:
        return {"next_states": np.asarray(self.next_states)}

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        if isinstance(self.next_states, PackedIndices) and isinstance(states, slice) and states == slice(None):
            rows = self.next_states
            out = np.empty((*rows.shape, *x.shape[2:]), x.dtype)
            for first, table in blocks_of(rows):  # no more of them is unpacked at a time
                out[first : first + len(table)] = self._expected(x, table)
            return out
        return self._expected(x, self.next_states[states])

    def _expected(self, x: np.ndarray, table: np.ndarray) -> np.ndarray:
        if x.ndim == 1:  # -1 reads the last row, which is the end's
            return x[table]
        return x[table, np.arange(self.num_actions)] if x.shape[1] > 1 else x[table, 0]

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        following = np.unique(self.next_states[states])
        if len(following) and following[0] == -1:
            return np.append(following[1:], self.num_states)
        return following

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        following = self.next_states[states, actions].astype(np.int64)
        following[following < 0] = self.num_states
        return Outcomes(np.arange(len(following)), following, np.ones(len(following)))

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return self.next_states[states, actions]

    def part(self, start: int, stop: int) -> tuple["Table", np.ndarray]:
        rows = rows_of(self.next_states, start, stop)
        local, halo = split(partial(blocks_of, rows), rows.shape, start, stop)
        return Table(local), halo

    def restricted_to(self, states: np.ndarray) -> "Table":
        """These states alone; what leads out of them leads back to where it came from."""
        number = np.full(self.num_states, -1, np.int64)
        number[states] = np.arange(len(states))
        table = np.asarray(self.next_states[states])
        inside = number[table]  # what leads to -1 gets any number here
        own = np.broadcast_to(np.arange(len(states))[:, None], table.shape)
        return Table(as_indices(np.where(table < 0, -1, np.where(inside < 0, own, inside)), len(states)))

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Table":
        table = np.asarray(self.next_states[representatives]).astype(np.int64)
        return Table(as_indices(np.where(table >= 0, classes[table], -1), len(representatives)))


# Lazy -----------------------------------------------------------------------------------------------------------------


_UNIT = 2.0**-53


class Lazy(CompiledDynamics):
    """Tables of next states or of outcomes, and a probability that a state stays what it is.

        E x(next) of (s, a) = (1 - p) E x(next of the tables) + p x(s)

    Under sticky actions the action that had no effect counts as executed.

    Attributes:
        tables: the dynamics without laziness.
        laziness: p, in (0, 1).
    """

    is_deterministic = False

    def __init__(self, tables: CompiledDynamics, p: float):
        self.tables, self.laziness = tables, float(p)
        self.num_states, self.num_actions = tables.num_states, tables.num_actions
        self.operations = tables.operations + 4
        # of the products with 1 - p, and of 1 - p
        self.mass = max(1.0, tables.mass) * (1 + (self.operations + 2) * _UNIT)

    def lazy(self, p: float) -> Dynamics:
        return Lazy(self.tables, 1.0 - (1.0 - self.laziness) * (1.0 - p))

    @property
    def for_kernels(self) -> Any:
        return self.tables.for_kernels, self.laziness

    @property
    def for_sweeps(self) -> Any:
        return self.tables.for_sweeps, self.laziness

    @property
    def has_ends(self) -> bool:  # type: ignore[override]
        return self.tables.has_ends

    @property
    def has_chance(self) -> bool:
        return self.tables.has_chance

    def arrays(self) -> dict[str, np.ndarray]:
        return {**self.tables.arrays(), "laziness": np.array(self.laziness)}

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        own = x[np.arange(self.num_states)[states]]
        return (1.0 - self.laziness) * self.tables.expected(x, states) + self.laziness * (
            own[:, None] if x.ndim == 1 else own
        )

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        own = mass if width > 1 else mass.sum(axis=1, keepdims=True)
        return (1.0 - self.laziness) * self.tables.pushed(mass, width) + self.laziness * own

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        from scipy import sparse

        which, following, probabilities = self.tables.outcomes(states, actions)
        count = len(states)
        entries = (
            np.concatenate([(1.0 - self.laziness) * probabilities, np.full(count, self.laziness)]),
            (np.concatenate([which, np.arange(count)]), np.concatenate([following, np.asarray(states)])),
        )
        matrix = sparse.csr_matrix(entries, (count, self.num_states + 1))  # adds up what leads to the same state
        which = np.repeat(np.arange(count), np.diff(matrix.indptr))
        return Outcomes(which, matrix.indices.astype(np.int64), matrix.data)

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        stays = rng.random(len(states)) < self.laziness
        return np.where(stays, states, self.tables.sample(states, actions, rng))

    def largest(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        own = np.asarray(x)[np.arange(self.num_states)[states]]
        return np.maximum(self.tables.largest(x, states), own[:, None])

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        result = self.tables.arrivals(states)
        result[states] = True
        return result

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        return np.union1d(self.tables.successors_of(states), states)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        return self.tables.reachable(starts, steps)

    def order(self, live: np.ndarray) -> Order | None:
        return None if live.any() else self.tables.order(live)

    def part(self, start: int, stop: int) -> tuple[Dynamics, np.ndarray]:
        tables, halo = self.tables.part(start, stop)
        return tables.lazy(self.laziness), halo

    def restricted_to(self, states: np.ndarray) -> Dynamics:
        return self.tables.restricted_to(states).lazy(self.laziness)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> Dynamics:
        return self.tables.merged(classes, representatives).lazy(self.laziness)
