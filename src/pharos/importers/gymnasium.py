"""MDPs from Gymnasium's `P` tables and from matrices."""

from typing import Any

import numpy as np

from pharos.errors import FileFormatError
from pharos.mdp import TabularMDP


def gymnasium(env: Any, *, gamma: float = 0.99, horizon: int | None = None) -> TabularMDP:
    """Return the MDP of an environment with a `P` table, such as FrozenLake, Taxi or CliffWalking.

    Args:
        env: a Gymnasium environment, wrapped or not, or a table P[s][a] = [(probability, next state, reward, terminated), ...].
            The start distribution is `initial_state_distrib` where there is one, else state 0.
        gamma, horizon: of the MDP; Gymnasium's time limit is not taken over.
    Returns:
        A table of next states where every action has one outcome, else a general MDP. A transition that terminates ends the
        episode after its reward, wherever it leads.
    Raises:
        FileFormatError: there is no table, states or actions are missing, or probabilities do not sum to 1.
    """
    inner = getattr(env, "unwrapped", env)
    table = getattr(inner, "P", inner)
    try:
        states, actions = len(table), len(table[0])
        rows = [[list(table[s][a]) for a in range(actions)] for s in range(states)]
    except (TypeError, KeyError, IndexError) as error:
        raise FileFormatError(
            f"{env}: has no table P[s][a] with states 0, 1, ... and the same actions everywhere ({type(error).__name__}: {error})"
        ) from None
    next_states = np.full((states, actions), -1, np.int64)
    rewards = np.zeros((states, actions))
    single = True
    entries: list[tuple[int, int, float]] = []
    for s in range(states):
        for a in range(actions):
            outcomes = _checked(env, s, a, rows[s][a], states)
            single &= len(outcomes) == 1
            for (following, ended), (p, paid) in outcomes.items():
                rewards[s, a] += paid
                if not ended:
                    entries.append((s * actions + a, following, p))
                    next_states[s, a] = following
    start = np.asarray(getattr(inner, "initial_state_distrib", np.eye(states)[0]), np.float64)
    initial: Any = int(start.argmax()) if start.max() == 1 else start / start.sum()
    if single:
        return TabularMDP.from_arrays(next_states, rewards, gamma=gamma, initial=initial, horizon=horizon)
    from scipy import sparse

    row, column, data = (np.array(part) for part in zip(*entries, strict=True)) if entries else ([], [], [])
    matrix = sparse.csr_matrix((data, (row, column)), shape=(states * actions, states))
    return TabularMDP.from_matrices(matrix, rewards, gamma=gamma, initial=initial, horizon=horizon)


def _checked(env: Any, s: int, a: int, outcomes: list, states: int) -> dict[tuple[int, bool], tuple[float, float]]:
    """{(next state, terminated): (probability, probability x reward)}, equal outcomes added up."""
    found: dict[tuple[int, bool], tuple[float, float]] = {}
    total = 0.0
    for outcome in outcomes:
        p, following, reward, ended = outcome
        if not 0 <= following < states or not np.isfinite(reward) or not 0 <= p <= 1:
            raise FileFormatError(
                f"{env}: P[{s}][{a}] has {outcome}; expected a probability, a state below {states}, a finite reward"
            )
        total += p
        if p > 0:
            key = (-1, True) if ended else (int(following), False)
            before = found.get(key, (0.0, 0.0))
            found[key] = (before[0] + p, before[1] + p * reward)
    if abs(total - 1) > 1e-6:
        raise FileFormatError(f"{env}: the probabilities of P[{s}][{a}] sum to {total}; expected 1")
    return found


def matrices(P: Any, R: Any, *, gamma: float = 0.99, initial: Any = 0, horizon: int | None = None) -> TabularMDP:
    """Return the MDP of transition probabilities P and rewards R; as `TabularMDP.from_matrices`."""
    return TabularMDP.from_matrices(P, R, gamma=gamma, initial=initial, horizon=horizon)
