"""Transition dynamics of executed actions, independent of how transitions are stored.

`Dynamics` has the operations of mathematics: expectations, their adjoint, possible successors. It knows no chance of
choosing, no policy and no terminal states. A `BellmanEquation` supplies them for a whole backup.

A way of storing transitions is one class: `Table` (table.py), `OutcomeTable` (also there). It needs the methods
that are abstract here, four attributes, and arrays that kernels/outcomes.py can read: all loops are compiled, each
written once for all of them. See docs/decisions/0008-one-operator.md for the reasons, and the place of a new class.

States are numbered 0 .. S - 1. S stands for the end of an episode, which has no value and no successors.

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
from pharos.system.arrays import Indices, read_only, room_for_indices
from pharos.system.memory import pieces_from_the_end, rows_with_room

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Blocks = Callable[[], Iterator[tuple[int, np.ndarray]]]


class BellmanEquation(NamedTuple):
    """The Bellman equation x = T x of values, without the dynamics.

        (T x)(s, b) = chance of choice in q(s, .),   q(s, a) = r(s, a) + gamma E x(next, a)

    x is (S + 1, W) float64: V(s, b) by the previously executed action b under sticky actions (W = A), else V(s) (W =
    1). Row S, the end, is 0.
    """

    rewards: Rewards
    gamma: float
    chance: Chance
    select: Selection

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, W), from the values of executing each action in some states (N, A)."""
        return self.chance.at(states).choice(q, self.select.value(q, states))


class PolicyStep(NamedTuple):
    """One step of play: policy and chance that move the mass of live states, those in which play goes on."""

    live: np.ndarray  # (S,) bool
    policy: np.ndarray  # (S, B, A)
    chance: Chance


class Outcomes(NamedTuple):
    """Possible outcomes of N executions: pairs of a state and an executed action.

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
        states: (S,) all of them, or None if they are in the order of their numbers.
        longest: the steps of the longest way through them, or more.
    """

    states: np.ndarray | None
    longest: int


class StronglyConnected(NamedTuple):
    """Strongly connected components of the states, in an order in which each stands before those that it leads to.

    Attributes:
        order: (S,) the states, component by component.
        starts: (G + 1,) the indices in the order at which groups of neighbouring components begin.
        has_cycle: (G,) whether a state of a group can be visited again.
        total: how many components there are. largest: the states of the largest one that has a cycle.
    """

    order: np.ndarray
    starts: np.ndarray
    has_cycle: np.ndarray
    total: int
    largest: int


class Dynamics(ABC):
    """Transition dynamics of executed actions, for S states and A actions.

    Attributes:
        operations: the rounding operations, at most, of one expectation.
        mass: the largest sum of the probabilities of a row, at least 1.
        is_deterministic: whether executing an action has one outcome, everywhere.
        has_ends: whether some execution ends the episode without a next state.
        laziness: probability that nothing happens, as far as `lazy` has added it.
        workers: threads of a backup, if it has several. None for all processors.
        is_of_many: whether these are some states of an MDP with so many that its sweeps are unrolled.
    """

    num_states: int
    num_actions: int
    operations: int
    mass: float
    is_deterministic: bool
    has_ends: bool
    laziness: float = 0.0
    workers: int | None = None
    is_of_many: bool = False

    # Of each representation ------------------------------------------------------------------------------------------

    @abstractmethod
    def expected(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A, ...): E x(next) of executing each action in some states (indices or a slice).

        Args:
            x: (S + 1,), a value for each state, row S for the end. Or (S + 1, W, ...), W = A by the action that led
                there, or 1.
        """

    @property
    @abstractmethod
    def for_kernels(self) -> object:
        """The argument `transitions` of kernels, see kernels/outcomes.py."""

    @property
    def for_steps(self) -> object:
        """The argument `transitions` of kernels that play: a table of next states if each execution has one outcome."""
        table = self.deterministic_table()
        return self.for_kernels if table is None else read_only(table)

    @property
    def is_unrolled(self) -> bool:
        """Whether sweeps are compiled for the very numbers of actions and outcomes, see `kernels.outcomes`."""
        return self.is_of_many or outcomes.is_unrolled(self.num_states)

    @property
    def for_sweeps(self) -> object:
        """The argument `transitions` of sweeps, in types that let the compiler make them faster."""
        return self.for_kernels

    @abstractmethod
    def entries(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(index of the execution, next state or -1, probability > 0) of all outcomes of executions (N,), in order."""

    @abstractmethod
    def sample(self, states: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N,): a next state of each execution, -1 for the end. Draws nothing if each has one outcome."""

    @abstractmethod
    def _restricted_to(self, states: np.ndarray) -> "Dynamics": ...

    @abstractmethod
    def merged(self, classes: np.ndarray, representatives: np.ndarray) -> "Dynamics":
        """The dynamics of classes (S,) of states, each behaving as its representative (C,)."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of this representation by name, as files keep them."""

    @abstractmethod
    def part(self, start: int, stop: int) -> "tuple[Dynamics, np.ndarray]":
        """The dynamics of the states [start, stop), numbered as in `Part`, and the outside states they may lead to.

        Backups and expectations take values of these states too. No other operation knows of them: call `matrix`,
        `merged` and `restricted_to` on the whole.
        """

    def deterministic_table(self) -> Indices | None:
        """(S, A) next states, -1 for the end, if each execution has one outcome, else None."""
        return None

    @property
    def has_chance(self) -> bool:
        """Whether an action that has an effect may have several outcomes."""
        return not self.is_deterministic

    # Derived operations -----------------------------------------------------------------------------------------------

    def restricted_to(self, states: np.ndarray) -> "Dynamics":
        """The dynamics of these states alone, ascending and renumbered. Transitions that leave them are replaced.

        Their sweeps are compiled as sweeps of all states are: who asks for many such parts has a large MDP.
        """
        part = self._restricted_to(states)
        part.is_of_many = self.is_unrolled
        return part

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray, runs: np.ndarray | None = None) -> None:
        """Set out to T x, out not x itself. Between the rows of the states and the end there may be the rows of a halo.

        runs: the states of some runs (R, 2) alone, see `runs_of`. None: all.
        """
        rewards, gamma, chance, select = equation
        choice = _choice(select)
        arrays: tuple[object, ...] = (self.for_sweeps, *rewards.for_kernels, gamma)
        x_, out_ = (x, out) if chance.is_sticky else (x[:, 0], out[:, 0])
        out[-1] = 0.0
        if choice is None:
            assert isinstance(select, PolicyTable)
            kernel = bellman.sticky_policy_backup if chance.is_sticky else bellman.policy_backup
            arrays += chance.for_kernels, select.later if chance.is_sticky else select.later[:, 0]
        else:
            kernel = bellman.sticky_backup if chance.is_sticky else bellman.optimal_backup
            weights = chance.for_kernels if chance.is_sticky else chance.uniform_for_kernels
            arrays += weights, choice
        arrays += x_, out_, bellman.actions_of(self.num_actions, self.is_unrolled)
        whole = np.array([[0, self.num_states]])

        def block(part: np.ndarray) -> None:
            scratch = (np.empty(self.num_actions),) if chance.is_sticky else ()
            kernel(*arrays, *scratch, part)

        _shared(block, self, whole if runs is None else runs)

    def sweep(
        self, equation: BellmanEquation, x: np.ndarray, threads: int = 1, part: tuple[int, int] | None = None
    ) -> float:
        """Replace each entry of x by its backup, from entries that are old or already new, once each.

        Args:
            threads: that may share the entries. Their order is then left to chance, so that x is not the same to the
                last bit in every run.
            part: the states [start, stop) alone.
        Returns the largest change.
        """
        return swept(self.for_sweeps, self.num_actions, equation, x, None, threads, part)

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: TopologicalOrder) -> None:
        """Set x to the fixed point: replace each entry by its backup, from the last state of an order to the first."""
        swept(self.for_sweeps, self.num_actions, equation, x, order.states)

    def step_distribution(self, step: PolicyStep, now: np.ndarray, after: np.ndarray) -> float:
        """Set after (S, W) to the mass now (S, W') one step later, without the mass of ended episodes.

        Returns the sum over live states.
        """
        return occupancy.push(self.for_kernels, step.live, step.policy, step.chance.for_kernels, now, after)

    def push_forward(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        """(S, W): the mass (S, A) of executed actions one step later, without what ends. W = A by that action, or 1.

        The adjoint of `expected`: sum(mass * expected(x)) = sum(push_forward(mass) * x) if x is 0 at the end.
        """
        after = np.zeros((self.num_states, width))
        outcomes.push_forward(self.for_kernels, np.ascontiguousarray(mass, np.float64), after)
        return after

    def accumulate_visits(
        self, step: PolicyStep, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray
    ) -> float:
        """Add the waiting mass (S, W) to visits (S, W) and move it on, discounted. Return the mass that waits then.

        Masses below `least` may stay.
        """
        weights = step.chance.for_kernels
        return occupancy.count_visits(self.for_kernels, step.live, step.policy, weights, gamma, least, waiting, visits)

    def support(self, step: PolicyStep, reachable: np.ndarray) -> None:
        """Grow reachable (S, W), 1 if there is mass and else 0, to all that the mass may reach in some steps."""
        occupancy.support(self.for_kernels, step.live, step.policy, step.chance.for_kernels, reachable)

    def entries_of(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`entries` of each action in each of some states. The first is i A + a."""
        return self.entries(*self._all_actions(states))

    def outcomes(self, states: np.ndarray, actions: np.ndarray) -> Outcomes:
        """The outcomes of executing actions (N,) in states (N,), ascending by next state, each of which comes once."""
        from scipy import sparse

        which, next_states, probabilities = self.entries(states, actions)
        small = np.int32 if max(len(next_states), self.num_states + 1) < 2**31 else np.int64
        columns = np.where(next_states < 0, self.num_states, next_states).astype(small)
        indptr = np.append(0, np.cumsum(np.bincount(which, minlength=len(states)))).astype(small)
        matrix = sparse.csr_matrix((probabilities, columns, indptr), shape=(len(states), self.num_states + 1))
        matrix.sum_duplicates()
        which = np.repeat(np.arange(len(states)), np.diff(matrix.indptr))
        return Outcomes(which, matrix.indices.astype(np.int64), matrix.data)

    def successors_of(self, states: np.ndarray) -> np.ndarray:
        """The states that some action may lead to from some of these, ascending. S stands for the end."""
        next_states = self.entries_of(states)[1]
        return np.unique(np.where(next_states < 0, self.num_states, next_states))

    def largest(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A): the largest of x (S + 1,) over the possible next states of each action."""
        return self._extreme(x, states, 1.0)

    def smallest(self, x: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, A): the smallest of x (S + 1,) over the possible next states of each action."""
        return self._extreme(x, states, -1.0)

    def _extreme(self, x: np.ndarray, states: States, sign: float) -> np.ndarray:
        rows = np.arange(self.num_states)[states]
        out = np.empty((len(rows), self.num_actions))
        outcomes.extreme_outcomes(self.for_kernels, np.ascontiguousarray(x, np.float64), rows, sign, out)
        return out

    def leads_to(self, state: int) -> np.ndarray:
        """(S, A) bool: whether executing an action may lead to a state."""
        indicator = np.zeros(self.num_states + 1)
        indicator[state] = 1.0
        return self.expected(indicator) > 0

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        """(S,) bool: the states that can be reached within `steps` steps (None: any number) from the start states."""
        is_reached = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        is_reached[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, after = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.for_kernels, now, count, after, is_reached)
            now, after = after, now
            level += 1
        return is_reached

    def arrivals(self, states: np.ndarray) -> np.ndarray:
        """(S, A) bool: whether executing action a in some of these states may lead to s."""
        result = np.zeros((self.num_states, self.num_actions), np.bool_)
        outcomes.mark_arrivals(self.for_kernels, np.asarray(states), result)
        return result

    def components(self, live: np.ndarray, least: int) -> StronglyConnected:
        """The strongly connected components of the states, of which live ones (S,) bool lead on.

        Args:
            least: small components with cycles are put together until a group has as many states.
        Cost: one read of each transition, and 33 bytes a state.
        """
        from pharos.kernels import bellman, end_components  # which few need

        dtype = np.int32 if self.num_states < 2**31 else np.int64
        number, path, waiting = (np.empty(self.num_states, dtype) for _ in range(3))
        count = end_components.number_components(self.for_kernels, None, live, None, number, path, waiting)
        first, is_cyclic = np.zeros(count + 1, np.int64), np.zeros(count, np.bool_)
        order = np.empty(self.num_states, np.int64)
        bellman.component_order(self.for_kernels, live, number, first, is_cyclic, order)
        largest = int(np.diff(first).max(initial=0, where=is_cyclic))
        starts, has_cycle = bellman.joined_components(first, is_cyclic, least)
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
            target: a group is settled once a sweep changes it by at most this, or by `settled` times the values.
            most: number of backups, after which each remaining group is swept once.
        """
        choice, before = _choice(equation.select), float(max(x.max(), -x.min()))
        if choice is not None and not equation.chance.is_sticky:
            from pharos.kernels import bellman

            tables = (self.for_sweeps, *equation.rewards.for_kernels, equation.gamma)
            actions, chance = (
                bellman.actions_of(self.num_actions, self.is_unrolled),
                equation.chance.uniform_for_kernels,
            )
            groups = (parts.order, parts.starts, parts.has_cycle)
            bellman.sweep_groups(*tables, chance, choice, x[:, 0], actions, *groups, target, settled, most, before)
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
        """An order of states in which each live one (S,) bool stands before those it leads to, or None if there is
        none."""
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
        """(states, actions) of all pairs of some states and an action."""
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
    """Replace each entry of x by its backup, from the last state of an order to the first. Return the largest change.

    Args:
        threads: each has a part of the states, if that is possible.
        part: the range [start, stop) of the order that are swept. None: all.
    """
    rewards, gamma, chance, select = equation
    others = (*rewards.for_kernels, gamma)
    tables = (transitions, *others)
    actions, scratch = bellman.actions_of(num_actions, rewards.is_unrolled), np.empty(num_actions)
    choice, bounds = _choice(select), part or (0, rewards.shape[0])
    if choice is None:
        assert isinstance(select, PolicyTable)
        if chance.is_sticky:
            return bellman.sticky_policy_sweep(
                *tables, chance.for_kernels, select.later, x, actions, scratch, np.empty(num_actions), order, *bounds
            )
        return bellman.policy_sweep(*tables, chance.for_kernels, select.later[:, 0], x[:, 0], actions, order, *bounds)
    if chance.is_sticky:
        return bellman.sticky_sweep(*tables, chance.for_kernels, choice, x, actions, scratch, order, *bounds)
    v, border = x[:, 0], rows_with_room(transitions, *bounds)

    def change_of(low: int, high: int) -> float:
        change = 0.0
        for piece, start, stop in pieces_from_the_end(transitions, low, high, border):
            largest = bellman.optimal_sweep(
                read_only(piece), *others, chance.uniform_for_kernels, choice, v, actions, order, start, stop
            )
            change = float(np.maximum(change, largest))
        return change

    low, high = bounds
    cuts = [low + (high - low) * i // threads for i in range(threads + 1)]
    if threads == 1:
        return change_of(*cuts)
    with ThreadPoolExecutor(threads) as pool:
        return float(np.max([*pool.map(change_of, cuts[:-1], cuts[1:])]))


def _choice(select: Selection) -> "float | np.ndarray | None":
    """The argument `choice` of kernels, or None for policies that are random, or depend on the previous action."""
    if isinstance(select, Extreme):
        return select.sign
    assert isinstance(select, PolicyTable)
    return None if select.actions is None else read_only(np.ascontiguousarray(select.actions, np.int64))


def _shared(block: Callable[[np.ndarray], None], dynamics: Dynamics, runs: np.ndarray) -> None:
    """block(part) over the states of runs (R, 2), on all processors if there are enough states to share."""
    from pharos.system.workers import usable_workers

    workers = usable_workers(dynamics.workers) if count_of(runs) >= 1 << 16 else 1
    if workers == 1:
        return block(runs)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, shares_of(runs, workers)))


# Parts ----------------------------------------------------------------------------------------------------------------


def as_indices(table: np.ndarray, num_states: int) -> np.ndarray:
    return np.ascontiguousarray(table, np.int32 if num_states < 2**31 else np.int64)


def part_with_halo(blocks: Blocks, shape: tuple[int, ...], start: int, stop: int) -> tuple[Indices, np.ndarray]:
    """(next states of a range renumbered for its part, int32 if that is enough, its halo).

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
    """(R, 2) int64: first row and end of each stretch of rows of which is_in (n,) bool holds, ascending.

    gap: stretches with fewer rows than that between them are one.
    """
    change = np.flatnonzero(np.diff(np.concatenate([[False], is_in, [False]]).astype(np.int8)))
    starts, stops = change[::2], change[1::2]
    is_apart = starts[1:] - stops[:-1] >= gap
    return np.stack([np.append(starts[:1], starts[1:][is_apart]), np.append(stops[:-1][is_apart], stops[-1:])], axis=1)


def runs_between(runs: np.ndarray, num_rows: int) -> np.ndarray:
    """(R, 2): the runs of the rows that are in none of `runs`."""
    edges = np.concatenate([[0], runs.reshape(-1), [num_rows]]).reshape(-1, 2)
    return edges[edges[:, 1] > edges[:, 0]]


def count_of(runs: np.ndarray) -> int:
    """Number of rows in runs (R, 2)."""
    return int((runs[:, 1] - runs[:, 0]).sum())


def shares_of(runs: np.ndarray, shares: int) -> list[np.ndarray]:
    """The runs (R, 2) cut into `shares` parts of equal numbers of rows, up to one, in order, without empty parts."""
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
