"""Discounting chain: choose, at once, which of several rewards to wait for. Source: bsuite."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pharos.environments.base import Environment, Layer, Look, integers, parameter
from pharos.errors import ParameterError

STEP, CHAIN = range(2)


@dataclass(frozen=True, kw_only=True)
class DiscountingChain(Environment):
    """Choose a chain in the first step. Each pays once, after a delay of its own, and one of them a bonus.

    State    steps taken, the chain (-1 before the first step).
    Actions  one for each chain. Only the first one matters.
    Reward   1 at the step of the delay of the chain, 1 + bonus on the chain `mapping_seed` modulo their number.
    Ends     after the longest delay.
    Limit    the same.
    Source   bsuite discounting_chain, with a bonus of 0.1 and episodes of 100 steps.

    Attributes:
        delays: of the chains, in steps, each another one.
        mapping_seed: which chain has the bonus, modulo their number.
        bonus: at least 0.
    """

    delays: tuple[int, ...] = parameter((1, 3, 10, 30, 100), kind=integers("at least 1", lambda delay: delay >= 1))
    mapping_seed: int = parameter(0, low=0)
    bonus: float = parameter(0.1, low=0.0)

    name = "discounting_chain"
    version = 1
    layers = {
        "prize": Layer(("1", "2"), ((214, 186, 92), (230, 140, 60)), shape="lettered"),
        "agent": Layer("A", (66, 72, 200)),
    }
    look = Look(color="#9467BD")
    instances = {
        "bonus-1": {},
        "bonus-100": {"mapping_seed": 4},
        "delays-10": {"delays": (1, 3, 10), "mapping_seed": 2},
    }
    hyperparameters = {"q_learning": {"default": {"gamma": 1.0}}, "dqn": {"default": {"gamma": 1.0}}}  # by hand

    def validate(self) -> None:
        if len(set(self.delays)) < len(self.delays):
            raise ParameterError(f"DiscountingChain: delays={self.delays}; expected each another one")

    @property
    def actions(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(f"wait for {delay}" for delay in self.delays)

    @cached_property
    def last(self) -> int:
        """The longest delay."""
        return max(self.delays)

    @cached_property
    def prizes(self) -> np.ndarray:
        """(chains,) float64: reward of each chain."""
        prizes = np.ones(len(self.delays))
        prizes[self.mapping_seed % len(prizes)] += self.bonus
        return prizes

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.last

    def variables(self):
        return {"step": range(self.last + 1), "chain": range(-1, len(self.delays))}

    def initial_state(self):
        return (0, -1)

    def age(self, state):
        return state[STEP]

    def transition(self, state, action, out):
        out[STEP] = min(state[STEP] + 1, self.last)
        if state[STEP] == 0:
            out[CHAIN] = action

    def is_terminal(self, state):
        return state[STEP] == self.last

    def reward(self, state, action, next_state):
        chain = next_state[CHAIN]
        return self.prizes[chain] if next_state[STEP] == self.delays[chain] else 0.0

    def grid(self):
        return len(self.delays), self.last + 1

    def draw(self, state, planes):
        for chain in range(len(self.delays)):
            planes[0, chain, self.delays[chain]] = 1 if self.prizes[chain] == 1.0 else 2
        planes[1, max(state[CHAIN], 0), state[STEP]] = 1
