"""The environmental value norm. Source: Maillard, Mann and Mannor (2014), "How hard is my MDP? The distribution-norm to the rescue"."""

import numpy as np

from pharos.hardness.gaps import _BLOCK, _arrivals, checked, reachable
from pharos.mdp import TabularMDP
from pharos.solvers import Solution


def environmental_value_norm(mdp: TabularMDP, solution: Solution | None = None) -> float:
    """Return the largest standard deviation of the value of the next state.

        max over s, a of sqrt(Var(V*(s') : s' ~ p(. | s, a)))

    over the states that can be reached; 0 for deterministic MDPs. Under sticky actions s is a pair (state, previously executed
    action), and so is s'. With a horizon, V* is that of the first step.

    Args:
        solution: the optimal solution of `mdp`; None: solved here to an error of 1e-9.
    Raises:
        ParameterError: `solution` belongs to another MDP or is not optimal.
    Cost: one pass over the table; 20 to 100 ns a state.
    Source: Maillard, Mann and Mannor (2014), definition 1. (Colosseum centres with the expectation of another state: a slip.)
    """
    solution = checked(mdp, solution)
    if mdp.is_deterministic:
        return 0.0
    live = np.flatnonzero(reachable(mdp) & ~np.asarray(mdp.terminal))
    if mdp.transitions is not None:
        return _general(mdp, solution, live)
    arrived = _arrivals(mdp, reachable(mdp)) if mdp.is_sticky else None
    chance, largest = mdp.chance, 0.0
    starts = set(mdp.start_states.tolist())
    assert mdp.next_states is not None
    v = solution.v
    for start in range(0, live.size, _BLOCK):
        states = live[start : start + _BLOCK]
        table = mdp.next_states[states]
        values = v[table, np.arange(mdp.num_actions)] if mdp.is_sticky else v[table]
        values = np.where(table >= 0, values, 0.0)
        values = values - values.mean(axis=1, keepdims=True)
        if not mdp.is_sticky:
            largest = max(largest, float(_variance(values, chance.chosen, chance.uniform).max()))
            continue
        first = np.isin(states, list(starts))
        if first.any():
            largest = max(largest, float(_variance(values[first], chance.first_chosen, chance.first_uniform).max()))
        assert arrived is not None
        for previous in range(mdp.num_actions):
            met = arrived[states, previous]
            if met.any():
                pulled = values[met][:, previous][:, None]
                found = _variance(values[met], chance.chosen, chance.uniform, chance.previous, pulled)
                largest = max(largest, float(found.max()))
    return float(np.sqrt(max(largest, 0.0)))


def _variance(
    values: np.ndarray, chosen: float, uniform: float, previous: float = 0.0, pulled: np.ndarray | float = 0.0
) -> np.ndarray:
    """(N, A) variances: chosen x values[:, a] + previous x pulled + uniform x any of values."""
    mean = chosen * values + previous * pulled + uniform * values.mean(axis=1, keepdims=True)
    square = chosen * values**2 + previous * np.square(pulled) + uniform * (values**2).mean(axis=1, keepdims=True)
    return square - mean**2


def _general(mdp: TabularMDP, solution: Solution, live: np.ndarray) -> float:
    from pharos.hardness.choices import choices_of

    choices = choices_of(mdp, restart=False)
    v = np.vstack([solution.v.reshape(mdp.num_states, -1), np.zeros((1, solution.v.size // mdp.num_states))])
    column = np.clip(choices.previous, 0, v.shape[1] - 1) if mdp.is_sticky else 0
    values = v[np.minimum(choices.underlying, mdp.num_states), column]
    values[np.isin(choices.underlying, np.flatnonzero(mdp.terminal))] = 0.0
    counted = np.isin(choices.underlying, live)
    rows = (np.flatnonzero(counted)[:, None] * mdp.num_actions + np.arange(mdp.num_actions)).ravel()
    matrix = choices.matrix[rows]
    centre = values.mean()
    mean = matrix @ (values - centre)
    variance = matrix @ (values - centre) ** 2 - mean**2
    return float(np.sqrt(max(0.0, variance.max(initial=0.0))))
