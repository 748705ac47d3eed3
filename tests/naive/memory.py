"""The value of a policy with a memory by going through all histories forwards, one by one, from the start."""

import numpy as np

from naive.mdp import executed, outcomes


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
            for x, weight in enumerate(_answer(policy, history, num_actions) @ executed(mdp, b)):
                value += mdp.gamma**step * p * weight * mdp.rewards[s, x]
                for t, q in outcomes(mdp, s, x):
                    if weight * q > 0 and t >= 0 and not mdp.terminal[t]:
                        key = (int(t), x, (*history, tuple(shown(int(t), x, False))))
                        after[key] = after.get(key, 0.0) + p * weight * q
        mass = after
    return value, len(reached)


def _answer(policy, history, num_actions):
    state = policy.initial_state(1)
    for i, seen in enumerate(history):
        answer, state = policy(np.array([seen], np.float32), state, np.array([i == 0]))
    return np.eye(num_actions)[answer[0]] if answer.ndim == 1 else answer[0]
