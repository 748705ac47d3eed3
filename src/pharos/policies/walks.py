"""The values of deterministic policies where nothing is random: each plays one episode, many side by side.

Such a policy meets one state after the other, so asking it state by state costs a call for each; here N policies are
asked together. `evaluate_seeing` gives the same values one by one, and those of all other policies.
"""

from collections.abc import Callable, Sequence

import numpy as np

from pharos.mdp import TabularMDP
from pharos.policies.evaluation import Evaluation, steps_that_matter
from pharos.system.packed_indices import as_array

_UNIT = 2.0**-53


def is_walk(mdp: TabularMDP) -> bool:
    """Whether a deterministic policy always meets the same states: one start, no chance."""
    is_chosen = mdp.chance.triple[0] == 1.0 and not mdp.laziness
    return is_chosen and len(mdp.start_states) == 1 and mdp.dynamics.deterministic_table() is not None


def walk_values(
    mdps: Sequence[TabularMDP], act: Callable[[np.ndarray], np.ndarray], *, frames: int = 1
) -> list[Evaluation]:
    """The values of N policies from the start, exact, each in its own MDP of which `is_walk` holds.

    Args:
        act: (N,) states -> (N,) actions, of the policies in their states; those whose episode is over are asked about
            their last state.
        frames: k, how many states the policies see. If more than one, `act` gets histories (N, k): the last k states of
            the episode, the oldest first, of which the first one stands for those before it.
    Cost: the longest episode times a call of `act`.
    """
    worlds = {
        id(mdp): (as_array(mdp.dynamics.deterministic_table()), np.asarray(mdp.terminal), mdp.reward_table)
        for mdp in mdps
    }
    members = {key: np.array([i for i, mdp in enumerate(mdps) if id(mdp) == key]) for key in worlds}
    ahead = [steps_that_matter(mdp) for mdp in mdps]
    state = np.array([mdp.start_states[0] for mdp in mdps], np.int64)
    history = np.repeat(state[:, None], frames, axis=1)
    limits, gammas = np.array([steps for steps, _ in ahead]), np.array([mdp.gamma for mdp in mdps])
    is_over = np.array([bool(mdp.terminal[s]) for mdp, s in zip(mdps, state, strict=True)])
    value, size, discount = np.zeros(len(mdps)), np.zeros(len(mdps)), np.ones(len(mdps))
    path: list[np.ndarray] = []
    while not (is_over := is_over | (len(path) >= limits)).all():
        path.append(np.where(is_over[:, None], -1, history))
        actions = act(state if frames == 1 else history)
        for key, (table, terminal, rewards) in worlds.items():
            i = members[key][~is_over[members[key]]]
            s, a = state[i], actions[i]
            following, entries = table[s, a], rewards.table[s, a]
            reward = discount[i] * (rewards.palette[entries] if len(rewards.palette) else entries)
            value[i] += reward
            size[i] += np.abs(reward)
            is_over[i] = (following < 0) | terminal[following]
            state[i] = np.where(following < 0, s, following)
        history = np.concatenate([history[:, 1:], state[:, None]], axis=1)
        discount *= gammas
    bounds = [tail for _, tail in ahead] + 2 * _UNIT * (len(path) + 1) * size
    met = [
        len(np.unique(column[column[:, 0] >= 0], axis=None if frames == 1 else 0))
        for column in np.array(path, np.int64).reshape(-1, len(mdps), frames).swapaxes(0, 1)
    ]
    parts = zip(value.tolist(), bounds.tolist(), met, strict=True)
    return [Evaluation(each, True, bound, states) for each, bound, states in parts]
