"""How long uniform play takes to meet a large reward: what exploration alone costs, whatever is learnt."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
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
