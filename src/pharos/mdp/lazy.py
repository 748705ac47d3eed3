"""Dynamics in which now and then nothing happens: nothing is copied, neither successors nor probabilities."""

from typing import Any

import numpy as np

from pharos.mdp.compiled import CompiledDynamics
from pharos.mdp.dynamics import Dynamics, Order, Outcomes

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
