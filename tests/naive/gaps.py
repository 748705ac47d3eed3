"""Suboptimality gaps from the explicit matrices of `naive_mdp.augmented`: the slow twin of `pharos.hardness.gaps`."""

from naive.mdp import augmented, finite_values, optimal_values, outcomes


def pairs_by_step(mdp, steps):
    """[set of pairs (s, b) that can be met at step t], by some sequence of executed actions; b = A: no previous
    action."""
    num_actions = mdp.num_actions
    pairs = {(int(s), num_actions) for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True) if p > 0}
    result = []
    for _ in range(steps):
        result.append(pairs)
        following = set()
        for s, b in pairs:
            if mdp.terminal[s]:
                continue
            for x in range(num_actions) if b == num_actions or mdp.chance.executes_any else [b]:
                following |= {(t, x) for t, p in outcomes(mdp, s, x) if t >= 0 and p > 0}
        pairs = following
    return result


def naive_gaps(mdp, tie_tolerance, horizon=None):
    """(positive gaps as a sorted list, sum of 1 / (gap + 0.1)), of pairs under sticky actions, of states otherwise."""
    P, R, _ = augmented(mdp)
    num_actions = mdp.num_actions
    if horizon is None:
        v = optimal_values(P, R, mdp.gamma)
        difference = v[:, None] - (R + mdp.gamma * P @ v)
        met = set().union(*pairs_by_step(mdp, mdp.num_states * (num_actions + 1) + 2))
        steps = [(difference, met)]
    else:
        steps = []
        for t, met in enumerate(pairs_by_step(mdp, horizon)):
            after = finite_values(P, R, mdp.gamma, horizon - t - 1)
            q = R + mdp.gamma * P @ after
            steps.append((q.max(axis=1, keepdims=True) - q, met))
    positive, regularized = [], 0.0
    for difference, met in steps:
        if not mdp.is_sticky:
            met = {(s, num_actions) if (s, num_actions) in met else (s, 0) for s, _ in met}
            met = {(s, 0 if any((s, b) in met for b in range(num_actions)) else num_actions) for s, _ in met}
        everything = met if mdp.is_sticky or horizon is not None else {(s, 0) for s in range(mdp.num_states)}
        for s, b in everything:
            regularized += float((1 / (difference[s * (num_actions + 1) + b] + 0.1)).sum())
        for s, b in met:
            if not mdp.terminal[s]:
                row = difference[s * (num_actions + 1) + b]
                positive += row[row > tie_tolerance].tolist()
    return sorted(positive), regularized
