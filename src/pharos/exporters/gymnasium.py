"""Gymnasium's `P` table."""

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, require_mdp, rewards_of_outcomes, rewards_of_space, rewards_of_staying
from pharos.state_space import load

Outcome = tuple[float, int, float, bool]


@require_mdp
def gym_p(mdp: TabularMDP) -> dict[int, dict[int, list[Outcome]]]:
    """Return P[s][a] = [(probability, next state, reward, terminated), ...], as Gymnasium's toy texts have it.

    The implicit end becomes one more state S, where there is one. Random actions are written out as outcomes. Each
    outcome has its own reward where the MDP is of an environment and has its rewards; else the expected one of what is
    executed.

    Raises:
        ParameterError: under sticky actions the state is a pair, which this table has no room for.
    Cost: Python objects for each transition; for small MDPs.
    """
    if mdp.is_sticky:
        raise ParameterError(
            "P tables have one row a state; under sticky actions the next state depends on the previous action"
        )
    end, num_actions, rewards, terminal = mdp.num_states, mdp.num_actions, mdp.rewards, np.asarray(mdp.terminal)
    chosen, _, uniform = mdp.chance.triple
    own = _outcomes_of_environment(mdp)
    table: dict[int, dict[int, list[Outcome]]] = {}
    for s in range(mdp.num_states):
        if terminal[s]:
            table[s] = {a: [(1.0, s, 0.0, True)] for a in range(num_actions)}
            continue
        outcomes = mdp.dynamics.outcomes(np.full(num_actions, s), np.arange(num_actions))
        executed: list[list[Outcome]] = [[] for _ in range(num_actions)]
        for x, t, p in zip(*(each.tolist() for each in outcomes), strict=True):
            executed[x].append((p, t, float(rewards[s, x]), t == end or bool(terminal[t])))
        for a in range(num_actions if own else 0):
            row = own[s * num_actions + a]
            largest = max(1.0, *(abs(r) for _, r in row))
            if abs(sum(p * r for (_, r), p in row.items()) - rewards[s, a]) <= 1e-9 * largest:
                executed[a] = [(p, t, r, bool(terminal[t])) for (t, r), p in row.items()]
        mixed = [(uniform / num_actions * p, t, r, e) for each in executed for p, t, r, e in each] if uniform else []
        table[s] = {
            a: ([(chosen * p, t, r, e) for p, t, r, e in executed[a]] if chosen else []) + mixed
            for a in range(num_actions)
        }
    if mdp.has_ends:
        table[end] = {a: [(1.0, end, 0.0, True)] for a in range(num_actions)}
    return table


def _outcomes_of_environment(mdp: TabularMDP) -> list[dict[tuple[int, float], float]]:
    """Of each state and action: (next state, reward) -> probability, by the rules where the MDP has chance and is of an
    environment; else nothing.
    """
    space = (
        None
        if mdp.folder is None or mdp.dynamics.is_deterministic
        else load(mdp.folder, verify=False, environment=mdp.environment)
    )
    if space is None or space.environment is None:
        return []
    rows = np.arange(space.num_states * space.num_actions)
    if space.has_chance:
        which, successors, probabilities = space.outcomes.entries(0, space.num_states, space.num_actions)
        arrays = [which, successors, rewards_of_outcomes(space), (1.0 - mdp.laziness) * probabilities]
    else:  # lazy actions alone
        paid = rewards_of_space(space).array.ravel()
        arrays = [rows, np.ravel(space.successors), paid, np.full(len(rows), 1.0 - mdp.laziness)]
    if mdp.laziness:
        stays = rows // space.num_actions, rewards_of_staying(space).array.ravel(), np.full(len(rows), mdp.laziness)
        arrays = [np.concatenate(pair) for pair in zip(arrays, (rows, *stays), strict=True)]
    table: list[dict[tuple[int, float], float]] = [{} for _ in rows]
    for row, following, reward, probability in zip(*(each.tolist() for each in arrays), strict=True):
        table[row][following, reward] = table[row].get((following, reward), 0.0) + probability
    return table
