"""TabularMDP: next states, rewards, discount, start distribution, and chance that stays implicit."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.chance import Chance
from pharos.mdp.rewards import Rewards

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from pharos.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A Markov decision process of S states and A actions.

    Made by `StateSpace.mdp`, `from_arrays` or `from_matrices`; `sticky_actions` and `random_actions` add chance.

    Attributes:
        next_states: (S, A) int32 or int64, where each action leads; -1: the episode ends there, as if in one more, terminal
            state. None for a general MDP.
        transitions: None, or for a general MDP the probabilities as a sparse (S A, S) matrix with rows s A + a; what a row
            lacks to 1 is the probability that the episode ends.
        reward_table: the rewards, compactly; `rewards` is the same as (S, A) float64.
        terminal: (S,) bool, the terminal states: they lead to themselves with reward 0 (or are whole rows of -1, reward 0).
        gamma: discount, in [0, 1].
        horizon: number of steps T after which an episode ends, or None.
        start_states, start_probabilities: the start distribution.
        chance: weights of the chosen, the previously executed and a uniform action.
        folder: of the state space, where there is one.
    """

    next_states: np.ndarray | None
    reward_table: Rewards
    terminal: np.ndarray
    gamma: float = 0.99
    horizon: int | None = None
    start_states: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))
    start_probabilities: np.ndarray = field(default_factory=lambda: np.ones(1))
    chance: Chance = field(default_factory=Chance)
    transitions: "csr_matrix | None" = None
    folder: Any = None

    def __post_init__(self) -> None:
        _check_gamma(self.gamma)
        _check_horizon(self.horizon)

    # Making one ----------------------------------------------------------------------------------------------------------

    @staticmethod
    def from_arrays(
        next_states: Any,
        rewards: Any,
        *,
        gamma: float = 0.99,
        initial: Any = 0,
        horizon: int | None = None,
        terminal: Any = None,
    ) -> "TabularMDP":
        """A deterministic MDP from arrays.

        Args:
            next_states: (S, A) integers in [-1, S); -1 ends the episode after the transition's reward.
            rewards: (S, A) finite numbers.
            gamma: discount, in [0, 1].
            initial: a start state, a sequence of equally likely ones (fewer than S), or (S,) probabilities.
            horizon: number of steps of an episode, or None.
            terminal: (S,) bool, the terminal states, whose rows must lead to themselves (or be -1) with reward 0; None: the
                states whose whole row is -1 with reward 0.
        Raises:
            ParameterError: a shape, an index, a reward, gamma or the start distribution is wrong; the first such entry is named.
        """
        table = np.asarray(next_states)
        if table.ndim != 2 or table.size == 0 or table.dtype.kind not in "iu":
            raise ParameterError(
                f"next_states has shape {table.shape} and type {table.dtype}; expected integers of shape (states, actions)"
            )
        outside = (table < -1) | (table >= len(table))
        if outside.any():
            s, a = map(int, np.argwhere(outside)[0])
            raise ParameterError(
                f"next_states[{s}, {a}] is {table[s, a]}; expected a state from 0 to {len(table) - 1}, or -1 for the end"
            )
        reward_table = _rewards_of_shape(rewards, table.shape)
        dtype = np.int32 if len(table) < 2**31 else np.int64
        table = np.ascontiguousarray(table, dtype)
        silent = (reward_table.array == 0).all(axis=1)
        if terminal is None:
            mask = (table == -1).all(axis=1) & silent
        else:
            mask = np.asarray(terminal, np.bool_)
            own = np.arange(len(table), dtype=dtype)[:, None]
            if mask.shape != (len(table),) or (mask & ~(((table == own) | (table == -1)).all(axis=1) & silent)).any():
                raise ParameterError(
                    f"terminal has shape {mask.shape}; expected ({len(table)},), true only where a state leads to itself "
                    f"(or to -1) with reward 0 by every action"
                )
        states, probabilities = _start(initial, len(table))
        return TabularMDP(table, reward_table, mask, gamma, horizon, states, probabilities)

    @staticmethod
    def from_matrices(
        P: Any, R: Any, *, gamma: float = 0.99, initial: Any = 0, horizon: int | None = None
    ) -> "TabularMDP":
        """A general MDP from transition probabilities.

        Args:
            P: (S, A, S) array of probabilities P[s, a, t]; or a sparse (S A, S) matrix with rows s A + a; or a list of A
                sparse (S, S) matrices. A row that sums to less than 1 ends the episode with the rest.
            R: expected rewards (S, A); or (S,) for every action alike; or (S, A, S), dense P only, averaged over P.
            gamma, initial, horizon: as in `from_arrays`.
        Raises:
            ParameterError: shapes do not fit, or a probability or reward is out of range.
        """
        from scipy import sparse

        if isinstance(P, list | tuple) and len(P) and sparse.issparse(P[0]):
            num_states, num_actions = P[0].shape[0], len(P)
            stacked = sparse.vstack([sparse.csr_matrix(matrix) for matrix in P]).tocsr()
            order = (np.arange(num_actions)[None, :] * num_states + np.arange(num_states)[:, None]).ravel()
            matrix = stacked[order]
        elif sparse.issparse(P):
            matrix = sparse.csr_matrix(P, dtype=np.float64)
            num_states = matrix.shape[1]
            num_actions = matrix.shape[0] // max(num_states, 1)
        else:
            dense = np.asarray(P, np.float64)
            if dense.ndim != 3 or dense.shape[0] != dense.shape[2]:
                raise ParameterError(f"P has shape {dense.shape}; expected (states, actions, states)")
            num_states, num_actions = dense.shape[:2]
            matrix = sparse.csr_matrix(dense.reshape(num_states * num_actions, num_states))
        if matrix.shape != (num_states * num_actions, num_states) or not num_actions:
            raise ParameterError(f"P has shape {matrix.shape}; expected (states * actions, states)")
        matrix = matrix.astype(np.float64)
        matrix.sum_duplicates()
        sums = np.asarray(matrix.sum(axis=1)).ravel()
        if not (np.isfinite(matrix.data).all() and (matrix.data >= 0).all()):
            raise ParameterError("P has entries that are negative, NaN or infinite; expected probabilities")
        if (sums > 1 + 1e-9).any():
            row = int(np.argmax(sums))
            raise ParameterError(
                f"P of state {row // num_actions}, action {row % num_actions} sums to {sums[row]}; expected at most 1"
            )
        expected = np.asarray(R, np.float64)
        if (
            expected.shape == (num_states, num_actions, num_states)
            and not sparse.issparse(P)
            and not isinstance(P, list | tuple)
        ):
            expected = (np.asarray(P, np.float64) * expected).sum(axis=2)
        elif expected.shape == (num_states,) and num_actions >= 1:
            expected = np.repeat(expected[:, None], num_actions, axis=1)
        reward_table = _rewards_of_shape(expected, (num_states, num_actions))
        ended = sums.reshape(num_states, num_actions) <= 1e-12
        terminal = ended.all(axis=1) & (reward_table.array == 0).all(axis=1)
        states, probabilities = _start(initial, num_states)
        return TabularMDP(None, reward_table, terminal, gamma, horizon, states, probabilities, transitions=matrix)

    @staticmethod
    def from_space(space: "StateSpace", rewards: Rewards, gamma: float = 0.99) -> "TabularMDP":
        """The MDP on the states of a state space; `StateSpace.mdp` computes the rewards."""
        return TabularMDP(
            space.successors,
            rewards,
            space.terminal,
            gamma,
            None,
            space.start_states,
            space.start_probabilities,
            folder=space.folder,
        )

    # What it is ----------------------------------------------------------------------------------------------------------

    @property
    def num_states(self) -> int:
        """S."""
        return self.reward_table.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.reward_table.shape[1]

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
        return self.chance.previous > 0

    @property
    def is_random(self) -> bool:
        """Whether a uniform action is executed now and then."""
        return self.chance.uniform > 0

    @property
    def is_deterministic(self) -> bool:
        """Whether every choice has one outcome."""
        return self.next_states is not None and not self.is_sticky and not self.is_random

    @cached_property
    def has_ends(self) -> bool:
        """Whether some transition ends the episode by -1."""
        return self.next_states is not None and bool((self.next_states == -1).any())

    # Variants ------------------------------------------------------------------------------------------------------------

    def with_gamma(self, gamma: float) -> "TabularMDP":
        """The same MDP with another discount."""
        return replace(self, gamma=gamma)

    def with_horizon(self, horizon: int | None) -> "TabularMDP":
        """The same MDP with another horizon."""
        return replace(self, horizon=horizon)

    def with_rewards(self, rewards: Any) -> "TabularMDP":
        """The same MDP with other rewards, (S, A); those of terminal states must be 0."""
        table = _rewards_of_shape(rewards, self.reward_table.shape)
        paid = self.terminal[:, None] & (table.array != 0)
        if paid.any():
            s, a = map(int, np.argwhere(paid)[0])
            raise ParameterError(f"rewards[{s}, {a}] is {table.array[s, a]}, but state {s} is terminal; expected 0")
        return replace(self, reward_table=table)

    def with_initial(self, initial: Any) -> "TabularMDP":
        """The same MDP with another start: a state, a sequence of states, or (S,) probabilities."""
        states, probabilities = _start(initial, self.num_states)
        return replace(self, start_states=states, start_probabilities=probabilities)

    def within(self, steps: int) -> "TabularMDP":
        """The same MDP with only those states that can be met within `steps` steps from a start; they keep their order.

        Whatever episodes of at most `steps` steps from the start tell is the same for both: values there, returns, effective horizon. Of
        states that take all the steps to reach, only that they exist is right: actions that lead out of the set lead back.

        Returns:
            This MDP where all of its states are met; else one without a folder, as its states have other numbers.
        Cost: one look at each transition of the states that are met, and a copy of them.
        """
        met = self.states_within(steps)
        met[self.start_states] = True
        if met.all():
            return self
        kept = np.flatnonzero(met)
        number = np.full(self.num_states, -1, np.int64)
        number[kept] = np.arange(len(kept))
        next_states, transitions = None, None
        if self.next_states is not None:
            table = np.asarray(self.next_states[kept])
            inside = number[table]  # what leads to -1 gets any number here
            own = np.broadcast_to(np.arange(len(kept))[:, None], table.shape)
            following = np.where(table < 0, -1, np.where(inside < 0, own, inside))
            next_states = following.astype(np.int32 if len(kept) < 2**31 else np.int64)
        else:
            assert self.transitions is not None
            rows = (kept[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()
            transitions = self.transitions[rows][:, kept].tocsr()
        return replace(
            self,
            next_states=next_states,
            transitions=transitions,
            reward_table=replace(self.reward_table, table=np.asarray(self.reward_table.table[kept])),
            terminal=np.asarray(self.terminal[kept]),
            start_states=number[self.start_states],
            folder=None,
        )

    def states_within(self, steps: int) -> np.ndarray:
        """(S,) bool: the states that can be met within `steps` steps from a start."""
        met = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(self.start_states[self.start_probabilities > 0])
        met[frontier] = True
        if self.next_states is None:
            assert self.transitions is not None
            for _ in range(steps):
                if not len(frontier):
                    break
                rows = (frontier[:, None] * self.num_actions + np.arange(self.num_actions)).ravel()
                found = np.unique(self.transitions[rows].indices)
                frontier = found[~met[found]]
                met[frontier] = True
            return met
        from pharos.kernels.graph import onwards

        now, following = (np.empty(self.num_states, np.int64) for _ in range(2))
        count = len(frontier)
        now[:count] = frontier
        for _ in range(steps):
            count = onwards(self.next_states, now, count, following, met)
            if not count:
                break
            now, following = following, now
        return met

    def __repr__(self) -> str:
        kind = "general, " if self.transitions is not None else ""
        chance = "" if self.chance == Chance() else f", {self.chance}"
        horizon = "" if self.horizon is None else f", horizon={self.horizon}"
        return f"TabularMDP({kind}{self.num_states} states, {self.num_actions} actions, gamma={self.gamma}{horizon}{chance})"


def _check_gamma(gamma: Any) -> None:
    if not (isinstance(gamma, int | float | np.floating) and math.isfinite(gamma) and 0 <= gamma <= 1):
        raise ParameterError(f"gamma is {gamma!r}; expected a number in [0, 1]")


def _check_horizon(horizon: Any) -> None:
    if horizon is not None and not (isinstance(horizon, int | np.integer) and horizon >= 1):
        raise ParameterError(f"horizon is {horizon!r}; expected a whole number of steps, at least 1, or None")


def _rewards_of_shape(rewards: Any, shape: tuple[int, ...]) -> Rewards:
    array = np.asarray(rewards, np.float64)
    if array.shape != shape:
        raise ParameterError(f"rewards have shape {array.shape}; expected {shape}, one for each state and action")
    return Rewards.from_array(array)


def _start(initial: Any, num_states: int) -> tuple[np.ndarray, np.ndarray]:
    """Start states and their probabilities."""
    given = np.asarray(initial)
    if given.dtype.kind in "iu" and given.ndim == 0:
        states, probabilities = given.reshape(1), np.ones(1)
    elif given.dtype.kind in "iu" and given.ndim == 1 and len(given):
        states, counts = np.unique(given, return_counts=True)
        probabilities = counts / counts.sum()
    elif given.dtype.kind == "f" and given.shape == (num_states,):
        if not (np.isfinite(given).all() and (given >= 0).all() and abs(given.sum() - 1) < 1e-9):
            raise ParameterError(f"initial sums to {given.sum()}; expected {num_states} probabilities that sum to 1")
        states = np.flatnonzero(given)
        probabilities = given[states]
    else:
        raise ParameterError(
            f"initial has shape {given.shape} and type {given.dtype}; expected a state, several states, or "
            f"({num_states},) probabilities"
        )
    if (states < 0).any() or (states >= num_states).any():
        raise ParameterError(
            f"initial names state {states[(states < 0) | (states >= num_states)][0]}; expected 0 to {num_states - 1}"
        )
    return states.astype(np.int64), np.asarray(probabilities, np.float64)
