"""The value of a policy from simulated episodes, with an interval that holds it almost surely."""

import math

import numpy as np

from pharos.policies.query import QueriedPolicy

# Probability that an interval misses the value.
RISK = 0.01


def estimate(
    answers: QueriedPolicy, return_range: tuple[float, float], episodes: int, rng: np.random.Generator
) -> tuple[float, float]:
    """(mean return, half the width of the interval around it) of simulated episodes.

    Args:
        return_range: the lowest and the highest return that an episode can have.
    Source: Maurer and Pontil (2009), theorem 4.
    """
    mdp, chance = answers.mdp, answers.mdp.chance
    steps = mdp.horizon or math.ceil(math.log(1e-9) / math.log(mdp.gamma)) if mdp.gamma > 0 else 1
    states = rng.choice(mdp.start_states, episodes, p=mdp.start_probabilities)
    previous, rows = np.full(episodes, mdp.num_actions), answers.first_rows(states)
    returns, alive = np.zeros(episodes), np.arange(episodes)
    for step in range(steps):
        s, b = states[alive], previous[alive]
        probabilities = answers.of(rows[alive])
        chosen = (probabilities.cumsum(axis=1) < rng.random((alive.size, 1))).sum(axis=1).clip(max=mdp.num_actions - 1)
        executed = chance.draw(chosen, b, mdp.num_actions, rng)
        returns[alive] += mdp.gamma**step * mdp.reward_table.rows(s)[np.arange(alive.size), executed]
        following = mdp.dynamics.sample(s, executed, rng)
        states[alive], previous[alive] = following, executed
        goes_on = (following >= 0) & ~np.asarray(mdp.terminal)[following]
        before, alive = rows[alive][goes_on], alive[goes_on]
        rows[alive] = answers.next_rows(before, executed[goes_on], following[goes_on])
        if not alive.size:
            break
    return float(returns.mean()), _half_width(returns, *return_range)


def _half_width(returns: np.ndarray, low: float, high: float) -> float:
    """Half the width of an interval that holds the mean with probability 1 - RISK, for returns in [low, high]."""
    count, log = len(returns), math.log(4 / RISK)
    spread = math.sqrt(2 * float(returns.var(ddof=1)) * log / count)
    return spread + 7 * (high - low) * log / (3 * (count - 1))
