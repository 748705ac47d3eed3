"""What executing an action does, whatever the transitions are stored as.

`Dynamics` asks and answers in the terms of mathematics: expectations, their adjoint, what can follow. It knows no
chance of choosing, no policy and no terminal states; a `BellmanEquation` brings them along where a whole backup is
wanted.

A way of storing transitions is one class: `Table` (compiled.py) and `Matrices` (matrices.py). It needs the methods that
are abstract here and four attributes; the rest follows from these, and is overridden where the representation allows
something faster, as `Table` does. docs/decisions/0008-one-operator.md says why, and where the next class goes.

States are numbered 0 .. S - 1; S stands for the end of an episode, which has no value and no successors.

Runs: some rows of a range, as a few contiguous stretches of it.
"""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pharos.errors import ParameterError
from pharos.kernels import paths
from pharos.mdp.chance import Chance
from pharos.mdp.rewards import Rewards
from pharos.mdp.selection import Selection, chosen_mass
from pharos.system.packed_indices import Indices, blocks_of, room_for_indices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Blocks = Callable[[], Iterator[tuple[int, np.ndarray]]]

# Rows of a table that are looked at in one go.
_BLOCK = 1 << 16


class BellmanEquation(NamedTuple):
    """The equation x = T x of values, but for the dynamics.

        (T x)(s, b) = chance of choice in q(s, .),   q(s, a) = r(s, a) + gamma E x(next, a)

    x is (S + 1, W) float64: V(s, b) by the previously executed action b under sticky actions (W = A), else V(s) (W =
    1); row S, the end, is 0.
    """

    rewards: Rewards
    gamma: float
    chance: Chance
    select: Selection

    def value(self, q: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, W), from the values of executing each action in some states (N, A)."""
        return self.chance.choice(q, self.select.value(q, states))


class PolicyStep(NamedTuple):
    """How mass moves: live (S,) bool, the states that play goes on in; policy and chance of choosing, one step's."""

    live: np.ndarray
    policy: np.ndarray  # (S, B, A)
    chance: Chance


class Outcomes(NamedTuple):
    """What N executions may lead to.

    Attributes:
        which: (K,) index of the execution, ascending.
        states: (K,) next states, S for the end.
        probabilities: (K,) float64 > 0.
    """

    which: np.ndarray
    states: np.ndarray
    probabilities: np.ndarray


class Order(NamedTuple):
    """An order of states in which each comes before those that it may lead to.

    Attributes:
        states: (S,) all of them; None where it is that of their numbers.
        longest: the steps of the longest way through them, or more.
    """

    states: np.ndarray | None
    longest: int


class Components(NamedTuple):
    """Strongly connected components of the states, in an order in which each stands before those that it leads to.

    Attributes:
        order: (S,) the states, component by component.
        starts: (G + 1,) where groups of neighbouring components begin in the order.
        has_cycle: (G,) whether a state of a group can be visited again.
        total: how many components there are. largest: the states of the largest one that has a cycle.
    """

    order: np.ndarray
    starts: np.ndarray
    has_cycle: np.ndarray
    total: int
    largest: int


class Dynamics(ABC):
    """What executing an action does, for S states and A actions.

    Attributes:
        operations: the rounding operations, at most, of one expectation.
        mass: the largest sum of the probabilities of a row, at least 1.
        is_deterministic: whether executing an action has one outcome, everywhere.
        has_ends: whether some execution ends the episode without a next state.
        laziness: probability that nothing happens, as far as `lazy` has added it.
        workers: threads of a backup, where it has several; None for all processors.
        sweeps_ranges: whether `sweep` takes a range of the states, `part=(start, stop)`.
    """

    num_states: int
    num_actions: int
    operations: int
    mass: float
    is_deterministic: bool
    has_ends: bool
    laziness: float = 0.0
    workers: int | None = None
    sweeps_ranges: bool = False

    # What each representation says of itself ------------------------------------------------------------------------

    @abstractmethod
    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, A, ...): E x(next) of executing each action in some states (indices or a slice).

        Args:
            x: (S + 1,), a value for each state, row S for the end; or (S + 1, W, ...), W = A by the action that led
                there, or 1.
        """

    @abstractmethod
    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        """(S, W): where the mass (S, A) of executed actions goes, without what ends; W = A by executed action, or 1.

        The adjoint of `expected`: sum(mass * expected(x)) = sum(pushed(mass) * x) where x is 0 at the end.
        """

    @abstractmethod
    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        """What executing actions (N,) in states (N,) may lead to."""

    @abstractmethod
    def restricted_to(self, states: np.ndarray) -> "Dynamics":
        """These states alone, ascending, with new numbers. What leads out of them is not right any more."""

    @abstractmethod
    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Dynamics":
        """The dynamics of classes (S,) of states, each behaving as its representative (C,)."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """What it is made of, by name, as files keep it."""

    def part(self, start: int, stop: int) -> "tuple[Dynamics, np.ndarray]":
        """The states [start, stop) alone, and the states outside that they may lead to; numbers as part.py says."""
        from pharos.mdp.outcome_table import OutcomeTable  # which derives from this class

        states = np.arange(start, stop)
        outcomes = self.outcomes(*self._all_actions(states))
        following = np.where(outcomes.states == self.num_states, -1, outcomes.states)
        local, halo = split(partial(blocks_of, following), following.shape, start, stop)
        rows = np.bincount(outcomes.which, minlength=len(states) * self.num_actions)
        offsets = np.concatenate([[0], np.cumsum(rows)])
        table = OutcomeTable(local, self.num_actions, offsets=offsets, probabilities=outcomes.probabilities)
        return table, halo

    def lazy(self, p: float) -> "Dynamics":
        """The same, but with probability p the state stays what it is, whatever is executed; 0 < p < 1."""
        from pharos.mdp.matrices import Matrices  # which derives from this class

        return Matrices(self.matrix()[:, : self.num_states], self.num_actions).lazy(p)

    def deterministic_table(self) -> Indices | None:
        """(S, A) next states, -1 for the end, where each execution has one outcome; else None."""
        return None

    @property
    def has_chance(self) -> bool:
        """Whether an action that has an effect may have several outcomes."""
        return not self.is_deterministic

    @property
    def for_kernels(self) -> Any:
        """The argument `transitions` of kernels, see kernels/outcomes.py; None where they cannot read it."""
        return self.deterministic_table()

    # What follows from it -------------------------------------------------------------------------------------------

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray, runs: np.ndarray | None = None) -> None:
        """out = T x; x and out are not the same. Between the states and the end there may be others, of a part.

        runs: the states of some runs (R, 2) alone, see `runs_of`; None: all.
        """
        states = slice(None) if runs is None else slice(*runs[0]) if len(runs) == 1 else rows_of(runs)
        q = equation.rewards.rows(states) + equation.gamma * self.expected(x, states)
        out[: self.num_states][states] = equation.value(q, states)
        out[-1] = 0.0

    def sweep(self, equation: BellmanEquation, x: np.ndarray, threads: int = 1) -> float:
        """Replace each entry of x by its backup, from entries that are old or already new; once each.

        Args:
            threads: that may share the entries; which of two is first is theirs then, so that x is not the same to the
                last bit in every run.
        Returns the largest change.
        """
        new = np.empty_like(x)
        self.backup(equation, x, new)
        change = float(np.abs(new - x).max())
        x[:] = new
        return change

    def move(self, play: PolicyStep, now: np.ndarray, after: np.ndarray) -> float:
        """after (S, W) = the mass now (S, W') one step later, without what has ended.

        Returns the sum over live states.
        """
        mass = np.where(play.live[:, None], now, 0.0)
        executed = play.chance.executed(mass, chosen_mass(play.policy, mass))
        after[:] = self.pushed(executed, after.shape[1])
        return float(after[play.live].sum())

    def settle(self, play: PolicyStep, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        """Count the waiting mass (S, W) as visits (S, W) and move it on, discounted. Returns what waits afterwards.

        Masses below `least` may stay.
        """
        after = np.empty_like(waiting)
        visits[play.live] += waiting[play.live]
        self.move(play, waiting, after)
        waiting[:] = gamma * after
        waiting[~play.live] = 0.0
        return float(waiting.sum())

    def support(self, play: PolicyStep, reached: np.ndarray) -> None:
        """Set reached (S, W), 1 where mass may be and else 0, to 1 wherever it may come to."""
        after = np.empty_like(reached)
        while True:
            self.move(play, reached, after)
            new = (after > 0) & (reached == 0)
            if not new.any():
                return
            reached[new] = 1.0

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        """The states that some action may lead to from some of these, ascending; S stands for the end."""
        return np.unique(self.outcomes(*self._all_actions(states)).states)

    def largest(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, A): the largest of x (S + 1,) over what executing an action may lead to."""
        if self.is_deterministic:
            return self.expected(x, states)
        rows = np.arange(self.num_states)[states]
        outcomes = self.outcomes(*self._all_actions(rows))
        result = np.full(len(rows) * self.num_actions, -np.inf)
        np.maximum.at(result, outcomes.which, x[outcomes.states])
        return result.reshape(len(rows), self.num_actions)

    def smallest(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, A): the smallest of x (S + 1,) over what executing an action may lead to."""
        return -self.largest(-np.asarray(x), states)

    def leads_to(self, state: int) -> np.ndarray:
        """(S, A) bool: whether executing an action may lead to a state."""
        indicator = np.zeros(self.num_states + 1)
        indicator[state] = 1.0
        return self.largest(indicator) > 0

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N,): a next state of each execution, -1 for the end. Draws nothing where each has one outcome."""
        outcomes = self.outcomes(np.asarray(states), np.asarray(actions))
        first = np.searchsorted(outcomes.which, np.arange(len(states)))
        passed = np.cumsum(outcomes.probabilities)
        before = np.where(first > 0, passed[first - 1], 0.0)
        last = np.append(first[1:], len(outcomes.which)) - 1
        place = np.searchsorted(passed, before + rng.random(len(states)) * (passed[last] - before), side="right")
        drawn = outcomes.states[np.clip(place, first, last)]
        return np.where(drawn == self.num_states, -1, drawn)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        """(S,) bool: the states that can be met within `steps` steps (None: any number) from the start states."""
        reached_states = np.zeros(self.num_states + 1, np.bool_)
        reached_states[starts], reached_states[-1] = True, True
        frontier, level = np.unique(starts), 0
        while len(frontier) and (steps is None or level < steps):
            following = self.successors_of(frontier)
            frontier = following[~reached_states[following]]
            reached_states[frontier] = True
            level += 1
        return reached_states[:-1]

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        """(S, A) bool: whether executing action a in some of these states may lead to s."""
        result = np.zeros((self.num_states + 1, self.num_actions), np.bool_)
        for start in range(0, len(states), _BLOCK):
            rows, actions = self._all_actions(states[start : start + _BLOCK])
            outcomes = self.outcomes(rows, actions)
            result[outcomes.states, actions[outcomes.which]] = True
        return result[:-1]

    def components(self, live: np.ndarray, least: int) -> Components | None:
        """The strongly connected components of the states, of which live ones (S,) bool lead on; None: not looked for.

        Args:
            least: small components with cycles are put together until a group has as many states.
        Cost: one look at each transition, and 33 bytes a state.
        """
        return None

    def settle_components(
        self, equation: BellmanEquation, x: np.ndarray, parts: Components, target: float, settled: float, most: float
    ) -> None:
        """Sweep x group by group of `components`, from the last to the first, until each is settled.

        Args:
            target: a sweep of a group changes it by at most as much in the end, or by `settled` times its values.
            most: backups, after which each group that is left is swept once.
        """
        raise NotImplementedError

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: Order) -> None:
        """Replace each entry of x by its backup, from the last state of an order to the first: the fixed point."""
        states = np.arange(self.num_states) if order.states is None else order.states
        for s in states[::-1]:
            q = equation.rewards.rows(s[None]) + equation.gamma * self.expected(x, s[None])
            x[s] = equation.value(q, s[None])[0]

    def order(self, live: np.ndarray) -> Order | None:
        """An order of states in which each live one (S,) bool stands before those it leads to; None: there is none."""
        transitions = self._edges(live)
        states = None
        if paths.is_increasing(transitions, live, None)[0] >= 0:
            states = paths.topological_order(transitions, live)
            if len(states) < self.num_states:
                return None
        return Order(states, int(paths.longest_path(transitions, live, states)))

    def check_age(self, live: np.ndarray, age: np.ndarray) -> None:
        """ParameterError unless each transition of a live state (S,) bool leads to one of larger age (S,)."""
        s, a, t = paths.is_increasing(self._edges(live), live, age)
        if s >= 0:
            raise ParameterError(
                f"age: state {s}, of age {age[s]}, leads by action {a} to state {t}, of age {age[t]}; expected more"
            )

    def longest_path(self, live: np.ndarray) -> int:
        """The number of steps of the longest way through live states (S,) bool; -1 where one can be visited again."""
        order = self.order(live)
        return -1 if order is None else order.longest

    def _edges(self, live: np.ndarray) -> Any:
        """The argument `transitions` of kernels, where the end may be missing and probabilities do not matter."""
        matrix = self.matrix(live)
        inside = np.where(matrix.indices < self.num_states, matrix.indices, -1)
        return inside, matrix.indptr, None, matrix.data, (self.num_states, self.num_actions), 0

    def matrix(self, live: np.ndarray | None = None) -> "csr_matrix":
        """(S A, S + 1): the probabilities of all outcomes, row s A + a, column S for the end.

        Rows of states that are not live are empty.
        """
        from scipy import sparse

        states = np.arange(self.num_states) if live is None else np.flatnonzero(live)
        rows, actions = self._all_actions(states)
        outcomes = self.outcomes(rows, actions)
        row = (rows * self.num_actions + actions)[outcomes.which]
        counts = np.bincount(row, minlength=self.num_states * self.num_actions)
        indptr = np.concatenate([[0], np.cumsum(counts)])
        shape = (self.num_states * self.num_actions, self.num_states + 1)
        return sparse.csr_matrix((outcomes.probabilities, outcomes.states, indptr), shape=shape)

    def to_classes(self, classes: np.ndarray, count: int) -> "csr_matrix":
        """(S A, C): the probability of coming to each class (S,) of states; columns in order."""
        from scipy import sparse

        place = (np.arange(self.num_states), classes)
        members = sparse.csr_matrix((np.ones(self.num_states), place), shape=(self.num_states + 1, count))
        result = sparse.csr_matrix(self.matrix() @ members)
        result.sort_indices()
        return result

    def _all_actions(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each state with each action."""
        return np.repeat(states, self.num_actions), np.tile(np.arange(self.num_actions), len(states))


def as_indices(table: np.ndarray, num_states: int) -> np.ndarray:
    return np.ascontiguousarray(table, np.int32 if num_states < 2**31 else np.int64)


def split(blocks: Blocks, shape: tuple[int, ...], start: int, stop: int) -> tuple[Indices, np.ndarray]:
    """(next states of a range renumbered for its part, int32 where that is enough; its halo).

    Args:
        blocks: () -> (first row, some rows) of the next states of the states [start, stop), from the first row on;
            asked twice, so that no more than a block is there in 64 bits.
        shape: of all of them.
    """
    outside = [np.unique(rows[(rows >= 0) & ((rows < start) | (rows >= stop))]) for _, rows in blocks()]
    halo = np.unique(np.concatenate([np.empty(0, np.int64), *outside]))
    local = room_for_indices(shape, stop - start + len(halo) + 1)
    for first, rows in blocks():
        numbers = rows.astype(np.int64)
        inside, ends = (numbers >= start) & (numbers < stop), numbers < 0
        numbers[~inside] = np.searchsorted(halo, numbers[~inside]) + stop
        numbers -= start
        numbers[ends] = -1
        local[first : first + len(rows)] = numbers
    return local, halo


# Runs -----------------------------------------------------------------------------------------------------------------


def runs_of(is_in: np.ndarray, gap: int = 1) -> np.ndarray:
    """(R, 2) int64: where the stretches of rows begin and end that are in, (n,) bool; ascending.

    gap: stretches with fewer rows than that between them are one.
    """
    change = np.flatnonzero(np.diff(np.concatenate([[False], is_in, [False]]).astype(np.int8)))
    starts, stops = change[::2], change[1::2]
    is_apart = starts[1:] - stops[:-1] >= gap
    return np.stack([np.append(starts[:1], starts[1:][is_apart]), np.append(stops[:-1][is_apart], stops[-1:])], axis=1)


def runs_between(runs: np.ndarray, num_rows: int) -> np.ndarray:
    """(R, 2): the stretches of the other rows."""
    edges = np.concatenate([[0], runs.reshape(-1), [num_rows]]).reshape(-1, 2)
    return edges[edges[:, 1] > edges[:, 0]]


def count_of(runs: np.ndarray) -> int:
    """How many rows there are in runs (R, 2)."""
    return int((runs[:, 1] - runs[:, 0]).sum())


def rows_of(runs: np.ndarray) -> np.ndarray:
    """(N,) int64: the rows of runs (R, 2), ascending."""
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(start, stop) for start, stop in runs.tolist())])


def shares_of(runs: np.ndarray, shares: int) -> list[np.ndarray]:
    """The runs (R, 2) in as many parts of as many rows each, up to one; in order, without empty ones."""
    before = np.concatenate([[0], np.cumsum(runs[:, 1] - runs[:, 0])])
    cuts = [int(before[-1]) * i // shares for i in range(shares + 1)]
    parts = []
    for low, high in itertools.pairwise(cuts):
        if high > low:
            first, last = np.searchsorted(before, low, "right") - 1, np.searchsorted(before, high, "left")
            part = runs[first:last].copy()
            part[0, 0] += low - before[first]
            part[-1, 1] -= before[last] - high
            parts.append(part)
    return parts
