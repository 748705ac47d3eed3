"""How long uniform play takes to meet a large reward: what exploration alone costs, whatever is learnt.

Covering: how long random play takes to see everything. Source: Laidlaw, Russell and Dragan (2023), appendix.

The bound on the covering length: Even-Dar and Mansour (2003).
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.visitation.occupancy import Walk
from pharos.mdp import TabularMDP, require_mdp

LARGE = 0.5  # of the largest reward


@dataclass(frozen=True)
class ExplorationTime:
    """When uniform play first meets a large reward.

    Attributes:
        steps: expected, episodes after episodes; infinite where it never does.
        episodes: expected, the one in which it happens included: 1 / probability.
        probability: that an episode meets one.
        threshold: a reward above it is large.
        horizon: steps of an episode.
    """

    steps: float
    episodes: float
    probability: float
    threshold: float
    horizon: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {**vars(self), "value": self.steps, "log10_episodes": float(np.log10(self.episodes))}

    def __str__(self) -> str:
        return f"{self.steps:.6g} steps, {self.episodes:.6g} episodes"


@require_mdp
def exploration_time(mdp: TabularMDP, *, horizon: int | None = None) -> ExplorationTime:
    """Return the expected steps, and episodes, after which uniform play has executed an action with a large reward.

    With p the probability that an episode meets one, and l the expected steps of an episode up to its end or to there:
    1 / p episodes, and l / p steps, by Wald's identity. A reward r(s, a) is large above half of the largest one.

    Args:
        horizon: steps of an episode; None: that of the MDP.
    Raises:
        UndefinedMeasure: there are no episodes, or no reward is positive.
    Cost: O(S A) a step.
    Source: pharos; goal-finding by random walk, as in Koenig and Simmons (1996).
    """
    steps = mdp.horizon if horizon is None else horizon
    if steps is None:
        raise UndefinedMeasure("exploration_time is defined for episodes of T steps: give a horizon")
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ParameterError(f"horizon is {steps!r}; expected a whole number of steps, at least 1")
    rewards, live = mdp.rewards, ~np.asarray(mdp.terminal)
    threshold = LARGE * float(rewards.max(initial=0.0))
    if not threshold > 0:
        raise UndefinedMeasure("exploration_time: no reward is positive, so none is large")
    is_large = rewards > threshold
    mass = np.zeros((mdp.num_states, 1))
    np.add.at(mass[:, 0], mdp.start_states, mdp.start_probabilities)
    met = length = 0.0
    chance = mdp.chance.first
    for _ in range(int(steps)):
        mass[~live] = 0.0
        total = mass.sum(axis=1, keepdims=True)
        length += float(total.sum())
        executed = chance.executed(mass, np.repeat(total / mdp.num_actions, mdp.num_actions, axis=1))
        met += float(executed[is_large].sum())
        executed[is_large] = 0.0
        if not executed.any():
            break
        mass = mdp.dynamics.pushed(executed, mdp.width)
        chance = mdp.chance
    met = min(met, 1.0)
    if met <= 0.0:
        return ExplorationTime(float("inf"), float("inf"), 0.0, threshold, int(steps))
    return ExplorationTime(length / met, 1 / met, met, threshold, int(steps))


# Covering -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Covering:
    """Ingredients of the covering length.

    Attributes:
        omega_max: min over the pairs (s, a) that can be met of max over t of mu_t(s, a).
        omega_sum: the same with the sum over t.
        length_bound: ln(2 S A) / omega_max, episodes after which random play has covered all pairs with probability
            1/2.
        num_states: S, the states that can be met.
        conventions: horizon and exploration policy.
    """

    omega_max: float
    omega_sum: float
    length_bound: float
    num_states: int
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "omega_max": self.omega_max,
            "omega_sum": self.omega_sum,
            "length_bound": self.length_bound,
            "num_states": self.num_states,
        }

    def __str__(self) -> str:
        return f"omega {self.omega_max:.6g} (sum {self.omega_sum:.6g}), length at most {self.length_bound:.6g} episodes"


@require_mdp
def covering(mdp: TabularMDP, *, horizon: int | None = None) -> Covering:
    """Return how rarely random play meets the rarest state and action.

        mu_t(s, a) = P(s_t = s, a_t = a) for uniform play from the start;  L <= ln(2 S A) / min over s, a of max over t
        of mu_t(s, a)

    Pairs run over the states that can be met within T steps and are not terminal; under sticky actions over pairs
    (state, previously executed action), and a start without one.

    Args:
        horizon: T; None: that of the MDP.
    Raises:
        UndefinedMeasure: there is no horizon.
    Cost: O(S A) for each of the T steps, and O(S) memory, under sticky actions O(S A). 200 steps on the 2.4 million
        states of `breakout/12x8x1` take 1.4 s.
    Source: Laidlaw, Russell and Dragan (2023), section 3 and appendix; the bound: Even-Dar and Mansour (2003).
    """
    steps = mdp.horizon if horizon is None else horizon
    if steps is None:
        raise UndefinedMeasure("covering is defined for episodes of T steps: give a horizon")
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ParameterError(f"horizon is {steps!r}; expected a whole number of steps, at least 1")
    largest, total = _occupied(mdp, int(steps))
    states = len(total)
    if not states:
        raise UndefinedMeasure("covering: every start state is terminal, so that nothing is played")
    omega_max = float(largest.min()) / mdp.num_actions
    omega_sum = float(total.min()) / mdp.num_actions
    length = math.log(2 * states * mdp.num_actions) / omega_max
    return Covering(omega_max, omega_sum, length, states, {"horizon": int(steps), "exploration": "uniform"})


def _occupied(mdp: TabularMDP, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """(max over t, sum over t) of the probability of each node that uniform play meets and that is not terminal."""
    walk = Walk(mdp, None, steps)
    largest, total = np.zeros((mdp.num_states, walk.width)), np.zeros((mdp.num_states, walk.width))
    alone = np.zeros((0, 1))  # under sticky actions a start has no previous action: nodes of their own
    for now, _ in walk.distributions():
        if now.first and mdp.is_sticky:
            alone = now.mass[walk.live]
            continue
        np.maximum(largest, now.mass, out=largest)
        total += now.mass
    most, often = (np.append(each[walk.live], alone) for each in (largest, total))
    return most[often > 0], often[often > 0]
