"""Actions that exist in some states only: the sets `available` (S, A) bool of an MDP.

The transitions and rewards of an action that is not available are the same as for the first available action of its
state. So optimal and worst values, reachable states and the shortest times to them are computed as if every action
existed, by the same kernels. Only what counts, averages or lists actions reads the sets. See
docs/decisions/0019-action-sets.md.

In terminal states nothing is chosen, so all actions count as available there.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp.arguments import array_argument

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP


def checked_sets(available: object, shape: tuple[int, int]) -> np.ndarray:
    """(S, A) bool of an argument `available`. ParameterError if it is something else."""
    array = array_argument(available, "available")
    is_truth = array.dtype == bool or (array.dtype.kind in "iu" and bool(np.isin(array, (0, 1)).all()))
    if array.shape != shape or not is_truth:
        raise ParameterError(
            f"available has shape {array.shape} and type {array.dtype}; expected {shape} bool: which actions exist"
        )
    return array.astype(np.bool_)


def sets_of(available: object, rewards: np.ndarray, shape: tuple[int, int]) -> np.ndarray | None:
    """(S, A) bool, the available actions that rewards (S, A) do not pay -inf. None if all are available."""
    sets = None if available is None else checked_sets(available, shape)
    if rewards.shape == shape and rewards.dtype.kind == "f" and rewards.size and rewards.min() == -np.inf:
        exists = rewards != -np.inf
        sets = exists if sets is None else sets & exists
    return None if sets is None or sets.all() else sets


def stand_ins(sets: np.ndarray) -> np.ndarray:
    """(S, A) the action that each action acts as: itself, or the first available one. Itself if there is none."""
    own = np.arange(sets.shape[1])
    return np.where(sets | ~sets.any(axis=1, keepdims=True), own, sets.argmax(axis=1)[:, None])


def filled(array: np.ndarray, sets: np.ndarray) -> np.ndarray:
    """An array (S, A, ...) with the entries of unavailable actions replaced. If a state has no available action, -inf
    by 0. That of an available one stays, and is refused as any other number that is not finite."""
    result = array[np.arange(len(sets))[:, None], stand_ins(sets)]
    if result.dtype.kind == "f":
        without = ~sets.any(axis=1)
        result[without] = np.where(result[without] == -np.inf, 0.0, result[without])
    return result


def with_sets(mdp: "TabularMDP", sets: np.ndarray | None) -> "TabularMDP":
    """The MDP, whose table is filled, with its sets.

    Raises:
        ParameterError: a state that is not terminal has no available action.
    """
    if sets is None:
        return mdp
    terminal = np.asarray(mdp.terminal)
    without = np.flatnonzero(~sets.any(axis=1) & ~terminal)
    if without.size:
        raise ParameterError(
            f"state {without[0]} has no available action; expected one or more in every state that is not terminal"
        )
    return replace(mdp, available=sets | terminal[:, None])


def uniform_choice(mdp: "TabularMDP") -> np.ndarray:
    """(S, A) probabilities of uniform play: 1 over the number of available actions, else 0."""
    if mdp.available is None:
        return np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions)
    return np.asarray(mdp.available / mdp.available.sum(axis=1, keepdims=True))


def most_actions(mdp: "TabularMDP") -> int:
    """The largest number of actions that are available in a state that is not terminal, A if all are."""
    if mdp.available is None:
        return mdp.num_actions
    return int(mdp.available.sum(axis=1).max(where=~np.asarray(mdp.terminal), initial=1))


def available_choices(actions: np.ndarray, sets: np.ndarray | None) -> np.ndarray:
    """Actions (N,) with those that are not in the sets (N, A) replaced by what they act as."""
    if sets is None:
        return actions
    rows = np.arange(len(actions))
    return np.where(sets[rows, actions], actions, sets.argmax(axis=1))


def drawn_actions(sets: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N,) a uniform one of the actions in each of the sets (N, A)."""
    rank = rng.integers(sets.sum(axis=1))
    return np.asarray((sets.cumsum(axis=1) > rank[:, None]).argmax(axis=1))


def check_choices(probabilities: np.ndarray, sets: np.ndarray | None, states: Iterable[int] | None = None) -> None:
    """ParameterError if choices (N, A) or (N, B, A) have an unavailable action. sets: (N, A), of states (N,)."""
    if sets is None:
        return
    outside = ~sets if probabilities.ndim == 2 else ~sets[:, None]
    wrong = np.argwhere((probabilities > 0) & outside)
    if len(wrong):
        row, action = int(wrong[0][0]), int(wrong[0][-1])
        numbers = np.arange(len(sets)) if states is None else np.asarray(list(states))
        raise ParameterError(
            f"the policy takes action {action} in state {numbers[row]}, where it is not available; expected one of "
            f"{', '.join(map(str, np.flatnonzero(sets[row])))}"
        )
