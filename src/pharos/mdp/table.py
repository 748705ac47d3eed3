"""Tables of transitions.

`Table`: one next state for each state and action, of deterministic games. `Lazy`: another table in which actions have
no effect with some probability. Neither successors nor probabilities are copied. `OutcomeTable`: several outcomes for
each state and action, of games whose rules have chance.

Arrays of outcomes as users write them are checked, and held compactly. A sparse matrix of transitions becomes such a
table too (`Matrices`).
"""

import math
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pharos.errors import ParameterError
from pharos.kernels import outcomes as kernels
from pharos.mdp.actions import States
from pharos.mdp.arguments import ROUNDED, array_argument, normalized_rows, rounding_hint
from pharos.mdp.dynamics import Dynamics, Outcomes, TopologicalOrder, as_indices, part_with_halo
from pharos.system.arrays import (
    UNIT_ROUNDOFF,
    Indices,
    OutcomeCheck,
    OutcomeRows,
    PackedIndices,
    WrongOutcomes,
    holds_end,
    index_blocks,
    index_rows,
    read_only,
    rounding_of_sums,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


class Table(Dynamics):
    """One next state for each state and action, as a table.

    Attributes:
        next_states: (S, A) int32, int64 or `PackedIndices`. -1: the episode ends there.
    """

    operations, mass, is_deterministic = 0, 1.0, True

    def __init__(self, next_states: Indices):
        self.next_states = next_states
        self.num_states, self.num_actions = next_states.shape
        self._has_ends: bool | None = None

    @property
    def for_kernels(self) -> Indices:
        return read_only(self.next_states)

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
            for first, table in index_blocks(rows):  # no more of them is unpacked at a time
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
        which, next_states, probabilities = self.entries(states, actions)
        return Outcomes(which, np.where(next_states < 0, self.num_states, next_states.astype(np.int64)), probabilities)

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return self.next_states[states, actions]

    def part(self, start: int, stop: int) -> tuple["Table", np.ndarray]:
        rows = index_rows(self.next_states, start, stop)
        local, halo = part_with_halo(partial(index_blocks, rows), rows.shape, start, stop)
        return Table(local), halo

    def _restricted_to(self, states: np.ndarray) -> "Table":
        # transitions that leave them lead back to their own state
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


class Lazy(Dynamics):
    """Tables of next states or of outcomes, and a probability that a state stays what it is.

        E x(next) of (s, a) = (1 - p) E x(next of the tables) + p x(s)

    Under sticky actions the action that had no effect counts as executed.

    Attributes:
        tables: the dynamics without laziness. If they are lazy already, their own tables, and p is the probability of
            both.
        laziness: p, in (0, 1).
        roundings: of p and of the mean. Joining two p is off by at most 4 units, which move as much weight from one
            value to another.
    """

    is_deterministic = False
    tables: Dynamics
    roundings: int

    def __init__(self, tables: Dynamics, p: float, roundings: int = 4):
        if isinstance(tables, Lazy):
            p, roundings = 1.0 - (1.0 - tables.laziness) * (1.0 - p), tables.roundings + 8
            tables = tables.tables
        self.tables, self.laziness, self.roundings = tables, float(p), roundings
        self.num_states, self.num_actions = tables.num_states, tables.num_actions
        self.operations = tables.operations + roundings
        # of the products with 1 - p, and of 1 - p
        self.mass = max(1.0, tables.mass) * (1 + (self.operations + 2) * UNIT_ROUNDOFF)

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

    def push_forward(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        own = mass if width > 1 else mass.sum(axis=1, keepdims=True)
        return (1.0 - self.laziness) * self.tables.push_forward(mass, width) + self.laziness * own

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        from scipy import sparse

        which, next_states, probabilities = self.tables.outcomes(states, actions)
        count = len(states)
        entries = (
            np.concatenate([(1.0 - self.laziness) * probabilities, np.full(count, self.laziness)]),
            (np.concatenate([which, np.arange(count)]), np.concatenate([next_states, np.asarray(states)])),
        )
        matrix = sparse.csr_matrix(entries, (count, self.num_states + 1))  # adds up what leads to the same state
        which = np.repeat(np.arange(count), np.diff(matrix.indptr))
        return Outcomes(which, matrix.indices.astype(np.int64), matrix.data)

    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        which, next_states, probabilities = self.outcomes(states, actions)
        return which, np.where(next_states == self.num_states, -1, next_states), probabilities

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        stays = rng.random(len(states)) < self.laziness
        return np.where(stays, states, self.tables.sample(states, actions, rng))

    def order(self, live: np.ndarray) -> TopologicalOrder | None:
        return None if live.any() else self.tables.order(live)

    def part(self, start: int, stop: int) -> tuple[Dynamics, np.ndarray]:
        tables, halo = self.tables.part(start, stop)
        return Lazy(tables, self.laziness, self.roundings), halo

    def _restricted_to(self, states: np.ndarray) -> Dynamics:
        return Lazy(self.tables.restricted_to(states), self.laziness, self.roundings)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> Dynamics:
        return Lazy(self.tables.merged(classes, representatives), self.laziness, self.roundings)


# Several outcomes -----------------------------------------------------------------------------------------------------


# The share of a dense table that may be padding before successors are kept one row after another.
MOST_PADDING = 0.3
# Vectors of probabilities that codes of one and of two bytes tell apart.
ONE_BYTE_CODES, TWO_BYTE_CODES = 1 << 8, 1 << 16


def checked_outcomes(
    successors: npt.ArrayLike, probabilities: npt.ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(successors, probabilities as float64, |sum - 1| (S, A) of the rows divided by it), the first two (S, A, K).

    Raises:
        ParameterError: a shape or type is wrong, an index is outside, or a row holds no probabilities. The first such
            entry is named.
    """
    table, chances = array_argument(successors, "successors"), array_argument(probabilities, "probabilities")
    if table.ndim != 3 or table.size == 0 or table.dtype.kind not in "iu":
        raise ParameterError(
            f"successors have shape {table.shape} and type {table.dtype}; expected integers of shape "
            "(states, actions, outcomes)"
        )
    if chances.shape != table.shape or chances.dtype.kind not in "iufb":
        raise ParameterError(
            f"probabilities have shape {chances.shape} and type {chances.dtype}; expected numbers of shape "
            f"{table.shape}, one for each successor"
        )
    chances = chances.astype(np.float64, copy=False)
    wrong = ~((chances >= 0) & (chances <= 1 + ROUNDED))  # also NaN
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(f"probabilities[{s}, {a}, {k}] is {chances[s, a, k]}; expected a number from 0 to 1")
    states, actions, width = table.shape

    def refuse(row: int, total: float) -> Exception:
        advice = "; give the end of the episode, successor -1, the rest" if total < 1 else ""
        s, a = divmod(row, actions)
        return ParameterError(
            f"the probabilities of state {s}, action {a} sum to {total:.9g}; expected 1{rounding_hint(total)}{advice}"
        )

    rows = np.repeat(np.arange(states * actions), width)
    flat, residuals = normalized_rows(chances.ravel(), rows, states * actions, refuse)
    wrong = (table < -1) | (table >= len(table))
    if wrong.any():
        s, a, k = map(int, np.argwhere(wrong)[0])
        raise ParameterError(
            f"successors[{s}, {a}, {k}] is {table[s, a, k]}; expected a state from 0 to {len(table) - 1}, or -1 for "
            "the end"
        )
    return table, flat.reshape(table.shape), residuals.reshape(states, actions)


def compact_outcomes(successors: np.ndarray, probabilities: np.ndarray) -> dict[str, Any]:
    """Arguments of an `OutcomeTable`, from (S, A, K) arrays: the possible outcomes alone, in their order."""
    num_states, num_actions, _ = successors.shape
    possible = probabilities > 0
    counts = possible.sum(axis=2)
    if not possible[..., : counts.min()].all() or (possible[..., 1:] > possible[..., :-1]).any():
        order = np.argsort(~possible, axis=2, kind="stable")  # possible ones first
        successors, probabilities, possible = (
            np.take_along_axis(each, order, axis=2) for each in (successors, probabilities, possible)
        )
    width = int(counts.max())
    successors, probabilities, possible = (each[..., :width] for each in (successors, probabilities, possible))
    result: dict[str, Any] = {"num_actions": num_actions}
    ragged = counts.sum() < (1 - MOST_PADDING) * num_states * num_actions * width
    if ragged:
        result["offsets"] = np.concatenate([[0], np.cumsum(counts.ravel())])
        result["successors"] = as_indices(successors[possible], num_states)
    else:
        result["successors"] = as_indices(np.where(possible, successors, successors[..., :1]), num_states)
    codes, palette = _palette(np.ascontiguousarray(probabilities).reshape(-1, width), TWO_BYTE_CODES)
    if palette is None:
        result["probabilities"] = probabilities[possible] if ragged else np.ascontiguousarray(probabilities)
    else:
        result.update(codes=codes.reshape(num_states, num_actions), palette=palette)
    return result


def _palette(vectors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray | None]:
    """(codes (N,), the distinct ones (P, K) in the order in which they appear) of vectors (N, K).

    None if they are more than `most`.
    """
    from pharos.kernels import partition

    vectors = vectors + 0.0  # -0.0 and 0.0 are one number
    numbers, count = partition.numbered_rows(vectors)
    if count > most:
        return numbers, None
    palette = np.empty((count, vectors.shape[1]))
    palette[numbers] = vectors
    return numbers.astype(np.uint8 if count <= ONE_BYTE_CODES else np.uint16), palette


# Executions whose outcomes NumPy lists sooner than a kernel is compiled.
_FEW_EXECUTIONS = 1 << 14
# Outcomes, at most, that are copied for kernels.
_COPIED = 1 << 20


class OutcomeTable(OutcomeRows, Dynamics):
    """Several next states for each state and action, and their probabilities, as the tables of `OutcomeRows`."""

    def __init__(self, successors: Indices, num_actions: int, **others: Indices | None):
        """others: offsets, codes, palette, probabilities, see `OutcomeRows`, which also raises."""
        super().__init__(successors, **others)
        self.num_actions = num_actions
        rows = len(successors) * num_actions if self.offsets is None else len(self.offsets) - 1
        self.num_states = rows // num_actions

    @staticmethod
    def from_arrays(successors: npt.ArrayLike, probabilities: npt.ArrayLike) -> "OutcomeTable":
        """Make a table of (S, A, K) successors, -1 for the end, and probabilities, without impossible outcomes.

        Up to 65,536 distinct vectors of probabilities become a palette. Rows are kept one after another if more than
        30 % of (S, A, K) would be padding.

        Raises:
            ParameterError: a shape, an index or a probability is wrong, or a row does not sum to 1 within 1e-6. The
                first such entry is named. Rows within that are divided by their sums.
        """
        return OutcomeTable(**compact_outcomes(*checked_outcomes(successors, probabilities)[:2]))

    def check(self) -> None:
        """ParameterError if the arrays, whoever wrote them, are not what the attributes say. Cost: O(S A K)."""
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

    # Properties -------------------------------------------------------------------------------------------------------

    @property
    def operations(self) -> int:  # type: ignore[override]
        return 0 if self.is_deterministic else 2 * self.num_outcomes  # 1 times a number is exact

    @cached_property
    def for_kernels(self) -> tuple[Any, ...]:  # type: ignore[override]
        size = self.num_states * self.num_actions
        if not self.is_unrolled and size * self.num_outcomes <= _COPIED:
            # few: a copy in one form, whatever they are stored in, so that kernels are compiled once
            which, successors, probabilities = self.possible(np.arange(size))
            offsets = np.append(0, np.cumsum(np.bincount(which, minlength=size)))
            copies = np.asarray(successors, np.int32), offsets, None, np.asarray(probabilities, np.float64)
            return (*map(read_only, copies), (self.num_states, self.num_actions), self.num_outcomes)
        codes, weights = self.codes, self.palette
        if self.probabilities is not None:
            weights = self.probabilities.reshape(-1)
        shape = (self.num_states, self.num_actions)
        arrays = self.flat, self.offsets, None if codes is None else codes.reshape(-1), weights
        return (*map(read_only, arrays), shape, self.num_outcomes)

    def for_kernels_with(self, values: np.ndarray) -> tuple[object, ...]:
        """`for_kernels` with other values, (N,) of all possible outcomes in order, in the place of the successors."""
        if len(values) < len(self.for_kernels[0]):  # padding
            rows = np.arange(self.num_states * self.num_actions)
            which = self.possible(rows)[0]
            counts = np.bincount(which, minlength=len(rows))
            padded = np.zeros((len(rows), self.num_outcomes), values.dtype)
            padded[np.arange(self.num_outcomes) < counts[:, None]] = values
            values = padded.reshape(-1)
        return (read_only(values), *self.for_kernels[1:])

    @cached_property
    def for_sweeps(self) -> tuple[object, ...]:  # type: ignore[override]
        return (*self.for_kernels[:-1], kernels.each_of(self.num_outcomes, self.is_unrolled))

    @cached_property
    def mass(self) -> float:  # type: ignore[override]
        if self.is_deterministic:
            return 1.0
        if self.palette is not None:  # the sign of a sum by fsum is the sign of the exact sum
            beyond = max(math.fsum([*vector, -1.0]) for vector in np.asarray(self.palette).tolist())
            return 1.0 if beyond <= 0 else math.nextafter(1.0 + beyond, 2.0)
        sums = self.expected(np.ones(self.num_states + 1))
        return max(1.0, float(sums.max()) * (1 + self.num_outcomes * UNIT_ROUNDOFF))

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

    # Transitions ------------------------------------------------------------------------------------------------------

    def expected(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        flat = np.ascontiguousarray(x, np.float64).reshape(len(x), x.shape[1] if x.ndim > 1 else 1, -1)
        out = np.empty((len(rows), self.num_actions, flat.shape[2]))
        kernels.expected(self.for_kernels, flat, rows, out)
        return out.reshape(len(rows), self.num_actions, *x.shape[2:])

    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        states, actions = np.asarray(states, np.int64), np.asarray(actions, np.int64)
        rows = states * self.num_actions + actions
        if len(rows) < _FEW_EXECUTIONS:
            return self.possible(rows)
        size = int((self.begins(rows + 1) - self.begins(rows)).sum())
        columns = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size)
        count = kernels.entries(self.for_kernels, states, actions, *columns)
        which, next_states, probabilities = (column[:count] for column in columns)
        return which, next_states, probabilities

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if self.is_deterministic:
            return self._table[states, actions]
        drawn = np.empty(len(states), np.int64)
        kernels.draw(self.for_kernels, np.asarray(states), np.asarray(actions), rng.random(len(states)), drawn)
        return drawn

    def part(self, start: int, stop: int) -> tuple["OutcomeTable", np.ndarray]:
        first, last = self.begins(np.array([start, stop]) * self.num_actions).tolist()
        entries = index_rows(self.flat, first, last)
        local, halo = part_with_halo(partial(index_blocks, entries), entries.shape, start, stop)
        return self._of_states(slice(start, stop), slice(first, last), local), halo

    def _restricted_to(self, states: np.ndarray) -> "OutcomeTable":
        # transitions that leave them lead back to their own state
        number = np.full(self.num_states + 1, -2, np.int64)
        number[states], number[-1] = np.arange(len(states)), -1
        return self._renumbered(states, number)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "OutcomeTable":
        return self._renumbered(representatives, np.append(classes, -1))

    def ends_and_stays(self) -> tuple[np.ndarray, np.ndarray]:
        """(S,) bool each: whether a state leads to nothing but the end, and to nothing but the end or itself."""
        successors, states = np.asarray(self.flat), np.arange(self.num_states + 1)
        first = self.begins(states * self.num_actions)
        ends = successors == -1
        stays = ends | (successors == np.repeat(states[:-1].astype(successors.dtype), np.diff(first)))
        return np.logical_and.reduceat(ends, first[:-1]), np.logical_and.reduceat(stays, first[:-1])

    # Parts of it ------------------------------------------------------------------------------------------------------

    def _renumbered(self, states: np.ndarray, number: np.ndarray) -> "OutcomeTable":
        """The rows of some states. number: (S + 1,) of each next state, -1 for the end, -2 for the state of the row."""
        which, entries = self.entry_indices(self._rows(np.asarray(states)))
        next_states = number[self.flat[entries]]
        next_states = np.where(next_states == -2, which // self.num_actions, next_states)
        return self._of_states(states, entries, as_indices(next_states, len(states)))

    def _of_states(self, states: States, entries: States, successors: Indices) -> "OutcomeTable":
        """Rows of some states, with other successors (N,). entries: (N,) indices of all their outcomes, in order."""
        arrays: dict[str, Any] = {"successors": successors.reshape(-1, *self.successors.shape[1:])}
        if self.offsets is not None:
            rows = self._rows(np.arange(self.num_states)[states])
            arrays["offsets"] = np.append(0, np.cumsum(self.begins(rows + 1) - self.begins(rows)))
        if self.probabilities is None:
            arrays.update(codes=np.array(np.asarray(self.codes)[states]), palette=self.palette)
        else:
            probabilities = np.array(self.probabilities.reshape(-1)[entries])
            arrays["probabilities"] = probabilities.reshape(arrays["successors"].shape)
        return OutcomeTable(num_actions=self.num_actions, **arrays)

    def _rows(self, states: np.ndarray) -> np.ndarray:
        """The rows s A + a of some states."""
        return (states[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()


class Matrices(OutcomeTable):
    """A table of outcomes, row after row, that was given as a sparse matrix, and is stored in files as one.

    Attributes:
        transitions: (S A, S) CSR float64, row s A + a. 1 minus the sum of a row is the probability that the episode
            ends, if it exceeds 4 (n + 2) units of 2^-53 for rows of n entries: less may be rounding.
    """

    def __init__(self, transitions: "csr_matrix", num_actions: int):
        if not transitions.data.all():
            transitions = transitions.copy()
            transitions.eliminate_zeros()
        self.transitions = transitions
        counts = np.diff(transitions.indptr)
        lacks = 1 - np.asarray(transitions.sum(axis=1)).ravel()
        ending = np.flatnonzero(lacks > rounding_of_sums(int(counts.max(initial=0))))
        indices, offsets = transitions.indptr[ending + 1], transitions.indptr
        successors, probabilities = transitions.indices, transitions.data
        if len(ending):
            successors = np.insert(successors, indices, -1)
            probabilities = np.insert(probabilities, indices, lacks[ending])
            offsets = offsets + np.searchsorted(ending, np.arange(len(offsets)))
        super().__init__(successors, num_actions, offsets=offsets, probabilities=probabilities)

    def arrays(self) -> dict[str, np.ndarray]:
        matrix = self.transitions
        names = ("transitions_data", "transitions_indices", "transitions_indptr")
        return dict(zip(names, (matrix.data, matrix.indices, matrix.indptr), strict=True))
