"""What executing an action does: the one place that knows how transitions are stored.

`Dynamics` asks and answers in the terms of mathematics: expectations, their adjoint, what can follow. It knows no chance of
choosing, no policy and no terminal states; a `BellmanEquation` brings them along where a whole backup is wanted.

A kind of MDP is one class here. It needs `expected`, `pushed`, `outcomes`, `restricted_to`, `merged` and four numbers; the rest
follows from these in `Dynamics`, and is overridden where the representation allows something faster, as `Table` does.

States are numbered 0 .. S - 1; S stands for the end of an episode, which has no value and no successors.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pharos.kernels import bellman, graph, occupancy, paths
from pharos.mdp.chance import Chance
from pharos.mdp.rewards import Rewards
from pharos.mdp.selection import Extreme, PolicyTable, Selection, chosen_mass

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Rows of a table that are looked at in one go.
_BLOCK = 1 << 16
# What a row of a matrix lacks to 1 is the end from this probability on, and else the rounding of its entries.
_SURE_END = 1e-12


class BellmanEquation(NamedTuple):
    """The equation x = T x of values, but for the dynamics.

        (T x)(s, b) = chance of choice in q(s, .),   q(s, a) = r(s, a) + gamma E x(next, a)

    x is (S + 1, W) float64: V(s, b) by the previously executed action b under sticky actions (W = A), else V(s) (W = 1);
    row S, the end, is 0.
    """

    rewards: Rewards
    gamma: float
    chance: Chance
    select: Selection

    def value(self, q: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, W), from the values of executing each action in some states (N, A)."""
        return self.chance.choice(q, self.select.value(q, states))


class Play(NamedTuple):
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


class Dynamics(ABC):
    """What executing an action does, for S states and A actions.

    Attributes:
        operations: the rounding operations, at most, of one expectation.
        mass: the largest sum of the probabilities of a row, at least 1.
        is_deterministic: whether executing an action has one outcome, everywhere.
        has_ends: whether some execution ends the episode without a next state.
    """

    num_states: int
    num_actions: int
    operations: int
    mass: float
    is_deterministic: bool
    has_ends: bool

    # What each representation says of itself ---------------------------------------------------------------------------

    @abstractmethod
    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        """(N, A, ...): E x(next) of executing each action in some states (indices or a slice).

        Args:
            x: (S + 1,), a value for each state, row S for the end; or (S + 1, W, ...), W = A by the action that led there, or 1.
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

    def deterministic_table(self) -> np.ndarray | None:
        """(S, A) next states, -1 for the end, where each execution has one outcome; else None."""
        return None

    # What follows from it ------------------------------------------------------------------------------------------------

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray) -> None:
        """out = T x; x and out are not the same."""
        out[:-1] = equation.value(equation.rewards.array + equation.gamma * self.expected(x))
        out[-1] = 0.0

    def sweep(self, equation: BellmanEquation, x: np.ndarray) -> float:
        """Replace each entry of x by its backup, from entries that are old or already new; return the largest change."""
        new = np.empty_like(x)
        self.backup(equation, x, new)
        change = float(np.abs(new - x).max())
        x[:] = new
        return change

    def move(self, play: Play, now: np.ndarray, after: np.ndarray) -> float:
        """after (S, W) = the mass now (S, W') one step later, without what has ended. Returns the sum over live states."""
        mass = np.where(play.live[:, None], now, 0.0)
        executed = play.chance.executed(mass, chosen_mass(play.policy, mass))
        after[:] = self.pushed(executed, after.shape[1])
        return float(after[play.live].sum())

    def settle(self, play: Play, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        """Count the waiting mass (S, W) as visits (S,) and move it on, discounted. Returns what waits afterwards.

        Masses below `least` may stay.
        """
        after = np.empty_like(waiting)
        visits[play.live] += waiting[play.live].sum(axis=1)
        self.move(play, waiting, after)
        waiting[:] = gamma * after
        waiting[~play.live] = 0.0
        return float(waiting.sum())

    def support(self, play: Play, reached: np.ndarray) -> None:
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
        return self.expected(indicator) > 0

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N,): a next state of each execution, -1 for the end. Draws nothing where each has one outcome."""
        outcomes = self.outcomes(np.asarray(states), np.asarray(actions))
        first = np.searchsorted(outcomes.which, np.arange(len(states)))
        passed = np.cumsum(outcomes.probabilities)
        before = np.where(first > 0, passed[first - 1], 0.0)
        last = np.append(first[1:], len(outcomes.which)) - 1
        place = np.searchsorted(passed, before + rng.random(len(states)) * (passed[last] - before), side="right")
        found = outcomes.states[np.clip(place, first, last)]
        return np.where(found == self.num_states, -1, found)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        """(S,) bool: the states that can be met within `steps` steps (None: any number) from the start states."""
        met = np.zeros(self.num_states + 1, np.bool_)
        met[starts], met[-1] = True, True
        frontier, level = np.unique(starts), 0
        while len(frontier) and (steps is None or level < steps):
            following = self.successors_of(frontier)
            frontier = following[~met[following]]
            met[frontier] = True
            level += 1
        return met[:-1]

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        """(S, A) bool: whether executing action a in some of these states may lead to s."""
        result = np.zeros((self.num_states + 1, self.num_actions), np.bool_)
        for start in range(0, len(states), _BLOCK):
            rows, actions = self._all_actions(states[start : start + _BLOCK])
            outcomes = self.outcomes(rows, actions)
            result[outcomes.states, actions[outcomes.which]] = True
        return result[:-1]

    def longest_path(self, live: np.ndarray) -> int:
        """The number of steps of the longest way through live states (S,) bool; -1 where one can be visited again."""
        matrix = self.matrix(live)
        first = matrix.indptr[:: self.num_actions].astype(np.int64)
        return int(paths.longest_path(first, matrix.indices.astype(np.int64), self.num_states))

    def matrix(self, live: np.ndarray | None = None) -> "csr_matrix":
        """(S A, S + 1): the probabilities of all outcomes, row s A + a, column S for the end; rows of other than live states empty."""
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


class Table(Dynamics):
    """One next state for each state and action, as a table.

    Attributes:
        next_states: (S, A) int32 or int64; -1: the episode ends there.
    """

    operations, mass, is_deterministic = 0, 1.0, True

    def __init__(self, next_states: np.ndarray):
        self.next_states = next_states
        self.num_states, self.num_actions = next_states.shape
        self._has_ends: bool | None = None

    @property
    def has_ends(self) -> bool:  # type: ignore[override]
        if self._has_ends is None:
            self._has_ends = bool((self.next_states == -1).any())
        return self._has_ends

    def deterministic_table(self) -> np.ndarray:
        return self.next_states

    def arrays(self) -> dict[str, np.ndarray]:
        return {"next_states": np.asarray(self.next_states)}

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        table = self.next_states[states]  # -1 reads the last row, which is the end's
        if x.ndim == 1:
            return x[table]
        return x[table, np.arange(self.num_actions)] if x.shape[1] > 1 else x[table, 0]

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        after = np.zeros((self.num_states, width))
        s, a = np.nonzero(mass)
        t = self.next_states[s, a]
        inside = t >= 0
        column = a[inside] if width > 1 else np.zeros_like(a[inside])
        np.add.at(after, (t[inside], column), mass[s, a][inside])
        return after

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        following = self.next_states[states, actions].astype(np.int64)
        following[following < 0] = self.num_states
        return Outcomes(np.arange(len(following)), following, np.ones(len(following)))

    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return self.next_states[states, actions]

    def restricted_to(self, states: np.ndarray) -> "Table":
        """These states alone; what leads out of them leads back to where it came from."""
        number = np.full(self.num_states, -1, np.int64)
        number[states] = np.arange(len(states))
        table = np.asarray(self.next_states[states])
        inside = number[table]  # what leads to -1 gets any number here
        own = np.broadcast_to(np.arange(len(states))[:, None], table.shape)
        return Table(_as_indices(np.where(table < 0, -1, np.where(inside < 0, own, inside)), len(states)))

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Table":
        table = np.asarray(self.next_states)[representatives].astype(np.int64)
        return Table(_as_indices(np.where(table >= 0, classes[table], -1), len(representatives)))

    # Compiled: the same, without temporary arrays ------------------------------------------------------------------------

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray) -> None:
        rewards, gamma, chance, select = equation
        if not isinstance(select, Extreme):
            return super().backup(equation, x, out)
        tables = (self.next_states, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        kernel, weights, x_, out_ = (
            (bellman.sticky_block, chance.triple, x, out)
            if chance.is_sticky
            else (bellman.optimal_block, chance.uniform, x[:, 0], out[:, 0])
        )
        out[-1] = 0.0
        _shared(
            lambda start, stop: kernel(*tables, weights, select.sign, x_, out_, actions, start, stop), self.num_states
        )

    def sweep(self, equation: BellmanEquation, x: np.ndarray) -> float:
        rewards, gamma, chance, select = equation
        tables = (self.next_states, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        if isinstance(select, PolicyTable):
            if chance.is_sticky:
                scratch = np.empty(self.num_actions)
                return bellman.sticky_policy_sweep(*tables, chance.triple, select.later, x, scratch)
            weights = (float(chance.chosen), float(chance.uniform))
            return bellman.policy_sweep(*tables, *weights, select.later[:, 0], x[:, 0])
        assert isinstance(select, Extreme)
        if chance.is_sticky:
            return bellman.sticky_sweep(*tables, chance.triple, select.sign, x, actions, np.empty(self.num_actions))
        return bellman.optimal_sweep(*tables, chance.uniform, select.sign, x[:, 0], actions)

    def move(self, play: Play, now: np.ndarray, after: np.ndarray) -> float:
        if now.shape[1] != after.shape[1]:  # the first step of sticky actions
            return super().move(play, now, after)
        return occupancy.push(self.next_states, play.live, play.policy, play.chance.triple, now, after)

    def settle(self, play: Play, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        weights = play.chance.triple
        return occupancy.settle(self.next_states, play.live, play.policy, weights, gamma, least, waiting, visits)

    def support(self, play: Play, reached: np.ndarray) -> None:
        occupancy.support(self.next_states, play.live, play.policy, play.chance.triple, reached)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        met = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        met[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, following = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.next_states, now, count, following, met)
            now, following = following, now
            level += 1
        return met

    def longest_path(self, live: np.ndarray) -> int:
        return int(paths.longest_path_of_table(self.next_states, live))


class Matrices(Dynamics):
    """Any number of outcomes, as a sparse matrix.

    Attributes:
        transitions: (S A, S) CSR float64, row s A + a; what a row lacks to 1 is the probability that the episode ends.
    """

    def __init__(self, transitions: "csr_matrix", num_actions: int):
        from scipy import sparse

        self.transitions = sparse.csr_matrix(transitions)
        if not self.transitions.data.all():
            self.transitions = self.transitions.copy()
            self.transitions.eliminate_zeros()
        self.num_states, self.num_actions = transitions.shape[1], num_actions
        counts = np.diff(self.transitions.indptr)
        sums = np.asarray(self.transitions.sum(axis=1)).ravel()
        self.operations = int(counts.max(initial=0)) + 1
        self.mass = max(1.0, float(sums.max(initial=0.0)) * (1 + self.operations * 2.0**-53))
        self._ends = np.maximum(1 - sums, 0.0)
        self.has_ends = bool((self._ends >= _SURE_END).any())
        self.is_deterministic = bool(((counts == 0) | ((counts == 1) & (sums == 1.0))).all())
        self._table: np.ndarray | None = None
        self._columns_by_action: Any = None

    @property
    def _by_action(self) -> "csr_matrix":
        """(S A, S A): the transitions into pairs of a next state and the action that led there."""
        from scipy import sparse

        if self._columns_by_action is None:
            matrix = self.transitions
            action = np.repeat(np.arange(len(matrix.indptr) - 1) % self.num_actions, np.diff(matrix.indptr))
            columns = matrix.indices.astype(np.int64) * self.num_actions + action
            size = matrix.shape[0]
            self._columns_by_action = sparse.csr_matrix((matrix.data, columns, matrix.indptr), shape=(size, size))
        return self._columns_by_action

    def arrays(self) -> dict[str, np.ndarray]:
        matrix = self.transitions
        names = ("transitions_data", "transitions_indices", "transitions_indptr")
        return dict(zip(names, (matrix.data, matrix.indices, matrix.indptr), strict=True))

    def deterministic_table(self) -> np.ndarray | None:
        if self._table is None and self.is_deterministic:
            table = np.full(self.num_states * self.num_actions, -1, np.int64)
            table[np.diff(self.transitions.indptr) > 0] = self.transitions.indices
            self._table = _as_indices(table.reshape(self.num_states, self.num_actions), self.num_states)
        return self._table

    def expected(self, x: np.ndarray, states: Any = slice(None)) -> np.ndarray:
        by_action = x.ndim > 1 and x.shape[1] > 1
        matrix = self._by_action if by_action else self.transitions
        ends: Any = self._ends
        rows = self._rows(states)
        if rows is not None:
            matrix, ends = matrix[rows], ends[rows]
        trailing = x.shape[2:]
        flat = x[:-1].reshape((matrix.shape[1], -1) if trailing else (matrix.shape[1],))
        result = matrix @ flat
        last = x[-1] if x.ndim > 1 else x[-1:]
        result = np.asarray(result).reshape(-1, self.num_actions, *trailing)
        if last.any():
            result = result + ends.reshape(-1, self.num_actions, *(1,) * len(trailing)) * last
        return result

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        matrix = self._by_action if width > 1 else self.transitions
        return np.asarray(matrix.T @ mass.ravel()).reshape(self.num_states, width)

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        rows = np.asarray(states) * self.num_actions + actions
        part = self.transitions[rows]
        which = np.repeat(np.arange(len(rows)), np.diff(part.indptr))
        following, probabilities = part.indices.astype(np.int64), part.data
        ended = np.flatnonzero(self._ends[rows] >= _SURE_END)
        if len(ended):
            which = np.append(which, ended)
            following = np.append(following, np.full(len(ended), self.num_states))
            probabilities = np.append(probabilities, self._ends[rows][ended])
            order = np.argsort(which, kind="stable")
            which, following, probabilities = which[order], following[order], probabilities[order]
        return Outcomes(which, following, probabilities)

    def restricted_to(self, states: np.ndarray) -> "Matrices":
        """These states alone; what leads out of them ends."""
        return Matrices(self.transitions[self._rows(states)][:, states].tocsr(), self.num_actions)

    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Matrices":
        return Matrices(self.to_classes(classes, len(representatives))[self._rows(representatives)], self.num_actions)

    def _rows(self, states: Any) -> np.ndarray | None:
        """The rows of some states; None: all."""
        if isinstance(states, slice) and states == slice(None):
            return None
        chosen = np.arange(self.num_states)[states]
        return (chosen[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()


def _as_indices(table: np.ndarray, num_states: int) -> np.ndarray:
    return np.ascontiguousarray(table, np.int32 if num_states < 2**31 else np.int64)


def _shared(block: Callable[[int, int], None], num_states: int) -> None:
    """block(start, stop) over all states, on all processors where there are enough states to share."""
    from pharos.workers import usable_workers

    workers = usable_workers(None) if num_states >= 1 << 16 else 1
    if workers == 1:
        return block(0, num_states)
    cuts = [num_states * i // workers for i in range(workers + 1)]
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, cuts[:-1], cuts[1:]))
