"""Memory chain: repeat, at the end, the bit that was shown at the start. Source: bsuite."""

import itertools
from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, parameter

STEP, QUERY, BITS = range(3)  # the bits follow, one number each


@dataclass(frozen=True, kw_only=True)
class MemoryChain(Environment):
    """Say the bit that is asked for, after `memory_length` steps in which actions do nothing.

    State    steps taken, which bit is asked for, `num_bits` bits.
    Start    any bits and any question, all equally likely.
    Actions  zero, one. Only the last one matters.
    Reward   1 for the right bit at the last step, -1 for the wrong one.
    Ends     after memory_length + 1 steps.
    Limit    the same.
    Ours     bsuite shows the bits at the start alone and the question at the end alone, so that its agents need a
             memory. Here the whole state is seen, and is Markov. `hide=` of an observation hides variables always.
    Source   bsuite memory_chain (memory_len: one bit; memory_size: several).

    Attributes:
        memory_length: steps until the query, at least 1.
        num_bits: bits to remember, from 1 to 12.
    """

    memory_length: int = parameter(10, low=1, high=100_000)
    num_bits: int = parameter(1, low=1, high=12)

    name = "memory_chain"
    actions = ("zero", "one")
    version = 1
    layers = {
        "bits": Layer(("0", "1"), ((120, 120, 130), (230, 200, 90)), shape="lettered"),
        "query": Layer("?", (200, 80, 70), shape="lettered"),
        "time": Layer("t", (66, 72, 200), shape="ball"),
    }
    look = Look(color="#CC6677")
    instances = {"length-10": {}, "bits-4": {"memory_length": 2, "num_bits": 4}}
    hyperparameters = {"q_learning": {"default": {"gamma": 1.0}}, "dqn": {"default": {"gamma": 1.0}}}  # by hand

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.memory_length + 1

    def variables(self):
        return {
            "step": range(self.memory_length + 2),
            "query": range(self.num_bits),
            "bits": [range(2)] * self.num_bits,
        }

    def initial_states(self):
        states = [
            (0, query, *bits)
            for bits in itertools.product(range(2), repeat=self.num_bits)
            for query in range(self.num_bits)
        ]
        return [(state, 1 / len(states)) for state in states]

    def age(self, state):
        return state[STEP]

    def transition(self, state, action, out):
        out[STEP] = min(state[STEP] + 1, self.memory_length + 1)

    def is_terminal(self, state):
        return state[STEP] == self.memory_length + 1

    def reward(self, state, action, next_state):
        if next_state[STEP] <= self.memory_length:
            return 0.0
        return 1.0 if action == state[BITS + state[QUERY]] else -1.0

    def grid(self):
        return 3, max(self.memory_length + 2, self.num_bits)

    def draw(self, state, planes):
        for bit in range(self.num_bits):
            planes[0, 0, bit] = 1 + state[BITS + bit]
        planes[1, 1, state[QUERY]] = 1
        planes[2, 2, state[STEP]] = 1
