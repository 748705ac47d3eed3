"""Dynamics with one next state for each state and action: games, and whatever is deterministic.

Dynamics in which now and then nothing happens: nothing is copied, neither successors nor probabilities.
"""

from functools import partial

import numpy as np

from pharos.mdp.dynamics import Dynamics, Order, Outcomes, as_indices, split
from pharos.mdp.selection import States
from pharos.system.packed_indices import Indices, PackedIndices, blocks_of, holds_end, rows_of


class Table(Dynamics):
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

    def expected(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
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

    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.arange(len(states)), self.next_states[states, actions], np.ones(len(states))

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        which, following, probabilities = self.entries(states, actions)
        return Outcomes(which, np.where(following < 0, self.num_states, following.astype(np.int64)), probabilities)

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


class Lazy(Dynamics):
    """Tables of next states or of outcomes, and a probability that a state stays what it is.

        E x(next) of (s, a) = (1 - p) E x(next of the tables) + p x(s)

    Under sticky actions the action that had no effect counts as executed.

    Attributes:
        tables: the dynamics without laziness; of lazy ones theirs, as p adds up.
        laziness: p, in (0, 1).
    """

    is_deterministic = False
    tables: Dynamics

    def __init__(self, tables: Dynamics, p: float):
        if isinstance(tables, Lazy):
            tables, p = tables.tables, 1.0 - (1.0 - tables.laziness) * (1.0 - p)
        self.tables, self.laziness = tables, float(p)
        self.num_states, self.num_actions = tables.num_states, tables.num_actions
        self.operations = tables.operations + 4
        # of the products with 1 - p, and of 1 - p
        self.mass = max(1.0, tables.mass) * (1 + (self.operations + 2) * _UNIT)

    @property
    def for_kernels(self) -> object:
        return self.tables.for_kernels, self.laziness

    @property
    def for_sweeps(self) -> object:
        return self.tables.for_sweeps, self.laziness

    @property
    def has_ends(self) -> bool:  # type: ignore[override]
        return self.tables.has_ends

    @property
    def has_chance(self) -> bool:
        return self.tables.has_chance

    def arrays(self) -> dict[str, np.ndarray]:
        return {**self.tables.arrays(), "laziness": np.array(self.laziness)}

    def expected(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
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

    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        which, following, probabilities = self.outcomes(states, actions)
        return which, np.where(following == self.num_states, -1, following), probabilities

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        stays = rng.random(len(states)) < self.laziness
        return np.where(stays, states, self.tables.sample(states, actions, rng))

    def order(self, live: np.ndarray) -> Order | None:
        return None if live.any() else self.tables.order(live)

    def part(self, start: int, stop: int) -> tuple[Dynamics, np.ndarray]:
        tables, halo = self.tables.part(start, stop)
        return Lazy(tables, self.laziness), halo

    def restricted_to(self, states: np.ndarray) -> Dynamics:
        return Lazy(self.tables.restricted_to(states), self.laziness)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> Dynamics:
        return Lazy(self.tables.merged(classes, representatives), self.laziness)
