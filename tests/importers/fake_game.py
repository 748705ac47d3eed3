"""A game with the interface of PettingZoo's AEC: two players take one or two stones; who takes the last one wins."""

import numpy as np
from gymnasium import spaces


class Stones:
    possible_agents = ["first", "second"]

    def __init__(self, stones=4):
        self.size = stones

    def action_space(self, agent):
        return spaces.Discrete(2)

    def observation_space(self, agent):
        return spaces.Dict({"observation": spaces.Discrete(self.size + 1), "action_mask": spaces.MultiBinary(2)})

    def reset(self, seed=None, options=None):
        self.stones, self.agents, self.agent_selection = self.size, list(self.possible_agents), "first"
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations, self.rewards = dict(self.terminations), dict.fromkeys(self.agents, 0.0)

    def observe(self, agent):
        return {"observation": self.stones, "action_mask": np.array([1, self.stones > 1], np.int8)}

    def step(self, action):
        agent, other = self.agent_selection, "second" if self.agent_selection == "first" else "first"
        self.stones = max(self.stones - action - 1, 0)
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self.agent_selection = other
        if self.stones == 0:
            self.rewards = {agent: 1.0, other: -1.0}
            self.terminations = dict.fromkeys(self.agents, True)


def clumsy(observation, legal, rng):
    """Takes one stone."""
    return 0
