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


@dataclass(frozen=True)
class NaiveOutcomes:
    """The same with chance: for each state and action the possible outcomes, (next state, probability) in order."""

    states: list[State]
    outcomes: list[list[list[tuple[int, float]]]]
    terminal: list[bool]
    levels: list[int]


def build_outcomes(env: Environment) -> NaiveOutcomes:
    """Enumerate the states of `env`, whose actions have outcomes: row after row, action after action, outcome after
    outcome.
    """
    states, _ = start_distribution(env)
    index = {state: i for i, state in enumerate(states)}
    levels = [0] * len(states)
    found: list[list[list[tuple[int, float]]]] = []
    terminal: list[bool] = []
    for current, state in enumerate(states):  # which grows meanwhile
        terminal.append(bool(env.is_terminal(state)))
        if terminal[-1]:
            found.append([[(current, 1.0)] for _ in range(env.num_actions)])
            continue
        found.append([])
        for action in range(env.num_actions):
            found[-1].append([])
            for outcome in range(env.outcomes):
                probability = float(env.probability(state, action, outcome))
                if probability == 0:
                    continue
                following = env.next_state(state, action, outcome)
                if following not in index:
                    index[following] = len(states)
                    states.append(following)
                    levels.append(levels[current] + 1)
                found[-1][-1].append((index[following], probability))
    return NaiveOutcomes(states, found, terminal, levels)
