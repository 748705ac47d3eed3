"""Algorithm 1 of the paper in plain Python: a dictionary of tuples and a first-in first-out queue. The builder's twin.

As in the text of the paper (section 3.2), not as printed: every transition is stored, under the state that it leaves.
"""

from collections import deque
from dataclasses import dataclass

from pharos.environments import Environment, State, start_distribution


@dataclass(frozen=True)
class NaiveStateSpace:
    """States in the order of discovery, and what belongs to each."""

    states: list[State]
    successors: list[list[int]]
    terminal: list[bool]
    levels: list[int]
    start_probabilities: list[float]

    @property
    def depth(self) -> int:
        """The largest number of steps from the start states."""
        return max(self.levels)


def build(env: Environment) -> NaiveStateSpace:
    """Enumerate the states of `env`."""
    starts, probabilities = start_distribution(env)
    index = {state: i for i, state in enumerate(starts)}
    states, levels = list(starts), [0] * len(starts)
    successors: list[list[int]] = []
    terminal: list[bool] = []
    queue = deque(range(len(states)))
    while queue:
        current = queue.popleft()
        state = states[current]
        ended = bool(env.is_terminal(state))
        row = []
        for action in range(env.num_actions):
            following = state if ended else env.next_state(state, action)
            if following not in index:
                index[following] = len(states)
                states.append(following)
                levels.append(levels[current] + 1)
                queue.append(index[following])
            row.append(index[following])
        successors.append(row)
        terminal.append(ended)
    return NaiveStateSpace(states, successors, terminal, levels, probabilities.tolist())
