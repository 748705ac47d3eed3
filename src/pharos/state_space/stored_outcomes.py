"""The outcomes of a finished state space, as its files hold them: two layouts, and two ways to keep probabilities."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.state_space.manifest import CODES, OFFSETS, PALETTE, PROBABILITIES, successors_name
from pharos.state_space.shards import mapped, parts_of
from pharos.system.packed_indices import Indices, dtype_of, from_stored

OutcomesOfState = list[tuple[np.ndarray, np.ndarray]]
"""For each action the next states and their probabilities, possible outcomes alone."""


class StoredOutcomes(NamedTuple):
    """What executing actions may lead to, for S states, A actions and at most K outcomes; memory maps.

    Attributes:
        successors: (S, A, K), of which impossible outcomes repeat the first; or (N,), the rows s A + a one after
            another.
        offsets: (S A + 1,) where the rows begin; None where successors are (S, A, K).
        codes: (S, A) uint8 or uint16, which vector of the palette has the probabilities; None without a palette.
        palette: (P, K) float64, the probabilities of possible outcomes in their order, then zeros; None without one.
        probabilities: float64 in the shape of successors; None where there is a palette.
    """

    successors: Indices
    offsets: np.ndarray | None
    codes: np.ndarray | None
    palette: np.ndarray | None
    probabilities: np.ndarray | None

    @staticmethod
    def of_folder(folder: Path, manifest: dict[str, Any]) -> "StoredOutcomes":
        """The arrays of a folder; nothing is read yet."""
        arrays = manifest["arrays"]
        pairs = manifest["num_states"], manifest["num_actions"]
        shapes = {
            successors_name(arrays): (*pairs, manifest["num_outcomes"]),
            OFFSETS: (pairs[0] * pairs[1] + 1,),
            CODES: pairs,
            PALETTE: (-1, manifest["num_outcomes"]),
            PROBABILITIES: (*pairs, manifest["num_outcomes"]),
        }
        if OFFSETS in arrays:
            shapes[successors_name(arrays)] = shapes[PROBABILITIES] = (manifest["num_transitions"],)

        def array(name: str) -> np.ndarray | None:
            if name not in arrays:
                return None
            return mapped(parts_of(folder, manifest, name), dtype_of(arrays[name]["dtype"])).reshape(shapes[name])

        successors = array(successors_name(arrays))
        assert successors is not None
        others = (array(name) for name in (OFFSETS, CODES, PALETTE, PROBABILITIES))
        return StoredOutcomes(from_stored(successors), *others)

    def entries(self, start: int, stop: int, num_actions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All possible outcomes of states [start, stop), N of them.

        Returns:
            which (N,) int64, ascending, (s - start) A + a; successors (N,) int64; probabilities (N,) float64.
        """
        from pharos.kernels import palettes

        if self.offsets is None:
            following = np.asarray(self.successors[start:stop])
            rows, most = following.shape[0] * following.shape[1], following.shape[2]
            if self.palette is None:
                assert self.probabilities is not None
                vectors, codes = np.asarray(self.probabilities[start:stop]).reshape(-1, most), np.arange(rows)
            else:
                vectors, codes = np.asarray(self.palette), np.asarray(self.codes[start:stop]).ravel()  # type: ignore[index]
            which, successors = np.empty(rows * most, np.int64), np.empty(rows * most, np.int64)
            likely = np.empty(rows * most)
            arrays = which, successors, likely
            n = palettes.entries_of_padded(following.reshape(-1, most), vectors, codes, *arrays)
            return which[:n], successors[:n], likely[:n]
        offsets = np.asarray(self.offsets[start * num_actions : stop * num_actions + 1])
        part = slice(int(offsets[0]), int(offsets[-1]))
        successors = np.asarray(self.successors[part], np.int64)
        if self.palette is None:
            assert self.probabilities is not None
            which = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
            return which, successors, np.asarray(self.probabilities[part])
        which, likely = np.empty(len(successors), np.int64), np.empty(len(successors))
        codes = np.asarray(self.codes[start:stop]).ravel()  # type: ignore[index]
        palettes.entries_of_ragged(offsets, np.asarray(self.palette), codes, which, likely)
        return which, successors, likely

    def of_states(self, states: np.ndarray, num_actions: int) -> dict[int, OutcomesOfState]:
        """The outcomes of some states."""
        return {int(s): [self._of_pair(int(s), a, num_actions) for a in range(num_actions)] for s in states}

    def _of_pair(self, s: int, a: int, num_actions: int) -> tuple[np.ndarray, np.ndarray]:
        if self.offsets is None:
            successors, place = np.asarray(self.successors[s, a]), (s, a)
            likely = self.probabilities[place] if self.palette is None else self.palette[self.codes[place]]  # type: ignore[index]
            possible = np.asarray(likely) != 0
            return successors[possible], np.asarray(likely)[possible]
        row = s * num_actions + a
        part = slice(int(self.offsets[row]), int(self.offsets[row + 1]))
        successors = np.asarray(self.successors[part])
        if self.palette is None:
            assert self.probabilities is not None
            return successors, np.asarray(self.probabilities[part])
        return successors, np.asarray(self.palette[self.codes[s, a]])[: len(successors)]  # type: ignore[index]
