"""Small MDPs of every kind, for property tests."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pharos.mdp import TabularMDP, random_actions, sticky_actions

probabilities = st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0])
gammas = st.sampled_from([0.0, 0.5, 0.9, 0.99])
gammas_near_1 = st.sampled_from([0.9, 0.999, 0.9998, 1 - 1e-5, 1 - 1e-7])
rewards_of_games = st.sampled_from([-1.0, 0.0, 0.1, 0.5, 1.0])


@st.composite
def deterministic_mdps(draw, max_states: int = 6, max_actions: int = 3, rewards=rewards_of_games, ends: bool = True):
    """A deterministic MDP, with transitions to the end (-1), terminal states and one or several start states."""
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, max_actions))
    shape = (num_states, num_actions)
    lowest = -1 if ends else 0
    next_states = draw(hnp.arrays(np.int32, shape, elements=st.integers(lowest, num_states - 1)))
    paid = draw(hnp.arrays(np.float64, shape, elements=rewards))
    terminal = draw(hnp.arrays(np.bool_, num_states))
    next_states[terminal] = np.flatnonzero(terminal)[:, None]
    paid[terminal] = 0.0
    starts = draw(st.lists(st.integers(0, num_states - 1), min_size=1, max_size=3))
    gamma = draw(gammas)
    mdp = TabularMDP.from_arrays(next_states, paid, gamma=gamma, terminal=terminal)
    return mdp.with_initial(starts[0] if len(starts) == 1 else starts)


@st.composite
def general_mdps(draw, max_states: int = 5, max_actions: int = 3):
    """An MDP with arbitrary transition probabilities, some of which end the episode."""
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, max_actions))
    weights = draw(
        hnp.arrays(np.float64, (num_states, num_actions, num_states + 1), elements=st.sampled_from([0.0, 1.0, 2.0]))
    )
    weights[..., 0] += weights.sum(axis=2) == 0
    matrix = (weights / weights.sum(axis=2, keepdims=True))[..., :num_states]
    paid = draw(hnp.arrays(np.float64, (num_states, num_actions), elements=rewards_of_games))
    return TabularMDP.from_matrices(matrix, paid, gamma=draw(gammas))


@st.composite
def hard_mdps(draw):
    """MDPs whose values are hard on floats: gamma near 1, rewards that are no sums of powers of 2, values of 1e12 and
    more."""
    mdp = draw(small_mdps(max_states=4))
    scale = draw(st.sampled_from([0.7, 1.0, 1e-3, 1e12]))
    return mdp.with_gamma(draw(gammas_near_1)).with_rewards(scale * mdp.rewards)


@st.composite
def small_mdps(draw, **options):
    """Any of the above, with any chance."""
    mdp = draw(st.one_of(deterministic_mdps(**options), general_mdps()))
    first, second = draw(probabilities), draw(probabilities)
    kind = draw(st.sampled_from(["plain", "random", "sticky", "random outside", "sticky outside"]))
    if kind == "random":
        return random_actions(mdp, first)
    if kind == "sticky":
        return sticky_actions(mdp, first)
    if kind == "random outside":
        return random_actions(sticky_actions(mdp, first), second)
    if kind == "sticky outside":
        return sticky_actions(random_actions(mdp, first), second)
    return mdp
