"""Umbrella chain: whether to take an umbrella is decided at once and pays at the end. Source: bsuite."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, parameter

STEP, NEED, HAVE = range(3)
LEAVE, TAKE = range(2)


@dataclass(frozen=True, kw_only=True)
class UmbrellaChain(Environment):
    """Take an umbrella or leave it in the first step. After `chain_length` steps it shows whether that was right.

    State    steps taken, whether an umbrella is needed, whether there is one.
    Start    needed or not, there or not, all equally likely.
    Actions  leave, take. Only the first one matters.
    Reward   at the last step 1 if an umbrella is there exactly when it is needed, else -1. Before that 0.
    Ends     after `chain_length` steps.
    Limit    the same.
    Ours     bsuite pays 1 or -1 by the toss of a coin at each step but the last, which has mean 0. Rewards here are the
             means. Its distractors are random numbers beside the observation and no part of a state.
    Source   bsuite umbrella_chain (umbrella_length, umbrella_distract).

    Attributes:
        chain_length: at least 1.
    """

    chain_length: int = parameter(10, low=1, high=1_000_000)

    name = "umbrella_chain"
    actions = ("leave", "take")
    version = 1
    layers = {
        "need": Layer(("-", "R"), ((230, 200, 90), (60, 110, 190)), shape="lettered"),
        "have": Layer(("-", "U"), ((150, 150, 150), (150, 90, 190)), shape="lettered"),
        "time": Layer("t", (66, 72, 200), shape="ball"),
    }
    look = Look(color="#117733")
    instances = {"length-10": {}, "length-100": {"chain_length": 100}}
    foreign_parameters = {"n_distractor": "random numbers beside an observation are no part of a state"}
    hyperparameters = {"q_learning": {"default": {"gamma": 1.0}}, "dqn": {"default": {"gamma": 1.0}}}  # by hand

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.chain_length

    def variables(self):
        return {"step": range(self.chain_length + 1), "need": range(2), "have": range(2)}

    def initial_states(self):
        return [((0, need, have), 0.25) for need in range(2) for have in range(2)]

    def age(self, state):
        return state[STEP]

    def transition(self, state, action, out):
        out[STEP] = min(state[STEP] + 1, self.chain_length)
        if state[STEP] == 0:
            out[HAVE] = action

    def is_terminal(self, state):
        return state[STEP] == self.chain_length

    def reward(self, state, action, next_state):
        if next_state[STEP] < self.chain_length:
            return 0.0
        return 1.0 if next_state[HAVE] == next_state[NEED] else -1.0

    def grid(self):
        return 2, self.chain_length + 1

    def draw(self, state, planes):
        planes[0, 0, 0] = 1 + state[NEED]
        planes[1, 0, 1] = 1 + state[HAVE]
        planes[2, 1, state[STEP]] = 1
