"""A puzzle that goes on where it is solved, as those who publish its diameter count."""

import numpy as np

from pharos import TabularMDP


def without_end(space):
    """The MDP of the moves alone, paying nothing; the solved position is the only terminal one of the space."""
    env, table = space.environment, np.array(space.successors)
    (solved,) = np.flatnonzero(space.terminal)
    position = space.state(int(solved))
    table[solved] = [space.index(env.next_state(position, action)) for action in range(env.num_actions)]
    return TabularMDP.from_arrays(table, np.zeros(table.shape))
