"""Finished parts of an import by stepping, in a folder, so that the same command goes on after it was killed.

FOLDER/identity.json               what is imported, with which options: another command is refused
FOLDER/part-STATE-ROW.safetensors  keys, parents and draws of the states from STATE on, and the rows from ROW on

States themselves are not stored. Each has its parent, the action and how the draws came out, and those that are not
expanded are stepped to again. Nothing that is read can run code.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, ParameterError, RuleError
from pharos.importers.search import END, Arrival, BreadthFirst, SteppedStates
from pharos.system import sealed, storage

IDENTITY = "identity.json"
CHECKPOINT_KIND = "part of an import"
LAYER_SECONDS = 2.0
"""Between two writes, at least."""
KEY_BYTES = 16


class StepCheckpoint:
    """The finished part of an exploration.

    Args:
        folder: made if it does not exist; the caller holds its lock.
        identity: what decides about the states, as JSON.
        seconds: between two writes, at least.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any], seconds: float = LAYER_SECONDS):
        self.folder, self.identity, self.seconds = folder, storage.plain(dict(identity)), seconds
        self._states = self._rows = 0
        self._due = time.monotonic() + seconds

    def resume(self, search: BreadthFirst) -> tuple[SteppedStates, dict[int, Any]]:
        """(states so far, the saved states that are not expanded yet); a new beginning if there are none.

        Raises:
            ParameterError: the folder holds a part of another import.
            RuleError: the environment is another one than then.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / IDENTITY
        if path.exists():
            self._check_identity(storage.read_json(path))
            states = self._read(search.source.num_actions)
            if states.num_states:
                self._states, self._rows = states.num_states, states.num_expanded * states.num_actions
                return states, self._replayed(search, states)
        states, frontier = search.begin()
        storage.replace_json(path, self.identity)
        return states, frontier

    def save(self, states: SteppedStates) -> None:
        """Write what is new, if it is time."""
        if time.monotonic() >= self._due:
            self.write(states)
            self._due = time.monotonic() + self.seconds

    def write(self, states: SteppedStates) -> None:
        """Write what is new, up to the last state that is there as a whole."""
        lists = (states.keys, states.depths, states.parents, states.parent_actions, states.scripts, states.observations)
        last, rows = min(map(len, lists)), states.num_expanded * states.num_actions
        if (last, rows) == (self._states, self._rows) or not states.starts:
            return
        arrays = self._state_arrays(states, last) | self._row_arrays(states, rows)
        record = {"first_state": self._states, "first_row": self._rows}
        name = f"part-{self._states:09d}-{self._rows:010d}{sealed.SUFFIX}"
        sealed.write_sealed(self.folder / name, record, arrays, CHECKPOINT_KIND)
        self._states, self._rows = last, rows

    @property
    def is_empty(self) -> bool:
        """Whether the folder holds no part of an import."""
        return not (self.folder / IDENTITY).exists()

    def discard(self) -> None:
        """Remove all parts."""
        for path in (*self.folder.glob(f"part-*{sealed.SUFFIX}"), self.folder / IDENTITY):
            path.unlink(missing_ok=True)
        self._states = self._rows = 0

    def _state_arrays(self, states: SteppedStates, last: int) -> dict[str, np.ndarray]:
        part = slice(self._states, last)
        scripts = states.scripts[part]
        arrays: dict[str, np.ndarray] = {
            "keys": np.frombuffer(b"".join(states.keys[part]), np.uint8).reshape(-1, KEY_BYTES),
            "parents": np.array(states.parents[part], np.int64),
            "parent_actions": np.array(states.parent_actions[part], np.int64),
            "script_lengths": np.array([len(script) for script in scripts], np.int64),
            "scripts": np.array([choice for script in scripts for choice in script], np.int64),
            "start_states": np.array(list(states.starts), np.int64),
            "start_probabilities": np.array(list(states.starts.values()), np.float64),
        }
        shown = [row for row in states.observations[part] if row is not None]
        if shown:
            arrays["observations"] = np.stack(shown)
        return arrays

    def _row_arrays(self, states: SteppedStates, rows: int) -> dict[str, np.ndarray]:
        offsets = np.array(states.offsets[self._rows : rows + 1], np.int64)
        outcomes = slice(int(offsets[0]), int(offsets[-1]))
        return {
            "outcome_counts": np.diff(offsets),
            "next_states": np.array(states.next_states[outcomes], np.int64),
            "probabilities": np.array(states.probabilities[outcomes], np.float64),
            "rewards": np.array(states.rewards[outcomes], np.float64),
        }

    def _check_identity(self, stored: object) -> None:
        if stored == self.identity:
            return
        stored = stored if isinstance(stored, dict) else {}
        names = {*stored, *self.identity}
        others = sorted(name for name in names if stored.get(name) != self.identity.get(name))
        raise ParameterError(
            f"{self.folder}: holds a part of another import, with another {', '.join(others)}; finish that with its "
            f"own command, remove the folder, or choose another --out"
        )

    def _read(self, num_actions: int) -> SteppedStates:
        """The states of all parts that follow each other."""
        states = SteppedStates(num_actions)
        for path in sorted(self.folder.glob(f"part-*{sealed.SUFFIX}")):
            sealed.read_sealed(path, CHECKPOINT_KIND, lambda record, arrays: self._append(states, record, arrays))
        return states

    @staticmethod
    def _append(states: SteppedStates, record: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        rows = states.num_expanded * states.num_actions
        if (record["first_state"], record["first_row"]) != (states.num_states, rows):
            raise FileFormatError("does not follow the part before; remove the folder, and import again")
        ends = np.cumsum(arrays["script_lengths"])
        scripts = np.split(arrays["scripts"], ends[:-1]) if len(ends) else []
        shown = arrays.get("observations")
        for i, key in enumerate(arrays["keys"]):
            script = tuple(scripts[i].tolist())
            observation = None if shown is None else shown[i]
            arrival = Arrival(1.0, 0.0, key.tobytes(), None, observation, script)
            states.add_state(arrival, int(arrays["parents"][i]), int(arrays["parent_actions"][i]))
        begin = states.offsets[-1]
        states.offsets.extend((begin + np.cumsum(arrays["outcome_counts"])).tolist())
        states.next_states.extend(arrays["next_states"].tolist())
        states.probabilities.extend(arrays["probabilities"].tolist())
        states.rewards.extend(arrays["rewards"].tolist())
        starts = zip(arrays["start_states"].tolist(), arrays["start_probabilities"].tolist(), strict=True)
        states.starts = dict(starts)

    def _replayed(self, search: BreadthFirst, states: SteppedStates) -> dict[int, Any]:
        """The saved states of those that are not expanded, stepped to again along their parents."""
        source: Any = search.source
        children = np.zeros(states.num_states, np.int64)
        needed = np.zeros(states.num_states, np.bool_)
        for state in range(states.num_states - 1, -1, -1):  # parents have smaller numbers
            needed[state] |= state >= states.num_expanded
            if needed[state] and (parent := states.parents[state]) != END:
                needed[parent] = True
                children[parent] += 1
        saved, frontier = dict[int, Any](), dict[int, Any]()
        for state in np.flatnonzero(needed).tolist():
            parent = states.parents[state]
            origin = None if parent == END else saved[parent]
            arrival = source.arrive(origin, states.parent_actions[state], states.scripts[state])
            if arrival.key != states.keys[state]:
                raise RuleError(
                    f"{source.name}: is not the environment of which {self.folder} holds a part (state {state} is "
                    f"another one); remove that folder, and import again"
                )
            if state >= states.num_expanded:
                frontier[state] = arrival.saved
                search.on_state(states.depths[state], arrival.saved)
            if children[state]:
                saved[state] = arrival.saved
            if parent != END:
                children[parent] -= 1
                if not children[parent]:
                    del saved[parent]
        source.skip(states.keys)
        return frontier
