"""MDPs from arrays: next states, outcomes, matrices. The constructors of `TabularMDP`, which has them as methods."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pharos.mdp.action_sets import filled, sets_of, with_sets
from pharos.mdp.arguments import Residual, array_argument, checked_next_states, start_of, terminal_states
from pharos.mdp.matrices import expected_rewards, transitions_of
from pharos.mdp.rewards import Rewards, expected_over_outcomes, rewards_of_shape
from pharos.mdp.table import Matrices, OutcomeTable, Table, checked_outcomes, compact_outcomes

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP


def from_arrays(
    cls: type["TabularMDP"],
    next_states: npt.ArrayLike,
    rewards: npt.ArrayLike,
    *,
    gamma: float = 0.99,
    initial: npt.ArrayLike = 0,
    horizon: int | None = None,
    terminal: npt.ArrayLike | None = None,
    available: npt.ArrayLike | None = None,
) -> "TabularMDP":
    """A deterministic MDP from arrays.

    Args:
        next_states: (S, A) integers in [-1, S). -1 ends the episode after the transition's reward.
        rewards: (S, A) finite numbers, or -inf for actions that are not available.
        gamma: discount, in [0, 1].
        initial: a start state, a sequence of equally likely ones, or (S,) probabilities (floats, or a single 1).
        horizon: number of steps of an episode, or None.
        terminal: (S,) bool, the terminal states, whose rows must lead to themselves (or be -1) with reward 0. None:
            the states whose whole row is -1 with reward 0.
        available: (S, A) bool, the actions that exist in each state. None: all. What the other entries hold does not
            matter.
    Raises:
        ParameterError: a shape, an index, a reward, gamma or the start distribution is wrong, or a state that is not
            terminal has no available action. The first such entry is named.
    """
    table = checked_next_states(next_states)
    rewards = array_argument(rewards, "rewards")
    sets = sets_of(available, rewards, table.shape)
    if sets is not None:
        table = np.ascontiguousarray(filled(table, sets))
        rewards = filled(rewards, sets) if rewards.shape == table.shape else rewards
    reward_table = rewards_of_shape(rewards, table.shape)
    silent = (reward_table.array == 0).all(axis=1)
    own = np.arange(len(table), dtype=table.dtype)[:, None]
    stays = ((table == own) | (table == -1)).all(axis=1)
    mask = terminal_states(terminal, (table == -1).all(axis=1) & silent, stays & silent)
    states, probabilities = start_of(initial, len(table))
    return with_sets(cls(Table(table), reward_table, mask, gamma, horizon, states, probabilities), sets)


def from_outcomes(
    cls: type["TabularMDP"],
    successors: npt.ArrayLike,
    probabilities: npt.ArrayLike,
    rewards: npt.ArrayLike,
    *,
    gamma: float = 0.99,
    initial: npt.ArrayLike = 0,
    horizon: int | None = None,
    terminal: npt.ArrayLike | None = None,
    available: npt.ArrayLike | None = None,
) -> "TabularMDP":
    """An MDP in which each action has up to K outcomes, from arrays.

    Args:
        successors: (S, A, K) integers in [-1, S). -1 ends the episode after the transition's reward. Entries of
            probability 0 count for nothing.
        probabilities: (S, A, K) of the outcomes. Each row sums to 1 within 1e-6, and is divided by its sum unless
            that is 1 up to rounding.
        rewards: (S, A) expected rewards, or (S, A, K), which are averaged.
        gamma, initial, horizon, terminal, available: as in `from_arrays`. -inf only among (S, A) rewards.
    Raises:
        ParameterError: as in `from_arrays`, or a probability is not in [0, 1] or a row does not sum to 1.
    """
    rewards, sets = array_argument(rewards, "rewards"), None
    shape = np.shape(successors)[:2]
    if len(shape) == 2:
        sets = sets_of(available, rewards, shape)
    if sets is not None:
        successors, probabilities = (
            filled(np.asarray(each), sets) if np.shape(each)[:2] == shape else each
            for each in (successors, probabilities)
        )
        rewards = filled(rewards, sets) if rewards.shape[:2] == shape else rewards
    table, chances, residuals = checked_outcomes(successors, probabilities)
    means, largest = expected_over_outcomes(rewards, chances)
    mdp = cls.from_outcome_table(
        OutcomeTable(**compact_outcomes(table, chances)),
        means,
        gamma=gamma,
        initial=initial,
        horizon=horizon,
        terminal=terminal,
    )
    return with_sets(replace(mdp, residual=Residual.of(residuals, largest)), sets)


def from_outcome_table(
    cls: type["TabularMDP"],
    dynamics: OutcomeTable,
    rewards: npt.ArrayLike | Rewards,
    *,
    gamma: float = 0.99,
    initial: npt.ArrayLike = 0,
    horizon: int | None = None,
    terminal: npt.ArrayLike | None = None,
) -> "TabularMDP":
    """An MDP on an existing table of outcomes, with expected rewards (S, A), see `from_outcomes`."""
    num_states = dynamics.num_states
    reward_table = rewards_of_shape(rewards, (num_states, dynamics.num_actions))
    silent = (reward_table.array == 0).all(axis=1)
    ends, stays = dynamics.ends_and_stays()
    mask = terminal_states(terminal, ends & silent, stays & silent)
    states, probabilities = start_of(initial, num_states)
    return cls(dynamics, reward_table, mask, gamma, horizon, states, probabilities)


def from_matrices(
    cls: type["TabularMDP"],
    P: object,
    R: npt.ArrayLike,
    *,
    gamma: float = 0.99,
    initial: npt.ArrayLike = 0,
    horizon: int | None = None,
    axes: str | None = None,
    ends: npt.ArrayLike = False,
    available: npt.ArrayLike | None = None,
) -> "TabularMDP":
    """A general MDP from transition probabilities.

    Args:
        P: a list of A matrices (S, S), dense or sparse, one an action. Or an array (S, A, S) of probabilities P[s, a,
            t], or a sparse (S A, S) matrix with rows s A + a. A row that sums to 1 within 1e-6 is divided by its sum
            unless that is 1 up to rounding. `residual` has what that may change, and error bounds of values count it.
        R: expected rewards (S, A), or (S,) for every action alike, or one for each transition, in any form of P,
            averaged over P.
        gamma, initial, horizon: as in `from_arrays`.
        axes: of arrays with three axes, "SAS" or "ASS" (also "SAS" of a list with one (A, S) matrix a state). It
            must be given for an array with as many actions as states, which has the shape of both.
        ends: whether a row that sums to less than 1 - 1e-6 ends the episode with the rest. Or (S, A) probabilities
            of ending, which are then part of the sums of rows.
        available: (S, A) bool, the actions that exist in each state. None: all but those that R (S, A) pays -inf, and
            those whose row is empty (in a state in which not all rows are, and unless `ends` says what that means).
    Raises:
        ParameterError: shapes do not fit, a probability or reward is out of range, or a state that is not terminal has
            no available action. Or a row does not sum to 1: the message names the first one, and the likely reason.
    """
    matrix, num_actions, residuals, sets = transitions_of(P, axes, ends, available, R)
    dynamics = Matrices(matrix, num_actions)
    shape = (dynamics.num_states, num_actions)
    means, residual = expected_rewards(matrix, R, axes, num_actions, residuals, sets)
    reward_table = rewards_of_shape(means, shape)
    ended = np.asarray(matrix.sum(axis=1)).reshape(shape) <= 1e-12
    terminal = ended.all(axis=1) & (reward_table.array == 0).all(axis=1)
    states, probabilities = start_of(initial, dynamics.num_states)
    mdp = cls(dynamics, reward_table, terminal, gamma, horizon, states, probabilities, residual=residual)
    return with_sets(mdp, sets)
