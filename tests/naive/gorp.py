"""GORP by enumeration: the slow twin of pharos.hardness.gorp, and returns by every path that play can take."""

import itertools
import math

import numpy as np

from naive.mdp import augmented, outcomes


def returns_of_paths(mdp, policy, steps):
    """{return: probability} by following every path; policy (S, A)."""
    start = augmented(mdp)[2]
    width = mdp.num_actions + 1
    found = {}

    def follow(state, previous, t, probability, total):
        if t == steps or state < 0 or mdp.terminal[state]:
            key = round(total, 6)
            found[key] = found.get(key, 0.0) + probability
            return
        for b in range(mdp.num_actions):
            chance = mdp.chance
            if previous is None:
                weight = chance.first_chosen * policy[state, b] + (1 - chance.first_chosen) / mdp.num_actions
            else:
                weight = chance.chosen * policy[state, b] + chance.uniform / mdp.num_actions
                weight += chance.previous * (previous == b)
            if not weight:
                continue
            for following, p in outcomes(mdp, state, b):
                if p > 0:
                    follow(following, b, t + 1, probability * weight * p, total + mdp.rewards[state, b])

    for s in np.flatnonzero(start):
        follow(s // width, None, 0, start[s], 0.0)
    return found


def failure_probability(mdp, steps, k, m):
    """Probability that GORP, with k and m, takes an action that is not optimal: all outcomes of all samples, round by
    round."""

    def ended(state):
        return state < 0 or mdp.terminal[state]

    def actions(state):
        everything = range(mdp.num_actions)
        return [b for b in everything if ended(state) or mdp.available is None or mdp.available[state, b]]

    def completions(state, left):
        """{return: probability} of random play."""
        if left <= 0 or ended(state):
            return {0.0: 1.0}
        found = {}
        for b in actions(state):
            for value, p in completions(int(mdp.next_states[state, b]), left - 1).items():
                key = round(value + mdp.rewards[state, b], 6)
                found[key] = found.get(key, 0.0) + p / len(actions(state))
        return found

    def best(state, left):
        if left <= 0 or ended(state):
            return 0.0
        return max(mdp.rewards[state, b] + best(int(mdp.next_states[state, b]), left - 1) for b in actions(state))

    def sums(distribution):
        total = {0.0: 1.0}
        for _ in range(m):
            after = {}
            for x, p in total.items():
                for y, q in distribution.items():
                    after[round(x + y, 6)] = after.get(round(x + y, 6), 0.0) + p * q
            total = after
        return total

    def first_actions(state, left):
        """(A,) the probability that each action is taken."""
        each = []
        for sequence in itertools.product(range(mdp.num_actions), repeat=k):
            at, paid, possible = state, 0.0, True
            for i, b in enumerate(sequence):
                if i >= left or ended(at):
                    break
                possible &= b in actions(at)
                paid += mdp.rewards[at, b]
                at = int(mdp.next_states[at, b])
            if not possible:
                continue
            tail = completions(at, left - k)
            each.append((sequence[0], sums({round(paid + x, 6): p for x, p in tail.items()})))
        result = np.zeros(mdp.num_actions)
        for outcome in itertools.product(*(list(d.items()) for _, d in each)):
            values = [round(value, 6) for value, _ in outcome]
            result[each[values.index(max(values))][0]] += math.prod(p for _, p in outcome)
        return result

    def fails(state, left):
        if left == 0 or ended(state):
            return 0.0
        taken = first_actions(state, left)
        total = 0.0
        for b in actions(state):
            following = int(mdp.next_states[state, b])
            good = mdp.rewards[state, b] + best(following, left - 1) >= best(state, left) - 1e-4
            total += taken[b] * (fails(following, left - 1) if good else 1.0)
        return total

    return fails(int(mdp.start_states[0]), steps)
