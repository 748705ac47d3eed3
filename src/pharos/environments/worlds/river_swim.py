"""River swim: a small reward downstream, a large one far up against the current. Source: Strehl and Littman (2008)."""

from dataclasses import dataclass

from pharos.environments.base import Environment, Layer, Look, integers, parameter
from pharos.errors import ParameterError

LEFT, RIGHT = range(2)
BACK, STAY, FORWARD = range(3)  # outcomes, if there is chance


@dataclass(frozen=True, kw_only=True)
class RiverSwim(Environment):
    """Swim in a row of `length` places: to the left always succeeds, to the right is against the current.

    State    (place,), counted from the left.
    Start    one of `starts`, all equally likely.
    Actions  left, right.
    Chance   right goes one place forward with probability `forward`, back with `backward`, and stays otherwise. At the
             left end it goes forward with `forward_at_ends` and else stays. At the right end it stays with that and
             else goes back. Besides, with `p_lazy` nothing happens, else with `p_rand` an action is drawn evenly.
    Reward   left_reward for left at the left end, right_reward for right at the right end. Both are paid if the swimmer
             stays there, or with `pays_for_action` also if he is swept away.
    Ends     never.
    Limit    Colosseum's shortest horizon without a current, `length` steps, 20 times that against one.
    Source   Strehl and Littman (2008), "An analysis of model-based interval estimation for Markov decision processes".
             `osband`: Osband, Russo and Van Roy (2013), "(More) efficient reinforcement learning via posterior
             sampling". `colosseum`: Conserva and Rauber (2022), whose water is still and whose chance is `p_lazy` and
             `p_rand`.

    Attributes:
        length: places, at least 2.
        forward, backward: of right, in the middle.
        forward_at_ends: of right at both ends. None stands for `forward`.
        left_reward, right_reward: at the ends.
        pays_for_action: whether it is the choice that pays.
        starts: places.
        p_lazy, p_rand: from 0 to 0.9999.
    """

    length: int = parameter(6, low=2, high=1_000_000)
    forward: float = parameter(0.3, low=0.0, high=1.0)
    backward: float = parameter(0.1, low=0.0, high=1.0)
    forward_at_ends: float | None = parameter(None, kind=float, low=0.0, high=1.0)
    left_reward: float = parameter(5.0)
    right_reward: float = parameter(10000.0)
    pays_for_action: bool = parameter(False)
    starts: tuple[int, ...] = parameter((1, 2), kind=integers("a place, counted from 0", lambda place: place >= 0))
    p_lazy: float = parameter(0.0, low=0.0, high=0.9999)
    p_rand: float = parameter(0.0, low=0.0, high=0.9999)

    name = "river_swim"
    actions = ("left", "right")
    version = 1
    layers = {
        "small": Layer("s", (214, 186, 92), shape="ball"),
        "large": Layer("L", (236, 236, 236), shape="goal"),
        "swimmer": Layer("S", (66, 72, 200), shape="agent"),
    }
    look = Look(color="#44AA99")
    instances = {
        "strehl-littman": {},
        "osband": {
            **{"forward": 0.35, "backward": 0.05, "forward_at_ends": 0.6, "starts": (0,)},
            **{"left_reward": 0.005, "right_reward": 1.0, "pays_for_action": True},
        },
        "colosseum": {
            **{"length": 10, "forward": 1.0, "backward": 0.0, "starts": (0,), "p_rand": 0.17},
            **{"left_reward": 0.005, "right_reward": 1.0, "pays_for_action": True},
        },
    }
    foreign_parameters = {"size": "write length"}
    hyperparameters = {  # chosen by hand
        "q_learning": {"default": {"initial_q": 0.0}},
        "dqn": {"default": {"learning_rate": 0.001, "target_update_interval": 250, "exploration_fraction": 0.5}},
    }

    def validate(self) -> None:
        if self.forward + self.backward > 1 + 1e-12:
            raise ParameterError(
                f"RiverSwim: forward={self.forward}, backward={self.backward}; expected a sum of at most 1"
            )
        if max(self.starts) >= self.length:
            raise ParameterError(f"RiverSwim: starts={self.starts}; expected places from 0 to {self.length - 1}")

    @property
    def outcomes(self) -> int:  # type: ignore[override]
        """Back, stay, forward; 1 if nothing is left to chance."""
        still = self.forward == 1 and self.at_ends == 1
        return 1 if still and self.p_lazy == 0 and self.p_rand == 0 else 3

    @property
    def at_ends(self) -> float:
        """`forward_at_ends`, or `forward` if it is None."""
        return self.forward if self.forward_at_ends is None else self.forward_at_ends

    @property
    def max_episode_steps(self) -> int:  # type: ignore[override]
        return self.length * (1 if self.forward == 1 else 20)

    def variables(self):
        return {"place": range(self.length)}

    def initial_states(self):
        return [((place,), 1 / len(self.starts)) for place in self.starts]

    def probability(self, state, action, outcome):
        if self.outcomes == 1:
            return 1.0
        first, last = state[0] == 0, state[0] == self.length - 1
        left = float(outcome == (STAY if first else BACK))
        if first:
            right = self.at_ends if outcome == FORWARD else 1.0 - self.at_ends if outcome == STAY else 0.0
        elif last:
            right = self.at_ends if outcome == STAY else 1.0 - self.at_ends if outcome == BACK else 0.0
        elif outcome == STAY:
            right = max(1.0 - self.forward - self.backward, 0.0)
        else:
            right = self.forward if outcome == FORWARD else self.backward
        share = 1.0 - self.p_rand / 2 if action == RIGHT else self.p_rand / 2
        swims = share * right + (1.0 - share) * left
        return (1.0 - self.p_lazy) * swims + self.p_lazy * float(outcome == STAY)

    def transition(self, state, action, outcome, out):
        step = outcome - STAY
        if self.outcomes == 1:
            step = 1 if action == RIGHT else -1
        out[0] = min(max(state[0] + step, 0), self.length - 1)

    def reward(self, state, action, next_state):
        if next_state[0] != state[0] and not self.pays_for_action:
            return 0.0
        if action == LEFT:
            return self.left_reward if state[0] == 0 else 0.0
        return self.right_reward if state[0] == self.length - 1 else 0.0

    def grid(self):
        return 1, self.length

    def draw(self, state, planes):
        planes[0, 0, 0] = 1
        planes[1, 0, self.length - 1] = 1
        planes[2, 0, state[0]] = 1
