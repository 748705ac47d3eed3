"""Gymnasium's `P` table."""

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP

Outcome = tuple[float, int, float, bool]


def gym_p(mdp: TabularMDP) -> dict[int, dict[int, list[Outcome]]]:
    """Return P[s][a] = [(probability, next state, reward, terminated), ...], as Gymnasium's toy texts have it.

    The implicit end becomes one more state S, where there is one. Random actions are written out as outcomes; rewards of a choice
    with several outcomes are those of what is executed.

    Raises:
        ParameterError: under sticky actions the state is a pair, which this table has no room for.
    Cost: Python objects for each transition; for small MDPs.
    """
    if mdp.is_sticky:
        raise ParameterError(
            "P tables have one row a state; under sticky actions the next state depends on the previous action"
        )
    end, rewards, terminal = mdp.num_states, mdp.rewards, np.asarray(mdp.terminal)
    chance, actions = mdp.chance, range(mdp.num_actions)

    def executed(s: int, x: int) -> list[Outcome]:
        reward = float(rewards[s, x])
        if mdp.transitions is None:
            assert mdp.next_states is not None
            targets = [(1.0, int(mdp.next_states[s, x]))]
        else:
            row = mdp.transitions[s * mdp.num_actions + x]
            targets = [(float(p), int(t)) for p, t in zip(row.data, row.indices, strict=True) if p > 0]
            rest = 1.0 - sum(p for p, _ in targets)
            targets += [(rest, -1)] if rest > 1e-12 else []
        return [(p, end if t < 0 else t, reward, t < 0 or bool(terminal[t])) for p, t in targets]

    table: dict[int, dict[int, list[Outcome]]] = {}
    for s in range(mdp.num_states):
        table[s] = {}
        for a in actions:
            if terminal[s]:
                table[s][a] = [(1.0, s, 0.0, True)]
                continue
            outcomes = [(chance.chosen * p, *rest) for p, *rest in executed(s, a)] if chance.chosen else []
            if chance.uniform:
                for x in actions:
                    outcomes += [(chance.uniform / mdp.num_actions * p, *rest) for p, *rest in executed(s, x)]
            table[s][a] = outcomes  # type: ignore[assignment]
    if mdp.has_ends or mdp.transitions is not None:
        table[end] = {a: [(1.0, end, 0.0, True)] for a in actions}
    return table
