"""Dynamics with one next state for each state and action: games, and whatever is deterministic."""

from functools import partial
from typing import Any

import numpy as np

from pharos.mdp.compiled import CompiledDynamics
from pharos.mdp.dynamics import Outcomes, as_indices, split
from pharos.system.packed_indices import Indices, PackedIndices, blocks_of, holds_end, rows_of


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
