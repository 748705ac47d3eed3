"""An imported MDP as an environment: its rules look up the table that a folder keeps, so whatever takes environments
takes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments.base import Environment, Layer, store
from pharos.errors import FileFormatError, ParameterError
from pharos.system import distinct_rows, mdp_files, storage
from pharos.system.arrays import OutcomeRows, rounding_of_sums
from pharos.system.distinct_rows import DistinctRows

TIME_LIMIT = 1000  # of an MDP that has no horizon, and whose source has no limit
MOST_TABLE_ENTRIES = 1 << 28  # of a table of outcomes, written out
DIGIT_SPRITES = (
    ("###", "#.#", "#.#", "#.#", "###"),
    (".#.", "##.", ".#.", ".#.", "###"),
    ("###", "..#", "###", "#..", "###"),
    ("###", "..#", ".##", "..#", "###"),
    ("#.#", "#.#", "###", "..#", "..#"),
    ("###", "#..", "###", "..#", "###"),
    ("###", "#..", "###", "#.#", "###"),
    ("###", "..#", "..#", ".#.", ".#."),
    ("###", "#.#", "###", "#.#", "###"),
    ("###", "#.#", "###", "..#", "###"),
)


@dataclass(frozen=True, kw_only=True)
class ImportedWorld(Environment):
    """The MDP of a folder that `pharos import` or `importers.save` wrote.

    State    its number in the folder. S is the end, if transitions end an episode without a next state.
    Actions  as in the source: by name if the import recorded the names, otherwise by number.
    Reward   of the outcome, if the folder has it, otherwise the mean for the state and action.
    Ends     in terminal states, and on transitions without a next state.
    Chance   as in the table.
    """

    folder: str = ""
    digest: str = ""

    name = "imported"
    version = 1
    numbered_by = ("state",)
    is_filled = True
    layers = {"digit": Layer(tuple("0123456789"), (226, 228, 232), sprite=DIGIT_SPRITES)}

    def validate(self) -> None:
        if not isinstance(self.folder, str) or not self.folder:
            raise ParameterError(f"imported: folder is {self.folder!r}; expected one that `pharos import` wrote")
        store(self, "folder", str(Path(self.folder).expanduser().absolute()))
        digest = str(self.manifest.get(storage.DIGEST) or storage.digest_of_json(self.manifest))
        if self.digest not in ("", digest):
            raise ParameterError(
                f"{self.folder}: holds another MDP than it did (digest {digest}, then {self.digest}); "
                f"bring the folder of then back, or start anew"
            )
        store(self, "digest", digest)
        for entry, is_optional in (("num_states", 0), ("num_actions", 0), ("horizon", 1), ("time_limit", 1)):
            value = self.manifest.get(entry)
            if not (is_optional and value is None) and (type(value) is not int or value < 1):
                raise FileFormatError(f"{self.folder}: {entry} is {value!r}; expected an integer; {mdp_files.REIMPORT}")
        names = self.manifest.get("actions")
        if names is not None and not (
            isinstance(names, list) and len(names) == self.manifest["num_actions"] and all(map(is_name, names))
        ):
            raise FileFormatError(f"{self.folder}: actions are {names!r}; expected their names; {mdp_files.REIMPORT}")

    @cached_property
    def manifest(self) -> Mapping[str, Any]:
        """Manifest of the folder."""
        return mdp_files.read_mdp_manifest(self.folder)

    @property
    def actions(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the actions."""
        return tuple(self.manifest.get("actions") or map(str, range(self.manifest["num_actions"])))

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        """The horizon of the MDP, else the time limit of its source, else 1,000."""
        return int(self.manifest.get("horizon") or self.manifest.get("time_limit") or TIME_LIMIT)

    @cached_property
    def residual(self) -> tuple[float, float]:  # type: ignore[override]
        """Distances that the sums of the source's rows leave open, in probability and in reward.

        The rounding of rewards that are means counts as a distance, unless the rules know the reward of each outcome.
        """
        try:
            probabilities, rewards = mdp_files.residual_of(self.manifest)
            knows_outcomes = set(mdp_files.PAID) <= set(self.manifest["arrays"])
            return probabilities, rewards + (0.0 if knows_outcomes else mdp_files.rounding_of(self.manifest))
        except ValueError as error:
            raise FileFormatError(f"{self.folder}: {error}; {mdp_files.REIMPORT}") from None

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """K, the most outcomes of an action."""
        return self.successors.shape[2]

    def variables(self):
        return {"state": range(len(self.successors))}

    def initial_states(self):
        starts, likely = self._arrays["start_states"], self._arrays["start_probabilities"]
        total = float(likely.sum())
        return [((int(s),), float(p) / total) for s, p in zip(starts, likely, strict=True) if p > 0]

    def probability(self, state, action, outcome):
        return self.probabilities[state[0], action, outcome]

    def transition(self, state, action, outcome, out):
        out[0] = self.successors[state[0], action, outcome]

    def is_terminal(self, state):
        return self.terminal[state[0]]

    def is_available(self, state, action):
        return self.available[state[0], action]

    def reward(self, state, action, next_state, outcome=-1):
        if outcome < 0:
            return self.rewards[state[0], action]
        return self.paid[state[0], action, outcome if self.paid.shape[2] > 1 else 0]

    def grid(self):
        return 1, len(str(len(self.successors) - 1))

    def draw(self, state, planes):
        rest = state[0]
        columns = planes.shape[2]
        for i in range(columns):
            planes[0, 0, columns - 1 - i] = rest % 10 + 1
            rest = rest // 10

    def picture(self, state) -> np.ndarray | None:
        """Picture of a state from the source, (H, W, 3) uint8, if the import recorded images or grids, else None.

        Codes of a grid are shown as colours.
        """
        kind, shown = self.manifest.get(mdp_files.SHOWN_NAME), self.recorded
        if kind not in ("image", "grid") or shown is None or shown.ndim != 4 or shown.shape[-1] != 3:
            return None
        if kind == "image":
            return shown[state[0]]
        stretched = shown[state[0]] * self._stretch
        return np.ascontiguousarray(stretched.transpose(1, 0, 2))

    @cached_property
    def _stretch(self) -> np.ndarray:
        assert self.recorded is not None
        return distinct_rows.stretch(self.recorded)

    # The table --------------------------------------------------------------------------------------------------------

    @property
    def successors(self) -> np.ndarray:
        """(S, A, K) int64, next states, with a row for the end, if there is one."""
        return self._table[0]

    @property
    def probabilities(self) -> np.ndarray:
        """(S, A, K) float64, of the outcomes."""
        return self._table[1]

    @cached_property
    def terminal(self) -> np.ndarray:
        """(S,) bool."""
        return self._with_end(np.asarray(self._arrays["terminal"], np.bool_), True)

    @cached_property
    def rewards(self) -> np.ndarray:
        """(S, A) float64."""
        return self._with_end(np.asarray(self._arrays["rewards"], np.float64), 0.0)

    @property
    def has_sets(self) -> bool:
        return mdp_files.AVAILABLE in self.manifest["arrays"]

    @cached_property
    def available(self) -> np.ndarray:
        """(S, A) bool, the actions that exist in each state. (1, A), all True, if every action exists everywhere."""
        if not self.has_sets:
            return np.ones((len(self.successors), self.manifest["num_actions"]), np.bool_)
        return self._with_end(np.asarray(self._arrays[mdp_files.AVAILABLE], np.bool_), True)

    @property
    def paid(self) -> np.ndarray:
        """(S, A, K) float64, the reward of each outcome. (S, A, 1) if the folder has only the means."""
        paid = self._table[2]
        return self.rewards[:, :, None] if paid is None else paid

    @cached_property
    def recorded(self) -> np.ndarray | DistinctRows | None:  # type: ignore[override]
        """(S, ...) recorded observation of each state, zeros for the end. None if the import recorded nothing.

        Rows of a large recording are read when they are looked at.
        """
        shown = mdp_files.read_observations(self.folder, self.manifest)
        if shown is None:
            return None
        if len(shown) != self.manifest["num_states"]:
            raise FileFormatError(f"{self.folder}: {len(shown)} observations for {self.manifest['num_states']} states")
        if isinstance(shown, np.ndarray):
            return self._with_end(shown, 0)
        return shown.with_zeros(len(self.successors) - len(shown))

    @property
    def num_numbered(self) -> int:
        return int(self.manifest["num_states"])  # without the end

    def _with_end(self, rows: np.ndarray, value: object) -> np.ndarray:
        more = len(self.successors) - len(rows)
        return rows if more == 0 else np.concatenate([rows, np.full((more, *rows.shape[1:]), value, rows.dtype)])

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        try:
            return mdp_files.read_arrays(self.folder, self.manifest)
        except FileFormatError:
            raise
        except (KeyError, ValueError) as error:
            raise FileFormatError(
                f"{self.folder}: the imported MDP is damaged: {error}; {mdp_files.REIMPORT}"
            ) from None

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        states, actions = self.manifest["num_states"], self.manifest["num_actions"]
        try:
            table = written_out(*table_outcomes(self._arrays, states, actions), states, actions, self._paid)
        except (ValueError, IndexError, TypeError, OverflowError) as error:
            raise FileFormatError(
                f"{self.folder}: the imported MDP is damaged: {error}; {mdp_files.REIMPORT}"
            ) from None
        return table

    @property
    def _paid(self) -> np.ndarray | None:
        return self._arrays.get(mdp_files.PAID[3])


def is_name(value: object) -> bool:
    """Whether a value can be the name of an action."""
    return isinstance(value, str) and value != ""


def table_outcomes(
    arrays: Mapping[str, np.ndarray], states: int, actions: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows (N,), successors (N,), probabilities (N,)): the outcomes of row s A + a, in any of the forms of a folder.

    The end of an episode is the successor -1. Raises ValueError if they are no table of an MDP.
    """
    number = states * actions
    if mdp_files.PAID[0] in arrays:
        offsets, successors, probabilities, _ = (arrays[name] for name in mdp_files.PAID)
        return np.repeat(np.arange(number), np.diff(offsets)), successors, probabilities
    if mdp_files.TABLE[0] in arrays:
        successors = arrays[mdp_files.TABLE[0]].reshape(number)
        return np.arange(number), successors, np.ones(number)
    if mdp_files.OUTCOME_ARRAYS[0] in arrays:
        stored = OutcomeRows(**{name: array for name, array in arrays.items() if name in OutcomeRows.NAMES})
        return stored.possible(np.arange(number))
    data, indices, indptr = (arrays[name] for name in mdp_files.MATRIX)
    rows = np.repeat(np.arange(number), np.diff(indptr))
    rest = 1.0 - np.bincount(rows, data, minlength=number)
    ends = np.flatnonzero(rest > rounding_of_sums(int(np.diff(indptr).max(initial=0))))
    rows, indices = np.concatenate([rows, ends]), np.concatenate([indices, np.full(len(ends), -1, indices.dtype)])
    return rows, indices, np.concatenate([data, rest[ends]])


def written_out(
    rows: np.ndarray,
    successors: np.ndarray,
    p: np.ndarray,
    states: int,
    actions: int,
    outcome_rewards: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(S, A, K) successors, probabilities that sum to 1, and rewards. Impossible outcomes are left out.

    S is the end, if there is one. p (N,): probabilities. outcome_rewards (N,): the reward of each outcome, if known.

    Raises:
        ParameterError: they are more than MOST_ENTRIES numbers. ValueError: they are no table of an MDP.
    """
    payments = p if outcome_rewards is None else outcome_rewards
    if not len(rows) == len(successors) == len(p) == len(payments) or not (np.isfinite(p) & (p >= 0)).all():
        raise ValueError("successors and probabilities do not fit")
    # Possible outcomes, sorted by row s A + a
    order = np.argsort(rows, kind="stable")
    order = order[p[order] > 0]
    rows, successors, p, payments = rows[order], successors[order].astype(np.int64), p[order], payments[order]
    if len(successors) == 0 or successors.min() < -1 or successors.max() >= states:
        raise ValueError(f"a successor is not among the {states} states")
    counts = np.bincount(rows, minlength=states * actions)
    has_end = bool((successors == -1).any())
    most, count = int(counts.max()), states + has_end
    if count * actions * most > MOST_TABLE_ENTRIES:
        raise ParameterError(
            f"the table has {count:,} states, {actions} actions and up to {most:,} outcomes of each; expected at most "
            f"{MOST_TABLE_ENTRIES:,} numbers in all: it can be solved and measured, but not stepped"
        )
    # Tables with K columns, filled up with probability 0
    index = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.zeros((count * actions, most), np.int64)
    chances = np.zeros((count * actions, most))
    table[rows, index] = np.where(successors == -1, states, successors)
    chances[rows, index] = p / np.bincount(rows, p, minlength=states * actions)[rows]
    if has_end:
        table[states * actions :], chances[states * actions :, 0] = states, 1.0
    shape = (count, actions, most)
    if outcome_rewards is None:
        return table.reshape(shape), chances.reshape(shape), None
    rewards = np.zeros((count * actions, most))
    rewards[rows, index] = payments
    return table.reshape(shape), chances.reshape(shape), rewards.reshape(shape)
