"""What executing an action does, whatever the transitions are stored as.

`Dynamics` asks and answers in the terms of mathematics: expectations, their adjoint, what can follow. It knows no
chance of choosing, no policy and no terminal states; a `BellmanEquation` brings them along where a whole backup is
wanted.

A way of storing transitions is one class: `Table` (table.py), `OutcomeTable` (also there). It needs the methods
that are abstract here, four attributes, and arrays that kernels/outcomes.py can read: all loops are compiled, each
written once for all of them. docs/decisions/0008-one-operator.md says why, and where the next class goes.

States are numbered 0 .. S - 1; S stands for the end of an episode, which has no value and no successors.

Runs: some rows of a range, as a few contiguous stretches of it.
"""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pharos.errors import ParameterError
from pharos.kernels import bellman, graph, occupancy, outcomes
from pharos.mdp.actions import Chance, Extreme, PolicyTable, Selection, States
from pharos.mdp.rewards import Rewards
from pharos.system.arrays import Indices, room_for_indices
from pharos.system.memory import pieces_from_the_end, rows_with_room

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Blocks = Callable[[], Iterator[tuple[int, np.ndarray]]]


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

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
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


class TopologicalOrder(NamedTuple):
    """An order of states in which each comes before those that it may lead to.

    Attributes:
        states: (S,) all of them; None where it is that of their numbers.
        longest: the steps of the longest way through them, or more.
    """

    states: np.ndarray | None
    longest: int


class StronglyConnected(NamedTuple):
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
    """

    num_states: int
    num_actions: int
    operations: int
    mass: float
    is_deterministic: bool
    has_ends: bool
    laziness: float = 0.0
    workers: int | None = None

    # What each representation says of itself --------------------------------------------------------------------------

    @abstractmethod
    def expected(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A, ...): E x(next) of executing each action in some states (indices or a slice).

        Args:
            x: (S + 1,), a value for each state, row S for the end; or (S + 1, W, ...), W = A by the action that led
                there, or 1.
        """

    @property
    @abstractmethod
    def for_kernels(self) -> object:
        """The argument `transitions` of kernels, see kernels/outcomes.py."""

    @property
    def for_sweeps(self) -> object:
        """The same for the loops in which solvers spend their time: what the compiler knows more of."""
        return self.for_kernels

    @abstractmethod
    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(index of the execution, next state or -1, probability > 0) of all outcomes of executions (N,), in order."""

    @abstractmethod
    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N,): a next state of each execution, -1 for the end. Draws nothing where each has one outcome."""

    @abstractmethod
    def restricted_to(self, states: np.ndarray) -> "Dynamics":
        """These states alone, ascending, with new numbers. What leads out of them is not right any more."""

    @abstractmethod
    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Dynamics":
        """The dynamics of classes (S,) of states, each behaving as its representative (C,)."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """What it is made of, by name, as files keep it."""

    @abstractmethod
    def part(self, start: int, stop: int) -> "tuple[Dynamics, np.ndarray]":
        """The states [start, stop) alone, and the states outside that they may lead to; numbers as `Part` says."""

    def deterministic_table(self) -> Indices | None:
        """(S, A) next states, -1 for the end, where each execution has one outcome; else None."""
        return None

    @property
    def has_chance(self) -> bool:
        """Whether an action that has an effect may have several outcomes."""
        return not self.is_deterministic

    # What follows from it ---------------------------------------------------------------------------------------------

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray, runs: np.ndarray | None = None) -> None:
        """out = T x; x and out are not the same. Between the states and the end there may be others, of a part.

        runs: the states of some runs (R, 2) alone, see `runs_of`; None: all.
        """
        rewards, gamma, chance, select = equation
        choice = _choice(select)
        out[-1] = 0.0
        if choice is None:
            states = slice(None) if runs is None else slice(*runs[0]) if len(runs) == 1 else rows_of(runs)
            q = rewards.rows(states) + gamma * self.expected(x, states)
            out[: self.num_states][states] = equation.value(q, states)
            return
        kernel, weights, x_, out_ = (
            (bellman.sticky_backup, chance.triple, x, out)
            if chance.is_sticky
            else (bellman.optimal_backup, chance.uniform, x[:, 0], out[:, 0])
        )
        tables = (self.for_sweeps, rewards.table, rewards.palette, gamma)
        arrays = (*tables, weights, choice, x_, out_, bellman.actions_of(self.num_actions))
        whole = np.array([[0, self.num_states]])
        _shared(lambda part: kernel(*arrays, part), self, whole if runs is None else runs)

    def sweep(
        self, equation: BellmanEquation, x: np.ndarray, threads: int = 1, part: tuple[int, int] | None = None
    ) -> float:
        """Replace each entry of x by its backup, from entries that are old or already new; once each.

        Args:
            threads: that may share the entries; which of two is first is theirs then, so that x is not the same to the
                last bit in every run.
            part: the states [start, stop) alone.
        Returns the largest change.
        """
        return swept(self.for_sweeps, self.num_actions, equation, x, None, threads, part)

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: TopologicalOrder) -> None:
        """Replace each entry of x by its backup, from the last state of an order to the first: the fixed point."""
        swept(self.for_sweeps, self.num_actions, equation, x, order.states)

    def move(self, play: PolicyStep, now: np.ndarray, after: np.ndarray) -> float:
        """after (S, W) = the mass now (S, W') one step later, without what has ended.

        Returns the sum over live states.
        """
        return occupancy.push(self.for_kernels, play.live, play.policy, play.chance.triple, now, after)

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        """(S, W): where the mass (S, A) of executed actions goes, without what ends; W = A by executed action, or 1.

        The adjoint of `expected`: sum(mass * expected(x)) = sum(pushed(mass) * x) where x is 0 at the end.
        """
        after = np.zeros((self.num_states, width))
        outcomes.pushed(self.for_kernels, np.ascontiguousarray(mass, np.float64), after)
        return after

    def settle(self, play: PolicyStep, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        """Count the waiting mass (S, W) as visits (S, W) and move it on, discounted. Returns what waits afterwards.

        Masses below `least` may stay.
        """
        weights = play.chance.triple
        return occupancy.settle(self.for_kernels, play.live, play.policy, weights, gamma, least, waiting, visits)

    def support(self, play: PolicyStep, reached: np.ndarray) -> None:
        """Set reached (S, W), 1 where mass may be and else 0, to 1 wherever it may come to."""
        occupancy.support(self.for_kernels, play.live, play.policy, play.chance.triple, reached)

    def entries_of(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`entries` of each action in each of some states; the first is i A + a."""
        return self.entries(*self._all_actions(states))

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        """What executing actions (N,) in states (N,) may lead to: ascending by next state, each of them once."""
        from scipy import sparse

        which, following, probabilities = self.entries(states, actions)
        small = np.int32 if max(len(following), self.num_states + 1) < 2**31 else np.int64
        columns = np.where(following < 0, self.num_states, following).astype(small)
        indptr = np.append(0, np.cumsum(np.bincount(which, minlength=len(states)))).astype(small)
        matrix = sparse.csr_matrix((probabilities, columns, indptr), shape=(len(states), self.num_states + 1))
        matrix.sum_duplicates()
        which = np.repeat(np.arange(len(states)), np.diff(matrix.indptr))
        return Outcomes(which, matrix.indices.astype(np.int64), matrix.data)

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        """The states that some action may lead to from some of these, ascending; S stands for the end."""
        following = self.entries_of(states)[1]
        return np.unique(np.where(following < 0, self.num_states, following))

    def largest(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A): the largest of x (S + 1,) over what executing an action may lead to."""
        return self._extreme(x, states, 1.0)

    def smallest(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A): the smallest of x (S + 1,) over what executing an action may lead to."""
        return self._extreme(x, states, -1.0)

    def _extreme(self, x: np.ndarray, states: States, sign: float) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        out = np.empty((len(rows), self.num_actions))
        outcomes.largest(self.for_kernels, np.ascontiguousarray(x, np.float64), rows, sign, out)
        return out

    def leads_to(self, state: int) -> np.ndarray:
        """(S, A) bool: whether executing an action may lead to a state."""
        indicator = np.zeros(self.num_states + 1)
        indicator[state] = 1.0
        return self.expected(indicator) > 0

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        """(S,) bool: the states that can be met within `steps` steps (None: any number) from the start states."""
        is_reached = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        is_reached[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, following = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.for_kernels, now, count, following, is_reached)
            now, following = following, now
            level += 1
        return is_reached

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        """(S, A) bool: whether executing action a in some of these states may lead to s."""
        result = np.zeros((self.num_states, self.num_actions), np.bool_)
        outcomes.arrive(self.for_kernels, np.asarray(states), result)
        return result

    def components(self, live: np.ndarray, least: int) -> StronglyConnected:
        """The strongly connected components of the states, of which live ones (S,) bool lead on.

        Args:
            least: small components with cycles are put together until a group has as many states.
        Cost: one look at each transition, and 33 bytes a state.
        """
        from pharos.kernels import bellman  # which few need

        dtype = np.int32 if self.num_states < 2**31 else np.int64
        number, path, waiting = (np.empty(self.num_states, dtype) for _ in range(3))
        count = bellman.number_components(self.for_kernels, live, number, path, waiting)
        first, is_cyclic = np.zeros(count + 1, np.int64), np.zeros(count, np.bool_)
        order = np.empty(self.num_states, np.int64)
        bellman.component_order(self.for_kernels, live, number, first, is_cyclic, order)
        largest = int(np.diff(first).max(initial=0, where=is_cyclic))
        starts, has_cycle = bellman.joined(first, is_cyclic, least)
        return StronglyConnected(order, starts, has_cycle, count, largest)

    def settle_components(
        self,
        equation: BellmanEquation,
        x: np.ndarray,
        parts: StronglyConnected,
        target: float,
        settled: float,
        most: float,
    ) -> None:
        """Sweep x group by group of `components`, from the last to the first, until each is settled.

        Args:
            target: a sweep of a group changes it by at most as much in the end, or by `settled` times its values.
            most: backups, after which each group that is left is swept once.
        """
        choice, before = _choice(equation.select), float(max(x.max(), -x.min()))
        if choice is not None and not equation.chance.is_sticky:
            from pharos.kernels import bellman

            tables = (self.for_sweeps, equation.rewards.table, equation.rewards.palette, equation.gamma)
            actions, chance = bellman.actions_of(self.num_actions), equation.chance.uniform
            groups = (parts.order, parts.starts, parts.has_cycle)
            bellman.settle(*tables, chance, choice, x[:, 0], actions, *groups, target, settled, most, before)
            return
        for group in range(len(parts.has_cycle) - 1, -1, -1):
            start, stop = int(parts.starts[group]), int(parts.starts[group + 1])
            change, largest = math.inf, before
            while change > max(target, settled * largest):
                change = swept(self.for_sweeps, self.num_actions, equation, x, parts.order, part=(start, stop))
                largest += change
                most -= stop - start
                if most < 0 or not parts.has_cycle[group]:
                    break

    def order(self, live: np.ndarray) -> TopologicalOrder | None:
        """An order of states in which each live one (S,) bool stands before those it leads to; None: there is none."""
        states = None
        if bellman.is_increasing(self.for_kernels, live, None)[0] >= 0:
            states = bellman.topological_order(self.for_kernels, live)
            if len(states) < self.num_states:
                return None
        return TopologicalOrder(states, int(bellman.longest_path(self.for_kernels, live, states)))

    def check_age(self, live: np.ndarray, age: np.ndarray) -> None:
        """ParameterError unless each transition of a live state (S,) bool leads to one of larger age (S,)."""
        s, a, t = bellman.is_increasing(self.for_kernels, live, age)
        if s >= 0:
            raise ParameterError(
                f"age: state {s}, of age {age[s]}, leads by action {a} to state {t}, of age {age[t]}; expected more"
            )

    def matrix(self, live: np.ndarray | None = None) -> "csr_matrix":
        """(S A, S + 1): the probabilities of all outcomes, row s A + a, column S for the end.

        Rows of states that are not live are empty.
        """
        from scipy import sparse

        states = np.arange(self.num_states) if live is None else np.flatnonzero(live)
        rows, actions = self._all_actions(states)
        entries = self.outcomes(rows, actions)
        row = (rows * self.num_actions + actions)[entries.which]
        counts = np.bincount(row, minlength=self.num_states * self.num_actions)
        indptr = np.concatenate([[0], np.cumsum(counts)])
        shape = (self.num_states * self.num_actions, self.num_states + 1)
        return sparse.csr_matrix((entries.probabilities, entries.states, indptr), shape=shape)

    def _all_actions(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each state with each action."""
        return np.repeat(states, self.num_actions), np.tile(np.arange(self.num_actions), len(states))


# Sweeps ---------------------------------------------------------------------------------------------------------------


def swept(
    transitions: object,
    num_actions: int,
    equation: BellmanEquation,
    x: np.ndarray,
    order: np.ndarray | None,
    threads: int = 1,
    part: tuple[int, int] | None = None,
) -> float:
    """Replace each entry of x by its backup, from the last state of an order to the first; the largest change.

    Args:
        threads: each has a part of the states, where that is possible.
        part: the places [start, stop) of the order that are swept; None: all.
    """
    rewards, gamma, chance, select = equation
    others = (rewards.table, rewards.palette, gamma)
    tables = (transitions, *others)
    actions, scratch = bellman.actions_of(num_actions), np.empty(num_actions)
    choice, places = _choice(select), part or (0, rewards.shape[0])
    if choice is None:
        assert isinstance(select, PolicyTable)
        if chance.is_sticky:
            return bellman.sticky_policy_sweep(*tables, chance.triple, select.later, x, scratch, order, *places)
        weights = (float(chance.chosen), float(chance.uniform))
        return bellman.policy_sweep(*tables, *weights, select.later[:, 0], x[:, 0], order, *places)
    if chance.is_sticky:
        return bellman.sticky_sweep(*tables, chance.triple, choice, x, actions, scratch, order, *places)
    v, border = x[:, 0], rows_with_room(transitions, *places)

    def change_of(low: int, high: int) -> float:
        change = 0.0
        for piece, start, stop in pieces_from_the_end(transitions, low, high, border):
            largest = bellman.optimal_sweep(piece, *others, chance.uniform, choice, v, actions, order, start, stop)
            change = float(np.maximum(change, largest))
        return change

    low, high = places
    cuts = [low + (high - low) * i // threads for i in range(threads + 1)]
    if threads == 1:
        return change_of(*cuts)
    with ThreadPoolExecutor(threads) as pool:
        return float(np.max([*pool.map(change_of, cuts[:-1], cuts[1:])]))


def _choice(select: Selection) -> "float | np.ndarray | None":
    """The argument `choice` of kernels; None for policies that draw actions, or look back."""
    if isinstance(select, Extreme):
        return select.sign
    assert isinstance(select, PolicyTable)
    return None if select.actions is None else np.ascontiguousarray(select.actions, np.int64)


def _shared(block: Callable[[np.ndarray], None], dynamics: Dynamics, runs: np.ndarray) -> None:
    """block(part) over the states of runs (R, 2), on all processors where there are enough states to share."""
    from pharos.system.workers import usable_workers

    workers = usable_workers(dynamics.workers) if count_of(runs) >= 1 << 16 else 1
    if workers == 1:
        return block(runs)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, shares_of(runs, workers)))


# Parts ----------------------------------------------------------------------------------------------------------------


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
