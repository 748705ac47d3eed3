"""What of an MDP can be met from its start: pairs of a state and the action executed before, and the part of it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pharos.mdp.rewards import Rewards

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP


def pairs_within(mdp: "TabularMDP", steps: int | None) -> np.ndarray:
    """(S, A) bool: what `TabularMDP.pairs_within` says."""
    num_states, num_actions, terminal = mdp.num_states, mdp.num_actions, np.asarray(mdp.terminal)
    if mdp.chance.executes_any:
        if steps == 0:
            return np.zeros((num_states, num_actions), np.bool_)
        before = mdp.states_within(None if steps is None else steps - 1) & ~terminal
        return mdp.dynamics.arrivals(np.flatnonzero(before))
    is_reached = np.zeros((num_states + 1, num_actions), np.bool_)
    is_reached[-1] = True
    states, actions = np.repeat(mdp.starts, num_actions), np.tile(np.arange(num_actions), len(mdp.starts))
    level = 0
    while len(states) and (steps is None or level < steps):
        live = ~terminal[states]
        states, actions = states[live], actions[live]
        outcomes = mdp.dynamics.outcomes(states, actions)
        pairs = np.unique(outcomes.states * num_actions + actions[outcomes.which])
        states, actions = np.divmod(pairs, num_actions)
        new = ~is_reached[states, actions]
        states, actions = states[new], actions[new]
        is_reached[states, actions] = True
        level += 1
    return is_reached[:-1]


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
