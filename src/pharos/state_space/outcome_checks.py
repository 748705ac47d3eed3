"""What a reader checks of stored outcomes: indices, codes, probabilities, where rows begin, and terminal states."""

from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pharos.environments import Environment
from pharos.errors import StateSpaceCorrupted, StateSpaceMismatch
from pharos.rules import Layout, unpack
from pharos.state_space.manifest import AGAIN, CODES, OFFSETS, PALETTE, PROBABILITIES, TERMINAL, successors_name
from pharos.state_space.stored_outcomes import OutcomesOfState, StoredOutcomes

SUM_TOLERANCE = 1e-9
"""By how much the probabilities of the outcomes of an action may sum to something else than 1."""

_BLOCK_ENTRIES = 1 << 17


def check_outcomes(folder: Path, manifest: dict[str, Any], stored: StoredOutcomes, terminal_bits: np.ndarray) -> None:
    """StateSpaceCorrupted where the arrays are not those of a state space.

    Cost: one pass over them, in blocks that fit into a processor's cache.
    """
    _Check(folder, manifest, stored).run(terminal_bits)


class _Check:
    """Looks at the arrays of one folder."""

    def __init__(self, folder: Path, manifest: dict[str, Any], stored: StoredOutcomes):
        self.folder, self.manifest, self.stored = folder, manifest, stored
        self.num_states, self.num_actions = manifest["num_states"], manifest["num_actions"]
        self.most = manifest["num_outcomes"]
        self.successors = successors_name(manifest["arrays"])
        self.sizes = np.zeros(0, np.int64)

    def run(self, terminal_bits: np.ndarray) -> None:
        stored = self.stored
        if stored.palette is not None:
            self.sizes = self.sizes_of_palette()
        if stored.offsets is not None and (stored.offsets[0] != 0 or stored.offsets[-1] != len(stored.successors)):
            self._refuse(
                OFFSETS,
                f"begins with {stored.offsets[0]} and ends with {stored.offsets[-1]}; "
                f"expected 0 and {len(stored.successors)}",
            )
        step = max(8, _BLOCK_ENTRIES // (self.num_actions * self.most) // 8 * 8)
        terminals = transitions = 0
        for start in range(0, self.num_states, step):
            stop = min(start + step, self.num_states)
            counts, following = self.block(start, stop)
            bits = terminal_bits[start // 8 : (start + step) // 8]
            ended = np.flatnonzero(np.unpackbits(bits, count=stop - start, bitorder="little"))
            terminals += len(ended)
            transitions += int(counts.sum())
            self._check_terminal(start, ended, counts, following)
        if terminals != self.manifest["num_terminal_states"]:
            self._refuse(
                TERMINAL, f"marks {terminals} terminal states; expected {self.manifest['num_terminal_states']}"
            )
        if transitions != self.manifest["num_transitions"]:
            self._refuse(self.successors, f"has {transitions} transitions; expected {self.manifest['num_transitions']}")

    def sizes_of_palette(self) -> np.ndarray:
        """(P,) how many outcomes rows with each code have."""
        return self._sizes(np.asarray(self.stored.palette), PALETTE, lambda row: f"vector {row}")

    def block(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """How many outcomes each row of states [start, stop) has, and the first one's next state."""
        stored, rows = self.stored, slice(start * self.num_actions, stop * self.num_actions)
        counts = np.zeros(0, np.int64)
        if stored.codes is not None:
            codes = np.asarray(stored.codes[start:stop]).ravel()
            if codes.max() >= len(self.sizes):
                wrong = int((codes >= len(self.sizes)).argmax())
                self._refuse(
                    CODES,
                    f"{self._pair(rows.start + wrong)} has the code {codes[wrong]}; "
                    f"expected 0 to {len(self.sizes) - 1}",
                )
            counts = self.sizes[codes]
        if stored.offsets is None:
            following = np.asarray(stored.successors[start:stop]).reshape(-1, self.most)
            if stored.probabilities is not None:
                likely = np.asarray(stored.probabilities[start:stop]).reshape(-1, self.most)
                counts = self._sizes(likely, PROBABILITIES, lambda row: self._pair(rows.start + row))
            self._check_range(following, rows.start + np.repeat(np.arange(len(following)), self.most))
            padding = np.arange(self.most) >= counts[:, None]
            wrong = (padding & (following != following[:, :1])).any(axis=1)
            if wrong.any():
                self._refuse(
                    self.successors,
                    f"{self._pair(rows.start + int(wrong.argmax()))} has padding that does not "
                    f"repeat its first outcome",
                )
            return counts, following[:, 0]
        offsets = np.asarray(stored.offsets[rows.start : rows.stop + 1])
        lengths = np.diff(offsets)
        wrong = (lengths < 1) | (lengths > self.most) if stored.codes is None else lengths != counts
        if wrong.any():
            row = int(wrong.argmax())
            expected = f"1 to {self.most}" if stored.codes is None else f"{counts[row]}"
            self._refuse(OFFSETS, f"{self._pair(rows.start + row)} has {lengths[row]} outcomes; expected {expected}")
        entries = slice(int(offsets[0]), int(offsets[-1]))
        if offsets[0] < 0 or offsets[-1] > len(stored.successors):
            self._refuse(
                OFFSETS, f"{self._pair(rows.start)} begins at {offsets[0]}; expected 0 to {len(stored.successors)}"
            )
        following = np.asarray(stored.successors[entries])
        self._check_range(following, rows.start + np.repeat(np.arange(len(lengths)), lengths))
        if stored.probabilities is not None:
            likely = np.asarray(stored.probabilities[entries])
            padded = np.zeros((len(lengths), self.most))
            padded[np.arange(self.most) < lengths[:, None]] = likely
            sizes = self._sizes(padded, PROBABILITIES, lambda row: self._pair(rows.start + row))
            if (sizes != lengths).any():
                row = int((sizes != lengths).argmax())
                self._refuse(PROBABILITIES, f"{self._pair(rows.start + row)} has an outcome of probability 0")
        return lengths, following[offsets[:-1] - offsets[0]]

    def _sizes(self, likely: np.ndarray, name: str, whose: Any) -> np.ndarray:
        """(R,) how many of the probabilities (R, K) of each row are not 0; they come first and sum to 1."""
        with np.errstate(invalid="ignore", over="ignore"):
            possible = likely > 0
            total = np.cumsum(likely, axis=1)[:, -1]
            good = (likely >= 0).all(axis=1) & (abs(total - 1) <= SUM_TOLERANCE)
        good &= (possible[:, 1:] <= possible[:, :-1]).all(axis=1)
        if not good.all():
            row = int((~good).argmax())
            shown = ", ".join(map(str, likely[row, :8].tolist())) + (", ..." if self.most > 8 else "")
            self._refuse(
                name, f"{whose(row)} has the probabilities {shown}; expected positive ones that sum to 1, then 0"
            )
        return possible.sum(axis=1)

    def _check_range(self, following: np.ndarray, rows: np.ndarray) -> None:
        if following.min() < 0 or following.max() >= self.num_states:
            flat = following.ravel()
            j = int(((flat < 0) | (flat >= self.num_states)).argmax())
            s, a = divmod(int(rows[j]), self.num_actions)
            self._refuse(
                self.successors,
                f"action {a} leads from state {s} to state {flat[j]}; expected 0 to {self.num_states - 1}",
            )

    def _check_terminal(self, start: int, ended: np.ndarray, counts: np.ndarray, first: np.ndarray) -> None:
        own = (start + ended)[:, None]
        leaving = first.reshape(-1, self.num_actions)[ended] != own
        leaving |= counts.reshape(-1, self.num_actions)[ended] != 1
        if leaving.any():
            state = start + int(ended[leaving.any(axis=1).argmax()])
            self._refuse(self.successors, f"terminal state {state} leads to another state")

    def _pair(self, row: int) -> str:
        s, a = divmod(row, self.num_actions)
        return f"action {a} in state {s}"

    def _refuse(self, name: str, what: str) -> NoReturn:
        raise StateSpaceCorrupted(f"{self.folder / name}: {what}; {AGAIN}")


def outcomes_to_check(
    folder: Path, manifest: dict[str, Any], stored: StoredOutcomes, states: np.ndarray
) -> dict[int, OutcomesOfState]:
    """The outcomes of some states, of arrays that nobody has looked at yet; StateSpaceCorrupted where they are none."""
    check = _Check(folder, manifest, stored)
    if stored.palette is not None:
        check.sizes = check.sizes_of_palette()
    for s in states.tolist():
        check.block(s, s + 1)
    return stored.of_states(states, manifest["num_actions"])


def check_outcome_rules(
    folder: Path,
    env: Environment,
    layout: Layout,
    states: np.ndarray,
    outcomes: dict[int, OutcomesOfState],
    bits: np.ndarray,
) -> None:
    """StateSpaceMismatch where the rules of `env` disagree with the stored outcomes of some states.

    Args:
        states: (S, W), packed. bits: which ones are terminal.
        outcomes: those of the states that are looked at.
    """
    for i, of_actions in outcomes.items():
        state = tuple(unpack(layout, states[i : i + 1])[0].tolist())
        try:
            ended = bool(env.is_terminal(state))
            expected = [_outcomes_of(env, state, a, ended) for a in range(env.num_actions)]
        except Exception as error:
            raise StateSpaceMismatch(
                f"{folder}: was built with other rules: those of this {env.name} fail in state {state}: {error!r}; "
                f"build in another folder"
            ) from error
        for action, (successors, probabilities) in enumerate(of_actions):
            following = [tuple(row) for row in unpack(layout, states[successors]).tolist()]
            wanted, likely = expected[action]
            agree = following == wanted and np.abs(probabilities - likely).max() <= SUM_TOLERANCE
            if not agree or ended != bool(bits[i // 8] >> (i % 8) & 1):
                raise StateSpaceMismatch(
                    f"{folder}: was built with other rules: from state {state} action {env.actions[action]!r} leads to "
                    f"{_text(following, probabilities)}, by the rules of this {env.name} to {_text(wanted, likely)}; "
                    f"build in another folder, and raise `version` when you change rules"
                )


def _outcomes_of(env: Environment, state: tuple, action: int, ended: bool) -> tuple[list[tuple], np.ndarray]:
    """Next states and their probabilities, possible outcomes alone."""
    if ended:
        return [state], np.ones(1)
    likely = [float(env.probability(state, action, outcome)) for outcome in range(env.outcomes)]
    possible = [outcome for outcome, probability in enumerate(likely) if probability > 0]
    return [env.next_state(state, action, outcome) for outcome in possible], np.array(likely)[possible]


def _text(states: list[tuple], probabilities: np.ndarray) -> str:
    return ", ".join(f"{state} ({p:.6g})" for state, p in zip(states, probabilities.tolist(), strict=True))
