"""Delayed choice: one choice in an episode of fixed length, paid for later. Of pharos, for the suite v2."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, parameter
from pharos.errors import ParameterError

STEP, RIGHT, CUE, CHOSEN, BITS = range(5)  # the bits follow, one number each


@dataclass(frozen=True, kw_only=True)
class DelayedChoice(Environment):
    """Choose the right action at one step. The episode ends, and pays, `lag` steps later.

    State    steps taken, the right action, the cue, whether the right action was chosen, `irrelevant_bits` bits.
    Start    one of the last `cues` actions is right. It and the bits are drawn evenly. The cue is drawn as below.
    Actions  `num_actions`. Only the one at step length - 1 - lag matters, counted from 0.
    Chance   `cue_error`: in each step the cue is the right action, or with this probability the action after it. If it
             is `moving`, it starts anywhere, and moves by the number of the right action.
    Reward   at the last step 1 if the right action was chosen, else 0. Before that 0.
    Ends     after `length` steps.
    Limit    the same.
    Ours     An umbrella_chain whose lag changes neither the length of episodes nor the number of states. Its bits make
             2^n copies of the same MDP, and its cue can be noisy or move, if `hide=right` hides what is right.
    Source   Ours, after bsuite's umbrella_chain (Osband et al., 2020).

    Attributes:
        length: of an episode, in steps.
        lag: steps between the choice and the last step, below `length`.
        num_actions: at least 2.
        cues: how many actions may be right. With 1, always the last one.
        cue_error: from 0 to 0.5, and 0 for a moving cue.
        moving: whether the cue moves, so that two of them say what is right, and one does not.
        irrelevant_bits: drawn at the start, and never changed. Nothing depends on them.
    """

    length: int = parameter(8, low=1, high=100_000)
    lag: int = parameter(0, low=0)
    num_actions: int = parameter(2, low=2, high=64)
    cues: int = parameter(2, low=1, high=64)
    cue_error: float = parameter(0.0, low=0.0, high=0.5)
    moving: bool = parameter(False)
    irrelevant_bits: int = parameter(0, low=0, high=16)

    name = "delayed_choice"
    version = 1
    layers = {
        "right": Layer("R", (34, 136, 51), shape="goal"),
        "cue": Layer("?", (230, 200, 90), shape="lettered"),
        "time": Layer(("x", "t"), ((120, 120, 130), (66, 72, 200)), shape="ball"),
        "bits": Layer(("0", "1"), ((170, 170, 178), (150, 90, 190)), shape="lettered"),
    }
    look = Look(color="#E377C2")
    instances = {"length-8": {"lag": 7}, "copies-16": {"irrelevant_bits": 4}, "noisy": {"cue_error": 0.25}}
    hyperparameters = {"q_learning": {"default": {"gamma": 1.0}}, "dqn": {"default": {"gamma": 1.0}}}  # by hand

    def validate(self) -> None:
        if self.lag >= self.length:
            raise ParameterError(f"DelayedChoice: lag={self.lag}; expected less than length={self.length}")
        if self.cues > self.num_actions:
            raise ParameterError(f"DelayedChoice: cues={self.cues}; expected at most num_actions={self.num_actions}")

        if self.moving and self.cue_error > 0:
            raise ParameterError(f"DelayedChoice: cue_error={self.cue_error:g}; expected 0 of a moving cue")

    @property
    def actions(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(f"action {action}" for action in range(self.num_actions))

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """Outcomes: the cue is right; it is the next action."""
        return 2 if self.cue_error > 0 else 1

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.length

    def variables(self):
        names = {"step": self.length + 1, "right": self.num_actions, "cue": self.num_actions, "chosen": 2}
        bits = {"bits": [range(2)] * self.irrelevant_bits} if self.irrelevant_bits else {}
        return {name: range(size) for name, size in names.items()} | bits

    def initial_states(self):
        errors = [(0, 1.0 - self.cue_error), (1, self.cue_error)][: self.outcomes]
        if self.moving:
            errors = [(error, 1.0 / self.num_actions) for error in range(self.num_actions)]
        copies = 2**self.irrelevant_bits
        return [
            ((0, right, (right + error) % self.num_actions, 0, *self.bits(copy)), chance / (self.cues * copies))
            for right in range(self.num_actions - self.cues, self.num_actions)
            for error, chance in errors
            for copy in range(copies)
        ]

    def bits(self, copy: int) -> tuple[int, ...]:
        """Bits of a copy of the MDP, by its number."""
        return tuple(copy >> bit & 1 for bit in range(self.irrelevant_bits))

    def age(self, state):
        return state[STEP]

    def probability(self, state, action, outcome):
        return self.cue_error if outcome == 1 else 1.0 - self.cue_error

    def transition(self, state, action, outcome, out):
        if state[STEP] == self.length - 1 - self.lag and action == state[RIGHT]:
            out[CHOSEN] = 1
        out[STEP] = min(state[STEP] + 1, self.length)
        out[CUE] = ((state[CUE] if self.moving else outcome) + state[RIGHT]) % self.num_actions

    def is_terminal(self, state):
        return state[STEP] == self.length

    def reward(self, state, action, next_state):
        return float(next_state[STEP] == self.length and next_state[CHOSEN] == 1)

    def grid(self):
        return 4, max(self.length + 1, self.num_actions, self.irrelevant_bits)

    def draw(self, state, planes):
        planes[0, 0, state[RIGHT]] = 1
        planes[1, 1, state[CUE]] = 1
        planes[2, 2, state[STEP]] = 1 + state[CHOSEN]
        for bit in range(self.irrelevant_bits):
            planes[3, 3, bit] = 1 + state[BITS + bit]
