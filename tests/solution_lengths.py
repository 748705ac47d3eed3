"""The least number of moves to the solved position of a puzzle whose moves can be taken back."""

import numpy as np


def solution_lengths(space, actions=None):
    """(S,) int64, by breadth-first search from the solved position over the moves of the table; from itself, which is
    terminal, over those of the rules. actions: the moves that may be made; all of them."""
    env = space.environment
    actions = list(range(env.num_actions) if actions is None else actions)
    (solved,) = np.flatnonzero(space.terminal)
    position = space.state(int(solved))
    lengths = np.full(space.num_states, -1, np.int64)
    lengths[solved] = 0
    following = {space.index(env.next_state(position, action)) for action in actions} - {int(solved)}
    frontier, level = np.array(sorted(following)), 1
    while frontier.size:
        lengths[frontier] = level
        reached = np.zeros(space.num_states, np.bool_)
        reached[space.successors[frontier][:, actions]] = True
        frontier, level = np.flatnonzero(reached & (lengths < 0)), level + 1
    assert lengths.min() == 0
    return lengths
