"""The value of a policy with a memory by going through all histories forwards, one by one, from the start."""

import numpy as np

from naive.mdp import outcomes


def value_of_memory(policy, mdp, shown, steps):
    """(value, number of histories that are reached): the policy reads each history of observations anew.

    Args:
        shown: (state, previously executed action or A, whether it is the first step) -> observation.
    """
    num_actions, value = mdp.num_actions, 0.0
    mass = {}
    for s, p in zip(mdp.start_states.tolist(), mdp.start_probabilities.tolist(), strict=True):
        if not mdp.terminal[s]:
            key = (s, num_actions, (tuple(shown(s, num_actions, True)),))
            mass[key] = mass.get(key, 0.0) + p
    reached = set()
    for step in range(steps):
        after = {}
        for (s, b, history), p in mass.items():
            reached.add((s, b, history))
            chosen = _answer(policy, history, num_actions)
            executed = np.zeros(num_actions)
            for a in range(num_actions):
                if b == num_actions:
                    executed += chosen[a] * (1 - mdp.chance.first_chosen) / num_actions
                    executed[a] += chosen[a] * mdp.chance.first_chosen
                else:
                    executed += chosen[a] * mdp.chance.uniform / num_actions
                    executed[a] += chosen[a] * mdp.chance.chosen
                    executed[b] += chosen[a] * mdp.chance.previous
            for x in range(num_actions):
                value += mdp.gamma**step * p * executed[x] * mdp.rewards[s, x]
                for t, q in outcomes(mdp, s, x):
                    if executed[x] * q > 0 and t >= 0 and not mdp.terminal[t]:
                        key = (int(t), x, (*history, tuple(shown(int(t), x, False))))
                        after[key] = after.get(key, 0.0) + p * executed[x] * q
        mass = after
    return value, len(reached)


def _answer(policy, history, num_actions):
    state = policy.initial_state(1)
    for i, seen in enumerate(history):
        answer, state = policy(np.array([seen], np.float32), state, np.array([i == 0]))
    return np.eye(num_actions)[answer[0]] if answer.ndim == 1 else answer[0]
