"""Steps of N states of a vector environment: by the rules, or by looking successors up in a built state space.

Kernels get Setting and Batch as plain tuples: named ones cost Numba a microsecond a call more.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.interaction.simulator import Simulator
from pharos.kernels import stepping
from pharos.mdp import rewards_of_outcomes, rewards_of_staying
from pharos.observations import Index, in_blocks
from pharos.system.packed_indices import as_array

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

BLOCK = 4096  # steps that are worth a thread's while
LARGEST_TABLE = 1 << 28  # bytes of observations that are computed beforehand
_NO_VECTORS = np.empty((0, 0), np.float32)


class RulesWalk:
    """States (N, D), advanced by the rules."""

    name = "state"

    def __init__(self, simulator: Simulator, num_envs: int, mode: int):
        self.simulator = simulator
        length = len(simulator.env.components)
        self.current = np.zeros((num_envs, length), np.int64)
        self.final = np.zeros_like(self.current)
        self.final_elapsed = np.zeros(num_envs, np.int64)
        context: Any = simulator.context
        self._fused = context.is_plain and context.is_vector  # the compiled step writes the vectors as well
        self._vector = np.empty((0, length), np.float32)
        self._step_many: Any = simulator.rules.step_many
        scale = context.observation.scale if self._fused else np.zeros(length)
        self._setting = tuple(simulator.setting(mode, simulator.ranges, scale, simulator.start_states))

    def __getstate__(self) -> dict[str, Any]:
        """Without compiled functions, as in GymEnv."""
        return {**self.__dict__, "_step_many": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._step_many = self.simulator.rules.step_many

    def states(self, rows: Any) -> np.ndarray:
        return self.current[rows].copy()

    def restart(self, mask: np.ndarray, rng: Any, state: Any) -> None:
        self._vector = self._vector[:0]
        if state is not None:
            self.current[mask] = _states_of(self.simulator, state, len(mask))[mask]
            return
        numbers = np.zeros(len(mask), np.int64)
        stepping.draw_starts(self.simulator.start_cumulative, rng, mask, numbers)
        self.current[mask] = self.simulator.start_states[numbers[mask]]

    def vectors(self) -> np.ndarray:
        """Room for the vectors of the next step; without rows where the compiled step does not write them."""
        if self._fused:
            self._vector = np.empty(self.current.shape, np.float32)
        return self._vector

    def step(self, batch: stepping.Batch) -> None:
        """Advance every environment."""
        self.final_elapsed[:] = batch.elapsed + 1
        parameters, setting, arrays = self.simulator.rules.parameters, self._setting, tuple(batch)
        faults: list[int] = []

        def run(first: int, last: int) -> None:
            fault = self._step_many(parameters, setting, arrays, first, last)
            if fault >= 0:
                faults.append(fault)

        in_blocks(run, len(self.current), BLOCK)
        if faults:
            i, component = divmod(min(faults), self.current.shape[1])
            self.simulator.raise_fault(self.current[i], int(batch.executed[i]), component)

    def observations(self, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        if len(self._vector):
            return self._vector
        return self.simulator.context(self.current, previous, elapsed)

    def final_states(self, rows: np.ndarray) -> np.ndarray:
        return self.final[rows]

    def final_observations(self, rows: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        return self.simulator.context(self.final[rows], previous, elapsed)


class TableWalk:
    """Indices (N,) of a built state space, advanced by looking successors up."""

    name = "index"

    def __init__(self, simulator: Simulator, num_envs: int, mode: int):
        self.simulator = simulator
        assert simulator.state_space is not None
        self.space = simulator.state_space
        self.current = np.zeros(num_envs, np.int64)
        self.final = np.zeros(num_envs, np.int64)
        self.final_elapsed = np.zeros(num_envs, np.int64)
        self._transitions, self._rewards = _tables(self.space)
        self._staying = rewards_of_staying(self.space).array if simulator.lazy else np.empty((0, 0))
        self._starts = self.space.indices(simulator.start_states)
        self._setting = tuple(simulator.setting(mode, np.zeros((2, 0), np.int64), np.zeros(0), self._starts))
        context: Any = simulator.context
        self._is_index = context.is_plain and isinstance(context.observation, Index)
        self._table: np.ndarray | None = None
        one = np.prod(context.observation.space.shape or ()) * np.dtype(context.observation.space.dtype).itemsize
        if context.is_plain and not self._is_index and one * self.space.num_states <= LARGEST_TABLE:
            self._table = context.observation(self.space.states())

    def states(self, rows: Any) -> np.ndarray:
        return self.space.states(self.current[rows])

    def restart(self, mask: np.ndarray, rng: Any, state: Any) -> None:
        if state is not None:
            states = _states_of(self.simulator, state, len(mask))
            self.current[mask] = self.space.indices(states[mask])
            return
        numbers = np.zeros(len(mask), np.int64)
        stepping.draw_starts(self.simulator.start_cumulative, rng, mask, numbers)
        self.current[mask] = self._starts[numbers[mask]]

    def vectors(self) -> np.ndarray:
        """No room: tables know no vectors."""
        return _NO_VECTORS

    def step(self, batch: stepping.Batch) -> None:
        """Advance every environment."""
        walk_table: Any = stepping.walk_table
        self.final_elapsed[:] = batch.elapsed + 1

        terminal, setting, arrays = self.space.terminal, self._setting, tuple(batch)

        def run(first: int, last: int) -> None:
            walk_table(self._transitions, self._rewards, self._staying, terminal, setting, arrays, first, last)

        in_blocks(run, len(self.current), BLOCK)

    def observations(self, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        return self._observed(self.current, previous, elapsed)

    def final_states(self, rows: np.ndarray) -> np.ndarray:
        return self.space.states(self.final[rows])

    def final_observations(self, rows: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        return self._observed(self.final[rows], previous, elapsed)

    def _observed(self, index: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Any:
        if self._is_index:
            return index.copy()
        if self._table is not None:
            return self._table.take(index, axis=0)
        return self.simulator.context(self.space.states(index), previous, elapsed)


def _tables(space: "StateSpace") -> tuple[Any, Any]:
    """(successors, rewards) of executed actions, as `stepping.walk_table` takes them."""
    if not space.has_chance:
        return as_array(space.successors), np.ascontiguousarray(space.mdp().rewards, np.float64)
    dynamics: Any = space.dynamics
    return dynamics.for_kernels, dynamics.for_kernels_with(rewards_of_outcomes(space))


def _states_of(simulator: Simulator, state: Any, num_envs: int) -> np.ndarray:
    """(N, D) from one state or N of them, checked."""
    rows = np.asarray(state)
    if rows.ndim == 1:
        return np.tile(simulator.checked_state(rows), (num_envs, 1))
    if len(rows) != num_envs:
        raise ParameterError(f"{simulator.env}: {len(rows)} states; expected one, or {num_envs}")
    return np.stack([simulator.checked_state(row) for row in rows])
