"""TabularMDP: next states, rewards, discount, start distribution, and chance that stays implicit.

Also the states of an MDP that can be reached from its start, and the pairs of a state and the action before.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.mdp.actions import Chance, PolicyTable, Selection
from pharos.mdp.arguments import (
    check_gamma,
    check_horizon,
    checked_next_states,
    start_of,
    terminal_states,
)
from pharos.mdp.dynamics import Dynamics, TopologicalOrder
from pharos.mdp.matrices import expected_rewards, transitions_of
from pharos.mdp.rewards import Rewards, expected_over_outcomes, rewards_of_shape
from pharos.mdp.row_sums import Residual
from pharos.mdp.table import (
    Lazy,
    Matrices,
    OutcomeTable,
    Table,
    checked_outcomes,
    compact_outcomes,
)
from pharos.system.arrays import Indices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from pharos.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A Markov decision process of S states and A actions.

    Made by `StateSpace.mdp`, `from_arrays`, `from_outcomes` or `from_matrices`; `sticky_actions`, `random_actions` and
    `lazy_actions` add chance.

    Attributes:
        dynamics: transitions of executed actions, the same interface for every way of storing them.
        reward_table: the rewards, compactly; `rewards` is the same as (S, A) float64.
        terminal: (S,) bool, the terminal states: they lead to themselves with reward 0 (or are whole rows of -1, reward
            0).
        gamma: discount, in [0, 1].
        horizon: number of steps T after which an episode ends, or None.
        start_states, start_probabilities: the start distribution.
        chance: weights of the chosen, the previously executed and a uniform action.
        folder: of the state space, where there is one.
        environment: the one that the states are of, where it is known.
        is_numbered: whether states have the numbers that they were given with; not after some were merged.
        age: (S,) integers that each transition out of a state that is not terminal makes larger; None where they are
            not known. Solvers take the states in this order then, once.
        residual: what the sums of rows that were given leave open, see mdp/row_sums.py; error bounds of values count
            it.
    """

    dynamics: Dynamics
    reward_table: Rewards
    terminal: np.ndarray
    gamma: float = 0.99
    horizon: int | None = None
    start_states: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))
    start_probabilities: np.ndarray = field(default_factory=lambda: np.ones(1))
    chance: Chance = field(default_factory=Chance)
    folder: Path | None = None
    age: np.ndarray | None = None
    staying: Callable[[], Rewards] | None = None
    environment: Environment | None = None
    residual: Residual = field(default_factory=Residual)
    is_numbered: bool = True

    def __new__(cls, dynamics: object = None, *_: object, **__: object) -> "TabularMDP":
        if isinstance(dynamics, np.ndarray | list | tuple):
            raise TypeError(
                "TabularMDP takes dynamics, not arrays; probabilities P and rewards R go to "
                "TabularMDP.from_matrices(P, R, gamma=0.99), next states to TabularMDP.from_arrays, "
                "outcomes to TabularMDP.from_outcomes"
            )
        return super().__new__(cls)

    def __post_init__(self) -> None:
        check_gamma(self.gamma)
        check_horizon(self.horizon)

    # Making one -------------------------------------------------------------------------------------------------------

    @staticmethod
    def from_arrays(
        next_states: npt.ArrayLike,
        rewards: npt.ArrayLike,
        *,
        gamma: float = 0.99,
        initial: npt.ArrayLike = 0,
        horizon: int | None = None,
        terminal: npt.ArrayLike | None = None,
    ) -> "TabularMDP":
        """A deterministic MDP from arrays.

        Args:
            next_states: (S, A) integers in [-1, S); -1 ends the episode after the transition's reward.
            rewards: (S, A) finite numbers.
            gamma: discount, in [0, 1].
            initial: a start state, a sequence of equally likely ones (fewer than S), or (S,) probabilities.
            horizon: number of steps of an episode, or None.
            terminal: (S,) bool, the terminal states, whose rows must lead to themselves (or be -1) with reward 0; None:
                the states whose whole row is -1 with reward 0.
        Raises:
            ParameterError: a shape, an index, a reward, gamma or the start distribution is wrong; the first such entry
                is named.
        """
        table = checked_next_states(next_states)
        reward_table = rewards_of_shape(rewards, table.shape)
        silent = (reward_table.array == 0).all(axis=1)
        own = np.arange(len(table), dtype=table.dtype)[:, None]
        stays = ((table == own) | (table == -1)).all(axis=1)
        mask = terminal_states(terminal, (table == -1).all(axis=1) & silent, stays & silent)
        states, probabilities = start_of(initial, len(table))
        return TabularMDP(Table(table), reward_table, mask, gamma, horizon, states, probabilities)

    @staticmethod
    def from_outcomes(
        successors: npt.ArrayLike,
        probabilities: npt.ArrayLike,
        rewards: npt.ArrayLike,
        *,
        gamma: float = 0.99,
        initial: npt.ArrayLike = 0,
        horizon: int | None = None,
        terminal: npt.ArrayLike | None = None,
    ) -> "TabularMDP":
        """An MDP in which each action has up to K outcomes, from arrays.

        Args:
            successors: (S, A, K) integers in [-1, S); -1 ends the episode after the transition's reward. Entries of
                probability 0 count for nothing.
            probabilities: (S, A, K) of the outcomes; each row sums to 1 within 1e-6, and is divided by its sum unless
                that is 1 up to rounding.
            rewards: (S, A) expected rewards; or (S, A, K), averaged.
            gamma, initial, horizon, terminal: as in `from_arrays`.
        Raises:
            ParameterError: as in `from_arrays`, or a probability is not in [0, 1] or a row does not sum to 1.
        """
        table, chances, residuals = checked_outcomes(successors, probabilities)
        means, largest = expected_over_outcomes(rewards, chances)
        mdp = TabularMDP.from_outcome_table(
            OutcomeTable(**compact_outcomes(table, chances)),
            means,
            gamma=gamma,
            initial=initial,
            horizon=horizon,
            terminal=terminal,
        )
        return replace(mdp, residual=Residual.of(residuals, largest))

    @staticmethod
    def from_outcome_table(
        dynamics: OutcomeTable,
        rewards: npt.ArrayLike | Rewards,
        *,
        gamma: float = 0.99,
        initial: npt.ArrayLike = 0,
        horizon: int | None = None,
        terminal: npt.ArrayLike | None = None,
    ) -> "TabularMDP":
        """An MDP on an existing table of outcomes, with expected rewards (S, A); see `from_outcomes`."""
        num_states = dynamics.num_states
        reward_table = rewards_of_shape(rewards, (num_states, dynamics.num_actions))
        silent = (reward_table.array == 0).all(axis=1)
        ends, stays = dynamics.ends_and_stays()
        mask = terminal_states(terminal, ends & silent, stays & silent)
        states, probabilities = start_of(initial, num_states)
        return TabularMDP(dynamics, reward_table, mask, gamma, horizon, states, probabilities)

    @staticmethod
    def from_matrices(
        P: object,
        R: npt.ArrayLike,
        *,
        gamma: float = 0.99,
        initial: npt.ArrayLike = 0,
        horizon: int | None = None,
        axes: str | None = None,
        ends: npt.ArrayLike = False,
    ) -> "TabularMDP":
        """A general MDP from transition probabilities.

        Args:
            P: a list of A matrices (S, S), dense or sparse, one an action; or an array (S, A, S) of probabilities
                P[s, a, t]; or a sparse (S A, S) matrix with rows s A + a. A row that sums to 1 within 1e-6 is divided
                by its sum unless that is 1 up to rounding; `residual` has what that may change, and error bounds of
                values count it.
            R: expected rewards (S, A); or (S,) for every action alike; or one for each transition, in any form of P,
                averaged over P.
            gamma, initial, horizon: as in `from_arrays`.
            axes: of arrays with three axes, "SAS" or "ASS" (also "SAS" of a list with one (A, S) matrix a state). It
                must be given for an array with as many actions as states, which has the shape of both.
            ends: whether a row that sums to less than 1 - 1e-6 ends the episode with the rest; or (S, A) probabilities
                of ending, which are then part of the sums of rows.
        Raises:
            ParameterError: shapes do not fit, or a probability or reward is out of range; or a row does not sum to 1:
                the message names the first one, and the likely reason.
        """
        matrix, num_actions, residuals = transitions_of(P, axes, ends)
        dynamics = Matrices(matrix, num_actions)
        shape = (dynamics.num_states, num_actions)
        means, residual = expected_rewards(matrix, R, axes, num_actions, residuals)
        reward_table = rewards_of_shape(means, shape)
        ended = np.asarray(matrix.sum(axis=1)).reshape(shape) <= 1e-12
        terminal = ended.all(axis=1) & (reward_table.array == 0).all(axis=1)
        states, probabilities = start_of(initial, dynamics.num_states)
        return TabularMDP(dynamics, reward_table, terminal, gamma, horizon, states, probabilities, residual=residual)

    @staticmethod
    def from_space(
        space: "StateSpace", rewards: Rewards, gamma: float = 0.99, staying: Callable[[], Rewards] | None = None
    ) -> "TabularMDP":
        """The MDP on the states of a state space, with their ages where the class declares one.

        `StateSpace.mdp` computes the rewards, and says how to compute those of staying.

        Raises:
            ParameterError: a transition leads to a state that is not older.
        """
        mdp = TabularMDP(
            space.dynamics,
            rewards,
            space.terminal,
            gamma,
            None,
            space.start_states,
            space.start_probabilities,
            folder=space.folder,
            staying=staying,
            environment=space.environment,
            residual=Residual() if space.environment is None else Residual(*space.environment.residual),
        )
        has_age = space.environment is not None and space.environment.has_age
        return mdp.with_age(space.ages) if has_age else mdp

    # What it is -------------------------------------------------------------------------------------------------------

    @property
    def num_states(self) -> int:
        """S."""
        return self.reward_table.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.reward_table.shape[1]

    @property
    def next_states(self) -> Indices | None:
        """(S, A) int32, int64 or `PackedIndices`, the next state of each action; -1: the episode ends.

        None where transitions are not stored so.
        """
        return getattr(self.dynamics, "next_states", None)

    @property
    def transitions(self) -> "csr_matrix | None":
        """(S A, S) sparse probabilities with rows s A + a.

        1 minus the sum of a row is the probability that the episode ends.

        None where transitions are not stored so.
        """
        return getattr(self.dynamics, "transitions", None)

    @property
    def rewards(self) -> np.ndarray:
        """(S, A) float64, expected rewards of executed actions."""
        return self.reward_table.array

    @property
    def initial(self) -> int | np.ndarray:
        """The start state, or (S,) probabilities where there are several."""
        if len(self.start_states) == 1:
            return int(self.start_states[0])
        distribution = np.zeros(self.num_states)
        distribution[self.start_states] = self.start_probabilities
        return distribution

    @property
    def is_sticky(self) -> bool:
        """Whether the state of the MDP is (state, previously executed action)."""
        return self.chance.is_sticky

    @property
    def is_random(self) -> bool:
        """Whether a uniform action is executed now and then."""
        return self.chance.is_random

    @property
    def laziness(self) -> float:
        """The probability that the executed action has no effect, see `lazy_actions`."""
        return self.dynamics.laziness

    @property
    def width(self) -> int:
        """W: values and distributions belong to (S, W) pairs; A previous actions under sticky actions, else 1."""
        return self.chance.width(self.num_actions)

    @property
    def policy_width(self) -> int:
        """Choices of a policy in each state: A + 1 under sticky actions, by the previous action, none last; else 1."""
        return self.num_actions + 1 if self.is_sticky else 1

    @property
    def nodes(self) -> str:
        """Name, in words, of the nodes that values and choices belong to."""
        return "pairs (state, previously executed action)" if self.is_sticky else "states"

    def without_width(self, x: np.ndarray) -> np.ndarray:
        """Values (..., W) in the shape for users: without the last axis, unless actions are sticky."""
        return x if self.is_sticky else x[..., 0]

    @property
    def is_deterministic(self) -> bool:
        """Whether every choice has one outcome."""
        return self.dynamics.is_deterministic and self.chance.is_none

    @property
    def has_ends(self) -> bool:
        """Whether some transition ends the episode without a next state."""
        return self.dynamics.has_ends

    # Reachable states -------------------------------------------------------------------------------------------------

    @property
    def starts(self) -> np.ndarray:
        """(K,) the states that an episode may start in, ascending."""
        return np.unique(self.start_states[self.start_probabilities > 0])

    def states_within(self, steps: int | None = None) -> np.ndarray:
        """(S,) bool: the states that some actions lead to within `steps` steps (None: any number) from a start."""
        return self.dynamics.reachable(self.starts, steps)

    def pairs_within(self, steps: int | None = None) -> np.ndarray:
        """(S, A) bool: pairs (state, previously executed action) that can be reached within `steps` steps of a start.

        Chance decides which actions can be executed after which: where every action is a repetition, that of the first
        step is executed always. Start states without a previous action are not among them.
        """
        is_reached = now = np.zeros((self.num_states, self.num_actions), np.bool_)
        if self.chance.executes_any:
            return (
                is_reached if steps == 0 else self._arrivals(self.states_within(None if steps is None else steps - 1))
            )
        lone, level = np.zeros(self.num_states, np.bool_), 0
        lone[self.starts] = True
        while (lone.any() or now.any()) and (steps is None or level < steps):
            now = self.nodes_after(now, lone) & ~is_reached
            is_reached, lone, level = is_reached | now, np.zeros_like(lone), level + 1
        return is_reached

    def nodes_within(self, steps: int | None = None) -> np.ndarray:
        """(S, W) bool: the nodes of values that can be reached within `steps` steps from a start: `pairs_within` under
        sticky actions, else `states_within`. Start states without a previous action are not among them."""
        return self.pairs_within(steps) if self.is_sticky else self.states_within(steps)[:, None]

    def nodes_after(self, nodes: np.ndarray, lone: np.ndarray) -> np.ndarray:
        """(S, W) bool: the nodes one step after nodes (S, W), or after start states `lone` (S,) with no action."""
        if nodes.shape[1] < self.num_actions or self.chance.executes_any:
            after = self._arrivals(nodes.any(axis=1) | lone)
            return after if nodes.shape[1] == self.num_actions else np.asarray(after.any(axis=1, keepdims=True))
        states, actions = np.nonzero(nodes & ~np.asarray(self.terminal)[:, None])  # every action is a repetition
        outcomes = self.dynamics.outcomes(states, actions)
        after = np.vstack([self._arrivals(lone), np.zeros_like(nodes[:1])])
        after[outcomes.states, actions[outcomes.which]] = True
        return after[:-1]

    def _arrivals(self, is_visited: np.ndarray) -> np.ndarray:
        """(S, A) bool: the pairs (state, executed action) one step after some states (S,) bool."""
        return self.dynamics.arrivals(np.flatnonzero(is_visited & ~np.asarray(self.terminal)))

    @property
    def lone_starts(self) -> np.ndarray:
        """(S,) bool: under sticky actions the start states, nodes of their own without a previous action."""
        lone = np.zeros(self.num_states, np.bool_)
        lone[self.starts] = self.is_sticky
        return lone

    # Variants ---------------------------------------------------------------------------------------------------------

    def with_gamma(self, gamma: float) -> "TabularMDP":
        """The same MDP with another discount."""
        return replace(self, gamma=gamma)

    def with_horizon(self, horizon: int | None) -> "TabularMDP":
        """The same MDP with another horizon."""
        return replace(self, horizon=horizon)

    def with_rewards(self, rewards: npt.ArrayLike) -> "TabularMDP":
        """The same MDP with other rewards, (S, A); those of terminal states must be 0."""
        table = rewards_of_shape(rewards, self.reward_table.shape)
        wrong = self.terminal[:, None] & (table.array != 0)
        if wrong.any():
            s, a = map(int, np.argwhere(wrong)[0])
            raise ParameterError(f"rewards[{s}, {a}] is {table.array[s, a]}, but state {s} is terminal; expected 0")
        return replace(self, reward_table=table, staying=None, residual=self.residual._replace(rewards=0.0))

    def lazy(self, p: float, staying: npt.ArrayLike | None = None) -> "TabularMDP":
        """The same MDP in which, with probability p, nothing happens; see `lazy_actions`."""
        if staying is not None:
            stays = self.with_rewards(staying).reward_table
        else:
            stays = self.reward_table if self.staying is None else self.staying()
        mixed = self.reward_table if stays is self.reward_table else self.reward_table.mixed(stays, p)
        return replace(
            self, dynamics=Lazy(self.dynamics, p), reward_table=mixed, staying=partial(_as_is, stays), age=None
        )

    def with_initial(self, initial: npt.ArrayLike) -> "TabularMDP":
        """The same MDP with another start: a state, a sequence of states, or (S,) probabilities."""
        states, probabilities = start_of(initial, self.num_states)
        return replace(self, start_states=states, start_probabilities=probabilities)

    def with_age(self, age: npt.ArrayLike) -> "TabularMDP":
        """The same MDP with an age (S,) of each state: an integer that every transition makes larger.

        No state is visited twice then, so solvers need one pass over the states, oldest first.

        Raises:
            ParameterError: there is not one integer for each state, or a transition out of a state that is not terminal
                leads to a state that is not older; the first one is named.
        """
        array = np.asarray(age)
        if array.shape != (self.num_states,) or array.dtype.kind not in "iu":
            raise ParameterError(
                f"age has shape {array.shape} and type {array.dtype}; expected {self.num_states} integers"
            )
        self.dynamics.check_age(~np.asarray(self.terminal), array)
        return replace(self, age=array)

    def order(self) -> TopologicalOrder | None:
        """An order of the states in which each stands before those it may lead to; None: some can be visited again.

        Cost: from ages at most a sort; else O(S A) and 16 bytes a state.
        """
        if self.age is None:
            return self.dynamics.order(~np.asarray(self.terminal))
        states, age = None, self.age
        if (age[1:] < age[:-1]).any():
            states = np.argsort(age, kind="stable")
            age = age[states]
        return TopologicalOrder(states, int(np.count_nonzero(age[1:] != age[:-1])))

    def within(self, steps: int) -> "TabularMDP":
        """The same MDP with only those states that can be reached within `steps` steps from a start, in their order.

        Both agree on every episode of at most `steps` steps from the start: values there, returns, effective horizon.
        Transitions of states that take all the steps to reach may be wrong: those that leave the set are replaced.

        Returns:
            This MDP where all of its states are reached; else one without a folder, as its states have other numbers.
        Cost: one read of each transition of the reached states, and a copy of them.
        """
        is_reached = self.states_within(steps)
        is_reached[self.start_states] = True
        if is_reached.all():
            return self
        return restricted_to(self, np.flatnonzero(is_reached))

    def __repr__(self) -> str:
        kind = "" if self.dynamics.is_deterministic else "general, "
        chance = "" if self.chance == Chance() else f", {self.chance}"
        chance += f", lazy={self.laziness:g}" if self.laziness else ""
        horizon = "" if self.horizon is None else f", horizon={self.horizon}"
        states, actions = ("s" * (number != 1) for number in (self.num_states, self.num_actions))
        size = f"{self.num_states} state{states}, {self.num_actions} action{actions}"
        return f"TabularMDP({kind}{size}, gamma={self.gamma}{horizon}{chance})"


def _as_is(rewards: Rewards) -> Rewards:
    return rewards


def restricted_to(mdp: "TabularMDP", states: np.ndarray) -> "TabularMDP":
    """The MDP of some states, ascending, the start states among them; they are numbered anew."""
    number = np.full(mdp.num_states, -1, np.int64)
    number[states] = np.arange(len(states))
    return replace(
        mdp,
        dynamics=mdp.dynamics.restricted_to(states),
        reward_table=mdp.reward_table.of(states),
        staying=None if mdp.staying is None else partial(_some, mdp.staying, states),
        terminal=np.asarray(mdp.terminal[states]),
        start_states=number[mdp.start_states],
        folder=None,
        environment=None,
        age=None,
    )


def _some(rewards: Callable[[], Rewards], states: np.ndarray) -> Rewards:
    return rewards().of(states)


# Parts ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Part:
    """A part of an MDP: a contiguous range of its states, [start, stop), and the outside states whose values it needs.

    Numbers of breadth-first search are local, so a range leads to few states outside of it, its *halo*: with 16 ranges
    9 % of a range's rows on a Breakout of 2.4 million states, 0.03 % on a Freeway. Ranges are what several processes
    sweep together (solvers/ranked.py).

    Inside a part its own states have the numbers 0 .. n - 1, in order, and those of the halo n .. n + H - 1, ascending;
    -1 is the end. Arrays of values have n + H + 1 rows, so the compiled sweeps run over parts as they are.

    Attributes:
        halo: (H,) int64, ascending: the states outside that these may lead to.
        dynamics: of n states, whose next states may be in the halo. reward_table: (n, A).
        gamma, chance: of the MDP.
    """

    start: int
    stop: int
    halo: np.ndarray
    dynamics: Dynamics
    reward_table: Rewards
    gamma: float
    chance: Chance

    @staticmethod
    def of(mdp: TabularMDP, start: int, stop: int) -> "Part":
        """The states [start, stop) of an MDP. Copies their next states, renumbered."""
        dynamics, halo = mdp.dynamics.part(start, stop)
        rewards = mdp.reward_table.of(slice(start, stop))
        return Part(start, stop, halo, dynamics, rewards, mdp.gamma, mdp.chance)

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def num_states(self) -> int:
        """n."""
        return len(self)

    @property
    def num_actions(self) -> int:
        """A."""
        return self.dynamics.num_actions

    @property
    def width(self) -> int:
        """W: A previous actions under sticky actions, else 1."""
        return self.chance.width(self.num_actions)

    def zeros(self) -> np.ndarray:
        """(n + H + 1, W) values: of its states, of the halo, of the end."""
        return np.zeros((len(self) + len(self.halo) + 1, self.width))

    def selection(self, select: Selection) -> Selection:
        """The selection of actions in the states of this part, of a selection in the whole MDP."""
        return select.of_states(slice(self.start, self.stop)) if isinstance(select, PolicyTable) else select
