"""Gymnasium's `P` table."""

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, paid_outcomes, require_mdp

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
    end, num_actions, terminal = mdp.num_states, mdp.num_actions, np.asarray(mdp.terminal)
    chosen, _, uniform = mdp.chance.triple
    rows: list[list[Outcome]] = [[] for _ in range(mdp.num_states * num_actions)]
    for row, t, r, p in zip(*(column.tolist() for column in paid_outcomes(mdp)), strict=True):
        rows[row].append((p, t, r, t == end or bool(terminal[t])))
    table: dict[int, dict[int, list[Outcome]]] = {}
    for s in range(mdp.num_states):
        if terminal[s]:
            table[s] = {a: [(1.0, s, 0.0, True)] for a in range(num_actions)}
            continue
        executed = rows[s * num_actions : (s + 1) * num_actions]
        mixed = [(uniform / num_actions * p, t, r, e) for each in executed for p, t, r, e in each] if uniform else []
        table[s] = {
            a: ([(chosen * p, t, r, e) for p, t, r, e in executed[a]] if chosen else []) + mixed
            for a in range(num_actions)
        }
    if mdp.has_ends:
        table[end] = {a: [(1.0, end, 0.0, True)] for a in range(num_actions)}
    return table
