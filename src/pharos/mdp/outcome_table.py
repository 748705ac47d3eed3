"""Dynamics with several outcomes for each state and action: games whose rules have chance."""

import math
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.kernels import outcomes as kernels
from pharos.mdp.compiled import CompiledDynamics
from pharos.mdp.dynamics import Outcomes, as_indices, split
from pharos.mdp.outcome_arrays import check_outcome_arrays, checked_outcomes, compact_outcomes
from pharos.system.packed_indices import Indices, PackedIndices, as_array, blocks_of, holds_end, rows_of

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_UNIT = 2.0**-53


class OutcomeTable(CompiledDynamics):
    """Several next states for each state and action, and their probabilities, as tables.

    Attributes:
        successors: (S, A, K) int32, int64 or `PackedIndices`, -1 where the episode ends; or (N,), the rows s A + a one
            after another.
        offsets: (S A + 1,) where the rows begin; None where successors are (S, A, K).
        codes: (S, A) uint8 or uint16, which vector of the palette has the probabilities; None without a palette.
        palette: (P, K) float64, the probabilities of the outcomes in their order, then zeros; None without one.
        probabilities: float64 in the shape of successors; None where there is a palette.
        num_outcomes: K, the most outcomes of a row.
    In (S, A, K) the last successors of a row may have probability 0: they repeat its first one.
    """

    def __init__(
        self,
        successors: Indices,
        num_actions: int,
        *,
        offsets: np.ndarray | None = None,
        codes: np.ndarray | None = None,
        palette: np.ndarray | None = None,
        probabilities: np.ndarray | None = None,
    ):
        """From arrays as the files of a state space hold them: nothing is copied, so they may be memory maps.

        Raises:
            ParameterError: there is neither a palette with codes, nor probabilities.
        """
        if (palette is None) != (codes is None) or (palette is None) == (probabilities is None):
            raise ParameterError("an OutcomeTable takes codes with a palette, or probabilities; found both or neither")
        self.successors, self.offsets = as_array(successors), None if offsets is None else np.asarray(offsets)
        self.codes, self.palette, self.probabilities = (
            None if array is None else np.asarray(array) for array in (codes, palette, probabilities)
        )
        self.num_actions = num_actions
        if offsets is None:
            self.num_states, self.num_outcomes = successors.shape[0], successors.shape[2]
        else:
            self.num_states = (len(offsets) - 1) // num_actions
            self.num_outcomes = int(np.diff(offsets).max()) if palette is None else palette.shape[1]
        self.operations = 2 * self.num_outcomes

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
        check_outcome_arrays(**self.arrays(), shape=(self.num_states, self.num_actions))

    # What it says of itself -----------------------------------------------------------------------------------------

    @cached_property
    def for_kernels(self) -> tuple[Any, ...]:  # type: ignore[override]
        codes, weights = self.codes, self.palette
        if self.probabilities is not None:
            weights = self.probabilities.reshape(-1)
        shape = (self.num_states, self.num_actions)
        flat = None if codes is None else codes.reshape(-1)
        return self.successors.reshape(-1), self.offsets, flat, weights, shape, self.num_outcomes

    def for_kernels_with(self, values: np.ndarray) -> tuple[Any, ...]:
        """`for_kernels` with other values, (N,) of all possible outcomes in order, in the place of the successors."""
        if self.offsets is None:
            chances = self.probabilities
            if chances is None:
                chances = np.asarray(self.palette)[np.asarray(self.codes)]
            padded = np.zeros(self.successors.shape, values.dtype)
            padded[np.asarray(chances) > 0] = values
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
        assert self.probabilities is not None
        if self.offsets is None:
            sums = self.probabilities.sum(axis=2)
        else:
            sums = np.add.reduceat(self.probabilities, self.offsets[:-1])
        return max(1.0, float(sums.max()) * (1 + self.num_outcomes * _UNIT))

    @cached_property
    def has_ends(self) -> bool:  # type: ignore[override]
        return holds_end(self.successors)

    @cached_property
    def is_deterministic(self) -> bool:  # type: ignore[override]
        return bool(kernels.have_one_outcome(self.for_kernels))

    @cached_property
    def _table(self) -> Indices:
        if isinstance(self.successors, PackedIndices) and self.successors.size == self.num_states * self.num_actions:
            return self.successors.reshape(self.num_states, self.num_actions)
        first = self.successors if self.offsets is not None else self.successors[..., 0]
        return np.ascontiguousarray(first.reshape(self.num_states, self.num_actions))

    def deterministic_table(self) -> Indices | None:
        return self._table if self.is_deterministic else None

    def arrays(self) -> dict[str, np.ndarray]:
        names = ("successors", "offsets", "codes", "palette", "probabilities")
        return {name: np.asarray(array) for name in names if (array := getattr(self, name)) is not None}

    # What executing does --------------------------------------------------------------------------------------------

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        flat = np.ascontiguousarray(x, np.float64).reshape(len(x), x.shape[1] if x.ndim > 1 else 1, -1)
        out = np.empty((len(rows), self.num_actions, flat.shape[2]))
        kernels.expected(self.for_kernels, flat, rows, out)
        return out.reshape(len(rows), self.num_actions, *x.shape[2:])

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        """Ascending by next state; outcomes that lead to the same one are one."""
        rows = np.asarray(states) * self.num_actions + np.asarray(actions)
        which, following, probabilities = self._entries(rows)
        matrix = self._merged_entries(np.bincount(which, minlength=len(rows)), following, probabilities)
        which = np.repeat(np.arange(len(rows)), np.diff(matrix.indptr))
        return Outcomes(which, matrix.indices.astype(np.int64), matrix.data)

    def matrix(self, live: np.ndarray | None = None) -> "csr_matrix":
        states = np.arange(self.num_states) if live is None else np.flatnonzero(live)
        rows = self._rows(states)
        which, following, probabilities = self._entries(rows)
        counts = np.zeros(self.num_states * self.num_actions, np.int64)
        counts[rows] = np.bincount(which, minlength=len(rows))
        return self._merged_entries(counts, following, probabilities)

    def _merged_entries(self, counts: np.ndarray, following: np.ndarray, probabilities: np.ndarray) -> "csr_matrix":
        """(N, S + 1), column S for the end; counts (N,) of the entries of each row, which lie one after another."""
        from scipy import sparse

        small = np.int32 if max(len(following), self.num_states + 1) < 2**31 else np.int64
        columns = np.where(following < 0, self.num_states, following).astype(small, copy=False)
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(small)
        matrix = sparse.csr_matrix((probabilities, columns, indptr), shape=(len(counts), self.num_states + 1))
        matrix.sum_duplicates()
        return matrix

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if self.is_deterministic:
            return self._table[states, actions]
        drawn = np.empty(len(states), np.int64)
        kernels.draw(self.for_kernels, np.asarray(states), np.asarray(actions), rng.random(len(states)), drawn)
        return drawn

    def largest(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        return self._extreme(x, states, 1.0)

    def smallest(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        return self._extreme(x, states, -1.0)

    def _extreme(self, x: np.ndarray, states: Any, sign: float) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        out = np.empty((len(rows), self.num_actions))
        kernels.largest(self.for_kernels, np.ascontiguousarray(x, np.float64), rows, sign, out)
        return out

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        _, following, _ = self._entries(self._rows(states))
        return np.unique(np.where(following < 0, self.num_states, following))

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        result = np.zeros((self.num_states, self.num_actions), np.bool_)
        kernels.arrive(self.for_kernels, np.asarray(states), result)
        return result

    def part(self, start: int, stop: int) -> tuple["OutcomeTable", np.ndarray]:
        rows = slice(start * self.num_actions, stop * self.num_actions)
        where, arrays = slice(start, stop), {}
        if self.offsets is not None:
            offsets = self.offsets[rows.start : rows.stop + 1].astype(np.int64)
            where, arrays["offsets"] = slice(int(offsets[0]), int(offsets[-1])), offsets - offsets[0]
        if self.probabilities is not None:
            arrays["probabilities"] = np.array(self.probabilities[where])
        else:
            arrays.update(codes=np.array(self.codes[start:stop]), palette=self.palette)  # type: ignore[index]
        entries = rows_of(self.successors, where.start, where.stop)
        local, halo = split(partial(blocks_of, entries), entries.shape, start, stop)
        return OutcomeTable(local, self.num_actions, **arrays), halo

    def restricted_to(self, states: np.ndarray) -> "OutcomeTable":
        """These states alone; what leads out of them leads back to where it came from."""
        number = np.full(self.num_states + 1, -2, np.int64)
        number[states], number[-1] = np.arange(len(states)), -1
        return self._renumbered(states, number)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "OutcomeTable":
        return self._renumbered(representatives, np.append(classes, -1))

    def ends_and_stays(self) -> tuple[np.ndarray, np.ndarray]:
        """(S,) bool each: whether all that a state leads to is the end; and whether it is the end or the state."""
        successors = np.asarray(self.successors)
        own = np.arange(self.num_states, dtype=successors.dtype)
        if self.offsets is None:
            ends = successors == -1
            stays = ends | (successors == own[:, None, None])
            return ends.all(axis=(1, 2)), stays.all(axis=(1, 2))
        first = self.offsets[:: self.num_actions]
        ends = successors == -1
        stays = ends | (successors == np.repeat(own, np.diff(first)))
        return np.logical_and.reduceat(ends, first[:-1]), np.logical_and.reduceat(stays, first[:-1])

    # Parts of it ----------------------------------------------------------------------------------------------------

    def _entries(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(which row, next state or -1, probability > 0) of all outcomes of some rows s A + a, in order."""
        if self.offsets is None:
            following = self.successors.reshape(-1, self.num_outcomes)[rows]
            if self.palette is not None:
                chances = np.asarray(self.palette)[np.asarray(self.codes).reshape(-1)[rows]]
            else:
                chances = np.asarray(self.probabilities).reshape(-1, self.num_outcomes)[rows]
            which, k = np.nonzero(chances)
            return which, following[which, k], chances[which, k]
        which, places = self._places(rows)
        if self.palette is not None:
            k = places - self.offsets[rows][which]
            chances = np.asarray(self.palette)[np.asarray(self.codes).reshape(-1)[rows][which], k]
        else:
            chances = np.asarray(self.probabilities)[places]
        return which, self.successors[places], chances

    def _rows(self, states: np.ndarray) -> np.ndarray:
        """The rows s A + a of some states."""
        return (np.asarray(states)[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()

    def _places(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(which row, place in `successors`) of all outcomes of some rows, where they lie one after another."""
        assert self.offsets is not None
        first = self.offsets[rows].astype(np.int64)
        counts = self.offsets[rows + 1] - first
        which = np.repeat(np.arange(len(rows)), counts)
        return which, np.arange(len(which)) + np.repeat(first - (np.cumsum(counts) - counts), counts)

    def _renumbered(self, states: np.ndarray, number: np.ndarray) -> "OutcomeTable":
        """The rows of some states; number (S + 1,) of each next state, -1 for the end, -2 for where it came from."""
        rows = self._rows(states)
        arrays: dict[str, Any] = {}
        if self.offsets is None:
            places = np.asarray(states)
            own = np.arange(len(states))[:, None, None]
        else:
            which, places = self._places(rows)
            own = which // self.num_actions
            arrays["offsets"] = np.append(0, np.cumsum(np.bincount(which, minlength=len(rows))))
        following = number[self.successors[places]]
        arrays["successors"] = as_indices(np.where(following == -2, own, following), len(states))
        if self.probabilities is not None:
            arrays["probabilities"] = np.asarray(self.probabilities[places])
        else:
            arrays.update(codes=np.asarray(self.codes)[states], palette=self.palette)  # type: ignore[index]
        return OutcomeTable(num_actions=self.num_actions, **arrays)
