"""TabularMDP: next states, rewards, discount, start distribution, and chance that stays implicit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.mdp import construction
from pharos.mdp.action_sets import filled, stand_ins
from pharos.mdp.actions import Chance, States
from pharos.mdp.arguments import (
    Residual,
    check_gamma,
    check_horizon,
    start_of,
)
from pharos.mdp.dynamics import Dynamics, TopologicalOrder
from pharos.mdp.names import Names, names_from
from pharos.mdp.rewards import Rewards, rewards_of_shape
from pharos.mdp.table import (
    Lazy,
)
from pharos.system.arrays import Indices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from pharos.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A Markov decision process of S states and A actions.

    Made by `StateSpace.mdp`, `from_arrays`, `from_outcomes` or `from_matrices`. `sticky_actions`, `random_actions` and
    `lazy_actions` add chance.

    Attributes:
        dynamics: transitions of executed actions, the same interface for every way of storing them.
        reward_table: the rewards, compactly. `rewards` is the same as (S, A) float64.
        terminal: (S,) bool, the terminal states: they lead to themselves with reward 0 (or are whole rows of -1, reward
            0).
        gamma: discount, in [0, 1].
        horizon: number of steps T after which an episode ends, or None.
        start_states, start_probabilities: the start distribution.
        chance: weights of the chosen, the previously executed and a uniform action.
        folder: of the state space, or of an imported table. None: in no folder.
        space: the state space that the states are of, if there is one.
        is_numbered: whether states have the numbers that they were given with. False after some were merged.
        age: (S,) integers that each transition out of a state that is not terminal makes larger. None if they are not
            known. Solvers take the states in this order then, once.
        available: (S, A) bool, the actions that exist in each state, one or more, all in terminal states. None: all
            everywhere. Transitions and rewards of the others are the same as for the first available action.
        names: of states and actions: labels, variables, names of actions. None: the names of the space, if there is
            one.
        residual: what the sums of rows that were given leave open, see `Residual`. Error bounds of values
            count it.
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
    space: "StateSpace | None" = None
    residual: Residual = field(default_factory=Residual)
    is_numbered: bool = True
    available: np.ndarray | None = None
    names: Names | None = None

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
        if self.available is not None and self.available.all():
            object.__setattr__(self, "available", None)  # the class is frozen
        if self.chance.available is not self.available:
            object.__setattr__(self, "chance", replace(self.chance, available=self.available))

    # Making one -------------------------------------------------------------------------------------------------------

    from_arrays = classmethod(construction.from_arrays)
    from_outcomes = classmethod(construction.from_outcomes)
    from_outcome_table = classmethod(construction.from_outcome_table)
    from_matrices = classmethod(construction.from_matrices)

    # What it is -------------------------------------------------------------------------------------------------------

    @property
    def environment(self) -> Environment | None:
        """The environment that the states are of, if it is known."""
        return None if self.space is None else self.space.environment

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
        """(S, A) int32, int64 or `PackedIndices`, the next state of each action. -1: the episode ends.

        None if transitions are not stored so.
        """
        return getattr(self.dynamics, "next_states", None)

    @property
    def transitions(self) -> "csr_matrix | None":
        """(S A, S) sparse probabilities with rows s A + a.

        1 minus the sum of a row is the probability that the episode ends.

        None if transitions are not stored so.
        """
        return getattr(self.dynamics, "transitions", None)

    @property
    def rewards(self) -> np.ndarray:
        """(S, A) float64, expected rewards of executed actions."""
        return self.reward_table.array

    @property
    def initial(self) -> int | np.ndarray:
        """The start state, or (S,) probabilities if there are several."""
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
        """W: values and distributions belong to (S, W) pairs: A previous actions under sticky actions, else 1."""
        return self.chance.width(self.num_actions)

    @property
    def policy_width(self) -> int:
        """Choices of a policy in each state: A + 1 under sticky actions, by the previous action, none last. Otherwise
        1."""
        return self.num_actions + 1 if self.is_sticky else 1

    @property
    def nodes(self) -> str:
        """Name, in words, of the nodes that values and choices belong to."""
        return "pairs (state, previously executed action)" if self.is_sticky else "states"

    def acting(self, x: np.ndarray, states: States) -> np.ndarray:
        """Values (N, A, ...) of executing actions in some states, unavailable actions as what they act as.

        Only under sticky actions they may differ, as the action is part of what comes next.
        """
        if self.available is None or not self.is_sticky:
            return x
        return x[np.arange(len(x))[:, None], stand_ins(self.available[states])]

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

    @property
    def starts(self) -> np.ndarray:
        """(K,) the states that an episode may start in, ascending."""
        return np.unique(self.start_states[self.start_probabilities > 0])

    # Variants ---------------------------------------------------------------------------------------------------------

    def with_gamma(self, gamma: float) -> "TabularMDP":
        """The same MDP with another discount."""
        return replace(self, gamma=gamma)

    def with_horizon(self, horizon: int | None) -> "TabularMDP":
        """The same MDP with another horizon."""
        return replace(self, horizon=horizon)

    def with_rewards(self, rewards: npt.ArrayLike) -> "TabularMDP":
        """The same MDP with other rewards, (S, A). Rewards of terminal states must be 0. Those of unavailable actions
        count for nothing. ParameterError: another reward is not finite."""
        if self.available is not None and np.shape(rewards) == self.available.shape:
            rewards = filled(np.asarray(rewards, np.float64), self.available & ~self.terminal[:, None])
        table = rewards_of_shape(rewards, self.reward_table.shape)
        wrong = self.terminal[:, None] & (table.array != 0)
        if wrong.any():
            s, a = map(int, np.argwhere(wrong)[0])
            raise ParameterError(f"rewards[{s}, {a}] is {table.array[s, a]}, but state {s} is terminal; expected 0")
        return replace(self, reward_table=table, staying=None, residual=self.residual._replace(rewards=0.0))

    def lazy(self, p: float, staying: npt.ArrayLike | None = None) -> "TabularMDP":
        """The same MDP in which, with probability p, nothing happens, see `lazy_actions`."""
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

    def with_names(
        self,
        *,
        labels: Mapping[str, npt.ArrayLike] = MappingProxyType({}),
        variables: Mapping[str, npt.ArrayLike] = MappingProxyType({}),
        actions: Sequence[str] | None = None,
    ) -> "TabularMDP":
        """The same MDP whose states and actions have names, which `reach`, `solve --print-policy` and pages use.

        Args:
            labels: name -> (S,) bool, or indices of states.
            variables: name -> (S,) integers or bool.
            actions: (A,) names. None: numbers.
        Raises:
            ParameterError: they do not fit the MDP.
        """
        return replace(self, names=names_from(labels, variables, actions, self.reward_table.shape))

    def with_age(self, age: npt.ArrayLike) -> "TabularMDP":
        """The same MDP with an age (S,) of each state: an integer that every transition makes larger.

        No state is visited twice then, so solvers need one pass over the states, oldest first.

        Raises:
            ParameterError: there is not one integer for each state, or a transition out of a state that is not terminal
                leads to a state that is not older. The first one is named.
        """
        array = np.asarray(age)
        if array.shape != (self.num_states,) or array.dtype.kind not in "iu":
            raise ParameterError(
                f"age has shape {array.shape} and type {array.dtype}; expected {self.num_states} integers"
            )
        self.dynamics.check_age(~np.asarray(self.terminal), array)
        return replace(self, age=array)

    def order(self) -> TopologicalOrder | None:
        """An order of the states in which each stands before those it may lead to. None: some can be visited again.

        Cost: from ages at most a sort, else O(S A) and 16 bytes a state.
        """
        if self.age is None:
            return self.dynamics.order(~np.asarray(self.terminal))
        states, age = None, self.age
        if (age[1:] < age[:-1]).any():
            states = np.argsort(age, kind="stable")
            age = age[states]
        return TopologicalOrder(states, int(np.count_nonzero(age[1:] != age[:-1])))

    def __repr__(self) -> str:
        kind = "" if self.dynamics.is_deterministic else "general, "
        chance = "" if self.chance == Chance() else f", {self.chance}"
        chance += f", lazy={self.laziness:g}" if self.laziness else ""
        horizon = "" if self.horizon is None else f", horizon={self.horizon}"
        states, actions = ("s" * (number != 1) for number in (self.num_states, self.num_actions))
        size = f"{self.num_states} state{states}, {self.num_actions} action{actions}"
        size += "" if self.available is None else ", not all in each state"
        return f"TabularMDP({kind}{size}, gamma={self.gamma}{horizon}{chance})"


def _as_is(rewards: Rewards) -> Rewards:
    return rewards
