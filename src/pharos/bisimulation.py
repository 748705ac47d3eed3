"""Bisimulation: states that no sequence of actions can tell apart, merged. Source: Givan, Dean and Greig (2003).

Two states are bisimilar if they pay the same reward for every action and lead to bisimilar states. The coarsest such partition is found
by refinement: start from terminal flag, rewards and, if wanted, observations; split classes by the classes that their states lead to,
until nothing splits (Moore 1956; Kanellakis and Smolka 1990).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP


@dataclass(frozen=True, eq=False)
class Minimization:
    """An MDP with bisimilar states merged.

    Attributes:
        mdp: the merged MDP, with the same discount, horizon and chance; classes are numbered by their first states.
        classes: (S,) int64, the class of each state.
        representatives: (C,) int64, the first state of each class.
        rounds: refinements until nothing split.
    """

    mdp: TabularMDP
    classes: np.ndarray
    representatives: np.ndarray
    rounds: int

    @property
    def num_classes(self) -> int:
        """C."""
        return len(self.representatives)


def minimize(mdp: TabularMDP, observations: Any = None) -> Minimization:
    """Return the smallest MDP that cannot be told from this one.

    V(s) = V(class of s) for every policy that depends on classes, under sticky and random actions too, because both act on executed
    actions. Terminal states are not merged with others, as they restart.

    Args:
        observations: (S, ...) one for each state: states that look different stay apart. None: rewards alone tell them apart.
    Raises:
        ParameterError: the MDP has no table of next states, or there is not one observation for each state.
    Cost: a sort of S rows of A + 1 numbers for each round; rounds are at most the number of steps that tell two states apart.
    Source: Givan, Dean and Greig (2003), "Equivalence notions and model minimization in Markov decision processes"; BRIDGE's
        consolidation (Laidlaw, Russell and Dragan 2023).
    """
    if mdp.next_states is None:
        raise ParameterError(
            f"{mdp} has no table of next states; expected an MDP with one next state for each state and action"
        )
    table, states = np.asarray(mdp.next_states), mdp.num_states
    features = [np.asarray(mdp.terminal)[:, None].astype(np.float64), mdp.rewards]
    classes = _numbered(np.ascontiguousarray(np.concatenate(features, axis=1) + 0.0))  # -0.0 and 0.0 are one reward
    if observations is not None:
        seen = np.asarray(observations)
        if len(seen) != states:
            raise ParameterError(f"there are {len(seen)} observations; expected {states}, one for each state")
        rows = np.ascontiguousarray(seen.reshape(states, -1))
        classes = _numbered(np.stack([classes, _numbered(rows)], axis=1))
    count, rounds = int(classes.max()) + 1, 0
    while True:
        following = np.where(table >= 0, classes[table], -1)
        classes = _numbered(np.ascontiguousarray(np.concatenate([classes[:, None], following], axis=1)))
        rounds += 1
        if int(classes.max()) + 1 == count:
            break
        count = int(classes.max()) + 1
    _, representatives = np.unique(classes, return_index=True)
    merged = table[representatives].astype(np.int64)
    initial = np.zeros(count)
    np.add.at(initial, classes[mdp.start_states], mdp.start_probabilities)
    smaller = TabularMDP.from_arrays(
        np.where(merged >= 0, classes[merged], -1),
        mdp.reward_table.rows(representatives),
        gamma=mdp.gamma,
        initial=int(initial.argmax()) if initial.max() == 1 else initial,
        horizon=mdp.horizon,
        terminal=np.asarray(mdp.terminal)[representatives],
    )
    return Minimization(replace(smaller, chance=mdp.chance), classes, representatives, rounds)


def _numbered(rows: np.ndarray) -> np.ndarray:
    """(N,) int64: equal rows get equal numbers, in the order in which they appear first."""
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.empty(len(first), np.int64)
    order[np.argsort(first, kind="stable")] = np.arange(len(first))
    return order[inverse]
