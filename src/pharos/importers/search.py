"""Breadth-first enumeration of what can be saved, restored and stepped: `BreadthFirst`, and the MDP that results.

A source hands over saved states and takes them back: pickles of an environment, rows of arrays of JAX. States have
keys. Equal keys are one state. A saved state is dropped as soon as it has been expanded, so that memory holds only the
frontier.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np

from pharos.errors import RuleError, StateSpaceTooLarge
from pharos.importers.folder import ImportedOutcomes
from pharos.mdp import Residual, Rewards, TabularMDP, lacking, normalized_rows, rounding_of_mean

END = -1
REPORT_SECONDS = 0.1


class Arrival(NamedTuple):
    """An outcome of a step, or of a reset.

    Attributes:
        probability: a float or an exact fraction; the probabilities of a step sum to 1.
        reward: of the step.
        key: of the state that was arrived in; None if the episode ended.
        saved: that state, as the source restores it; None if the source has handed it over before.
        observation: of that state, if `saved` is there.
        script: how the draws of the step came out. With it the source can step there again.
    """

    probability: Fraction | float
    reward: float
    key: bytes | None
    saved: bytes | None = None
    observation: np.ndarray | None = None
    script: tuple[int, ...] = ()


class Steppable(Protocol):
    """A source of states, with the same number of actions in each; its `name` is for messages."""

    name: str

    @property
    def num_actions(self) -> int:
        """Number of actions."""

    def starts(self) -> list[Arrival]:
        """The states in which episodes start, with their probabilities."""


class Expansions(Protocol):
    """Saved states that are expanded in their order, here or by other processes.

    Attributes:
        room: states that it takes before the first has to be fetched.
    """

    room: int

    def submit(self, saved: bytes) -> None:
        """Add a state."""

    def fetch(self) -> list[list[Arrival]]:
        """The outcomes of the first state that was submitted and not fetched so far."""

    def close(self) -> None:
        """End what works for it."""


class ExpansionsHere:
    """States that are expanded in this process, as many together as there are, up to `room`.

    Args:
        expanded: (saved states) -> the outcomes of each action in each of them.
    """

    def __init__(self, expanded: Callable[[list[bytes]], list[list[list[Arrival]]]], room: int = 1):
        self._expanded, self.room = expanded, room
        self._states: list[bytes] = []
        self._results: deque[list[list[Arrival]]] = deque()

    def submit(self, saved: bytes) -> None:
        """Add a state."""
        self._states.append(saved)

    def fetch(self) -> list[list[Arrival]]:
        """The outcomes of the first state that was not fetched."""
        if not self._results:
            self._results.extend(self._expanded(self._states))
            self._states = []
        return self._results.popleft()

    def close(self) -> None:
        """Nothing works elsewhere."""


@dataclass
class SteppedStates:
    """States so far, in the order of discovery, and the transitions of the first `num_expanded`.

    Attributes:
        keys, depths, observations: of all states. parents, parent_actions, scripts: how each was first met; END and 0
            for starts.
        starts: state -> probability.
        offsets, next_states, probabilities, rewards: outcomes of each state and action, row s A + a.
        layers: number of states at each depth.
        num_resumed: states that were expanded by another process, which was interrupted.
    """

    num_actions: int
    keys: list[bytes] = field(default_factory=list)
    depths: array = field(default_factory=lambda: array("q"))
    parents: array = field(default_factory=lambda: array("q"))
    parent_actions: array = field(default_factory=lambda: array("q"))
    scripts: list[tuple[int, ...]] = field(default_factory=list)
    observations: list[np.ndarray | None] = field(default_factory=list)
    starts: dict[int, float] = field(default_factory=dict)
    offsets: array = field(default_factory=lambda: array("q", [0]))
    next_states: array = field(default_factory=lambda: array("q"))
    probabilities: array = field(default_factory=lambda: array("d"))
    rewards: array = field(default_factory=lambda: array("d"))
    layers: list[int] = field(default_factory=list)
    num_resumed: int = 0
    numbers: dict[bytes, int] = field(default_factory=dict)

    @property
    def num_states(self) -> int:
        """States that have a number."""
        return len(self.keys)

    @property
    def num_expanded(self) -> int:
        """States whose outcomes are there."""
        return (len(self.offsets) - 1) // self.num_actions

    def add_state(self, arrival: Arrival, parent: int, action: int) -> int:
        """Number of a state that is new."""
        number = len(self.keys)
        depth = 0 if parent == END else self.depths[parent] + 1
        assert arrival.key is not None
        self.numbers[arrival.key] = number
        self.keys.append(arrival.key)
        self.depths.append(depth)
        self.parents.append(parent)
        self.parent_actions.append(action)
        self.scripts.append(arrival.script)
        self.observations.append(arrival.observation)
        if depth == len(self.layers):
            self.layers.append(0)
        self.layers[depth] += 1
        return number

    def add_row(self, shares: dict[tuple[int, float], Fraction | float]) -> None:
        """Append the outcomes of the next state and action: (next state, reward) -> probability."""
        for (next_state, reward), probability in shares.items():
            self.next_states.append(next_state)
            self.probabilities.append(float(probability))
            self.rewards.append(reward)
        self.offsets.append(len(self.next_states))

    def outcomes(self) -> ImportedOutcomes:
        """The outcomes as arrays."""
        kinds = ((self.offsets, np.int64), (self.next_states, np.int64), (self.probabilities, float))
        return ImportedOutcomes(*(np.array(each, kind) for each, kind in (*kinds, (self.rewards, float))))


@dataclass
class BreadthFirst:
    """One enumeration, which can be stopped and goes on from what it has.

    Args:
        source: steps and restores.
        horizon: states first met after so many steps are not made: whatever leads to them ends.
        max_states: more are an error.
        too_large: text for that error, with what the user can do.
        report: called now and then with (exploration, seconds, whether it is finished).
        on_state: called with (depth, saved state) of each new one.
        checkpoint: called after each expanded state.
    """

    source: Steppable
    horizon: int | None = None
    max_states: int = 100_000
    too_large: Callable[[SteppedStates], str] = lambda _: ""
    report: Callable[[SteppedStates, float, bool], None] = lambda *_: None
    on_state: Callable[[int, Any], None] = lambda *_: None
    checkpoint: Callable[[SteppedStates], None] = lambda _: None

    def begin(self) -> tuple[SteppedStates, dict[int, Any]]:
        """(an exploration with the start states, the saved state of each)."""
        exploration, frontier = SteppedStates(self.source.num_actions), dict[int, Any]()
        totals: dict[int, Fraction | float] = {}
        for arrival in self.source.starts():
            if arrival.key is None:
                raise RuleError(f"{self.source.name}: an episode ends before its first step")
            number = self._number(exploration, frontier, arrival, END, 0)
            totals[number] = totals.get(number, 0) + arrival.probability
        exploration.starts = {number: float(p) for number, p in totals.items()}
        return exploration, frontier

    def run(self, exploration: SteppedStates, frontier: dict[int, Any], pool: Expansions) -> None:
        """Expand all states, in their order.

        Args:
            frontier: the saved states of those that are not expanded; they are removed.
        Raises:
            StateSpaceTooLarge: there are more than `max_states`.
        """
        exploration.num_resumed = exploration.num_expanded
        submitted, since, shown = exploration.num_expanded, time.monotonic(), 0.0
        while (state := exploration.num_expanded) < exploration.num_states:
            while submitted < exploration.num_states and submitted - state < pool.room:
                pool.submit(frontier.pop(submitted))
                submitted += 1
            self._add(exploration, frontier, state, pool.fetch())
            self.checkpoint(exploration)
            seconds = time.monotonic() - since
            if seconds - shown > REPORT_SECONDS:
                self.report(exploration, seconds, False)
                shown = seconds
        self.report(exploration, time.monotonic() - since, True)

    def _add(
        self, exploration: SteppedStates, frontier: dict[int, Any], state: int, rows: Iterable[Sequence[Arrival]]
    ) -> None:
        """Add the outcomes of a state, and the states that they lead to."""
        is_last = self.horizon is not None and exploration.depths[state] + 1 >= self.horizon
        for action, arrivals in enumerate(rows):
            shares: dict[tuple[int, float], Fraction | float] = {}
            for arrival in arrivals:
                if arrival.key is None or (is_last and arrival.key not in exploration.numbers):
                    next_state = END
                else:
                    next_state = self._number(exploration, frontier, arrival, state, action)
                outcome = next_state, arrival.reward
                shares[outcome] = shares.get(outcome, 0) + arrival.probability
            exploration.add_row(shares)

    def _number(
        self, exploration: SteppedStates, frontier: dict[int, Any], arrival: Arrival, parent: int, action: int
    ) -> int:
        """Number of the state that was arrived in, which may be new."""
        assert arrival.key is not None
        number = exploration.numbers.get(arrival.key)
        if number is None:
            if exploration.num_states >= self.max_states:
                raise StateSpaceTooLarge(self.too_large(exploration))
            number = exploration.add_state(arrival, parent, action)
            frontier[number] = arrival.saved
            self.on_state(exploration.depths[number], arrival.saved)
        return number


def mdp_of(
    exploration: SteppedStates, *, gamma: float, horizon: int | None
) -> tuple[TabularMDP, ImportedOutcomes | None]:
    """The MDP of a finished exploration; and its outcomes, None if no action pays different rewards."""
    outcomes, actions = exploration.outcomes(), exploration.num_actions
    states, begin = exploration.num_states, outcomes.offsets[:-1]
    initial: int | np.ndarray = next(iter(exploration.starts))
    if len(exploration.starts) > 1:
        initial = np.zeros(states)
        initial[list(exploration.starts)] = list(exploration.starts.values())
        initial /= initial.sum()
    setting: dict[str, Any] = {"gamma": gamma, "horizon": horizon, "initial": initial}
    if len(outcomes.next_states) == len(begin):
        table = outcomes.next_states.reshape(states, actions)
        return TabularMDP.from_arrays(table, outcomes.rewards.reshape(states, actions), **setting), None
    from scipy import sparse

    rows = np.repeat(np.arange(len(begin)), np.diff(outcomes.offsets))
    probabilities, residuals = normalized_rows(outcomes.probabilities, rows, len(begin), _wrong_sum)
    outcomes = outcomes._replace(probabilities=probabilities)
    lows, highs = (each.reduceat(outcomes.rewards, begin) for each in (np.minimum, np.maximum))
    means = np.where(lows == highs, lows, np.add.reduceat(probabilities * outcomes.rewards, begin))
    largest = np.maximum.reduceat(np.abs(outcomes.rewards), begin)
    terms = int(np.diff(outcomes.offsets).max())
    rounding = 0.0 if (lows == highs).all() else rounding_of_mean(2 * terms, float(largest.max()))
    goes_on = outcomes.next_states >= 0
    matrix = sparse.csr_matrix(
        (probabilities[goes_on], (rows[goes_on], outcomes.next_states[goes_on])), shape=(len(begin), states)
    )
    rewards = Rewards.from_array(means.reshape(states, actions), rounding)
    mdp = TabularMDP.from_matrices(matrix, rewards.array, ends=lacking(matrix), **setting)
    mdp = replace(mdp, reward_table=rewards, residual=Residual.of(residuals, largest))
    return mdp, None if (lows == highs).all() else outcomes


def _wrong_sum(row: int, total: float) -> RuleError:
    return RuleError(f"the probabilities of row {row} sum to {total:.9g}; expected 1")
