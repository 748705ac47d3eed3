"""Dynamics with several outcomes for each state and action: games whose rules have chance."""

import math
from functools import cached_property, partial
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.kernels import outcomes as kernels
from pharos.mdp.dynamics import Dynamics, as_indices, split
from pharos.mdp.outcome_arrays import checked_outcomes, compact_outcomes
from pharos.system.outcome_rows import OutcomeCheck, OutcomeRows, WrongOutcomes
from pharos.system.packed_indices import Indices, blocks_of, holds_end, rows_of

_UNIT = 2.0**-53
# Executions whose outcomes NumPy lists sooner than a kernel is compiled.
_FEW = 1 << 14


class OutcomeTable(OutcomeRows, Dynamics):
    """Several next states for each state and action, and their probabilities, as the tables of `OutcomeRows`."""

    def __init__(self, successors: Indices, num_actions: int, **others: Any):
        """others: offsets, codes, palette, probabilities; see `OutcomeRows`, which also raises."""
        super().__init__(successors, **others)
        self.num_actions = num_actions
        rows = len(successors) * num_actions if self.offsets is None else len(self.offsets) - 1
        self.num_states = rows // num_actions

    @staticmethod
    def from_arrays(successors: Any, probabilities: Any) -> "OutcomeTable":
        """From (S, A, K) successors, -1 for the end, and probabilities; what is impossible is left out.

        Up to 65,536 distinct vectors of probabilities become a palette. Rows are kept one after another where more than
        30 % of (S, A, K) would be padding.

        Raises:
            ParameterError: a shape, an index or a probability is wrong, or a row does not sum to 1 within 1e-9; the
                first such entry is named.
        """
        return OutcomeTable(**compact_outcomes(*checked_outcomes(successors, probabilities)))

    def check(self) -> None:
        """ParameterError where the arrays, whoever wrote them, are not what the attributes say. Cost: O(S A K)."""
        pairs, size = (self.num_states, self.num_actions), self.successors.shape
        fitting = {
            "successors": ("iu", size if len(size) == 1 else (*pairs, *size[2:3])),
            "offsets": ("iu", (self.num_states * self.num_actions + 1,)),
            "codes": ("u", pairs),
            "palette": ("f", (*self.by_name.get("palette", self.successors).shape[:1], self.num_outcomes)),
            "probabilities": ("f", size),
        }
        for name, array in self.by_name.items():
            kinds, shape = fitting[name]
            is_float = kinds != "f" or array.dtype == np.float64
            if array.shape != shape or array.dtype.kind not in kinds or not is_float or not array.size:
                kind = {"iu": "integers", "u": "unsigned integers", "f": "float64"}[kinds]
                text = f"shape {array.shape} and type {array.dtype}"
                raise ParameterError(f"{name}: {text}; expected {kind} of shape {shape}")
        try:
            OutcomeCheck(self, pairs, self.num_outcomes, -1).block(0, self.num_states)
        except WrongOutcomes as error:
            raise ParameterError(f"{error.name}: {error}") from None

    # What it says of itself -----------------------------------------------------------------------------------------

    @property
    def operations(self) -> int:  # type: ignore[override]
        return 2 * self.num_outcomes

    @cached_property
    def for_kernels(self) -> tuple[Any, ...]:  # type: ignore[override]
        codes, weights = self.codes, self.palette
        if self.probabilities is not None:
            weights = self.probabilities.reshape(-1)
        shape = (self.num_states, self.num_actions)
        return self.flat, self.offsets, None if codes is None else codes.reshape(-1), weights, shape, self.num_outcomes

    def for_kernels_with(self, values: np.ndarray) -> tuple[Any, ...]:
        """`for_kernels` with other values, (N,) of all possible outcomes in order, in the place of the successors."""
        if len(values) < self.successors.size:  # padding
            rows = np.arange(self.num_states * self.num_actions)
            which = self.possible(rows)[0]
            counts = np.bincount(which, minlength=len(rows))
            padded = np.zeros((len(rows), self.num_outcomes), values.dtype)
            padded[np.arange(self.num_outcomes) < counts[:, None]] = values
            values = padded.reshape(-1)
        return (values, *self.for_kernels[1:])

    @cached_property
    def for_sweeps(self) -> tuple[Any, ...]:  # type: ignore[override]
        return (*self.for_kernels[:-1], kernels.each_of(self.num_outcomes))

    @cached_property
    def mass(self) -> float:  # type: ignore[override]
        if self.palette is not None:  # the sign of a sum by fsum is that of the exact one
            beyond = max(math.fsum([*vector, -1.0]) for vector in np.asarray(self.palette).tolist())
            return 1.0 if beyond <= 0 else math.nextafter(1.0 + beyond, 2.0)
        sums = self.expected(np.ones(self.num_states + 1))
        return max(1.0, float(sums.max()) * (1 + self.num_outcomes * _UNIT))

    @cached_property
    def has_ends(self) -> bool:  # type: ignore[override]
        return holds_end(self.successors)

    @cached_property
    def is_deterministic(self) -> bool:  # type: ignore[override]
        return bool(kernels.have_one_outcome(self.for_kernels))

    @cached_property
    def _table(self) -> Indices:
        pairs = self.num_states, self.num_actions
        if self.successors.size == self.num_states * self.num_actions:
            return self.successors.reshape(pairs)
        return np.ascontiguousarray(self.successors[..., 0])

    def deterministic_table(self) -> Indices | None:
        return self._table if self.is_deterministic else None

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(array) for name, array in self.by_name.items()}

    # What executing does --------------------------------------------------------------------------------------------

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        flat = np.ascontiguousarray(x, np.float64).reshape(len(x), x.shape[1] if x.ndim > 1 else 1, -1)
        out = np.empty((len(rows), self.num_actions, flat.shape[2]))
        kernels.expected(self.for_kernels, flat, rows, out)
        return out.reshape(len(rows), self.num_actions, *x.shape[2:])

    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        states, actions = np.asarray(states, np.int64), np.asarray(actions, np.int64)
        rows = states * self.num_actions + actions
        if len(rows) < _FEW:
            return self.possible(rows)
        size = int((self.begins(rows + 1) - self.begins(rows)).sum())
        columns = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size)
        count = kernels.entries(self.for_kernels, states, actions, *columns)
        which, following, probabilities = (column[:count] for column in columns)
        return which, following, probabilities

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if self.is_deterministic:
            return self._table[states, actions]
        drawn = np.empty(len(states), np.int64)
        kernels.draw(self.for_kernels, np.asarray(states), np.asarray(actions), rng.random(len(states)), drawn)
        return drawn

    def part(self, start: int, stop: int) -> tuple["OutcomeTable", np.ndarray]:
        first, last = self.begins(np.array([start, stop]) * self.num_actions).tolist()
        entries = rows_of(self.flat, first, last)
        local, halo = split(partial(blocks_of, entries), entries.shape, start, stop)
        return self._of_states(slice(start, stop), slice(first, last), local), halo

    def restricted_to(self, states: np.ndarray) -> "OutcomeTable":
        """These states alone; what leads out of them leads back to where it came from."""
        number = np.full(self.num_states + 1, -2, np.int64)
        number[states], number[-1] = np.arange(len(states)), -1
        return self._renumbered(states, number)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "OutcomeTable":
        return self._renumbered(representatives, np.append(classes, -1))

    def ends_and_stays(self) -> tuple[np.ndarray, np.ndarray]:
        """(S,) bool each: whether all that a state leads to is the end; and whether it is the end or the state."""
        successors, states = np.asarray(self.flat), np.arange(self.num_states + 1)
        first = self.begins(states * self.num_actions)
        ends = successors == -1
        stays = ends | (successors == np.repeat(states[:-1].astype(successors.dtype), np.diff(first)))
        return np.logical_and.reduceat(ends, first[:-1]), np.logical_and.reduceat(stays, first[:-1])

    # Parts of it ----------------------------------------------------------------------------------------------------

    def _renumbered(self, states: np.ndarray, number: np.ndarray) -> "OutcomeTable":
        """The rows of some states; number (S + 1,) of each next state, -1 for the end, -2 for where it came from."""
        which, places = self.places(self._rows(np.asarray(states)))
        following = number[self.flat[places]]
        following = np.where(following == -2, which // self.num_actions, following)
        return self._of_states(states, places, as_indices(following, len(states)))

    def _of_states(self, states: Any, places: Any, successors: Indices) -> "OutcomeTable":
        """The rows of some states, with other successors (N,); places (N,) of their entries, all and in order."""
        arrays: dict[str, Any] = {"successors": successors.reshape(-1, *self.successors.shape[1:])}
        if self.offsets is not None:
            rows = self._rows(np.arange(self.num_states)[states])
            arrays["offsets"] = np.append(0, np.cumsum(self.begins(rows + 1) - self.begins(rows)))
        if self.probabilities is None:
            arrays.update(codes=np.array(np.asarray(self.codes)[states]), palette=self.palette)
        else:
            probabilities = np.array(self.probabilities.reshape(-1)[places])
            arrays["probabilities"] = probabilities.reshape(arrays["successors"].shape)
        return OutcomeTable(num_actions=self.num_actions, **arrays)

    def _rows(self, states: np.ndarray) -> np.ndarray:
        """The rows s A + a of some states."""
        return (states[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()
