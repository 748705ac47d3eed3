"""Long-run averages by trying every policy, in rational numbers: the slow twin of pharos.solvers.average."""

from fractions import Fraction

from naive import mdp as naive_mdp
from naive.goals import classes_of, mean_reward, policies, solve, written_out


def gains_and_biases(chain):
    """({node: gain}, {node: bias}) of a chain {node: (reward, size, after)}; the end, None, has 0 of both."""
    gain, bias = {None: Fraction(0)}, {None: Fraction(0)}
    for nodes in classes_of(chain):
        g, order = mean_reward(chain, nodes), sorted(nodes)
        gain |= dict.fromkeys(order, g)
        # h - P h = r - g up to a constant, and h 0 at the first node
        system = [[(m == n) - chain[n][2].get(m, Fraction(0)) for m in order] for n in order]
        system[0] = [Fraction(m == order[0]) for m in order]
        h = solve(system, [Fraction(0), *(chain[n][0] - g for n in order[1:])])
        paid = {n: (x, x, chain[n][2]) for n, x in zip(order, h, strict=True)}
        mean = mean_reward(paid, nodes)
        bias |= {n: x - mean for n, x in zip(order, h, strict=True)}
    gain |= _totals(chain, gain, {})
    left = {n: r - gain[n] for n, (r, _, _) in chain.items()}
    return gain, bias | _totals(chain, bias, left)


def _totals(chain, values, paid):
    """{node: x} with x = paid + P x, of the nodes without a value."""
    order = [n for n in chain if n not in values]
    system = [[(m == n) - chain[n][2].get(m, Fraction(0)) for m in order] for n in order]
    known = [sum(p * values[m] for m, p in chain[n][2].items() if m in values) + paid.get(n, 0) for n in order]
    return dict(zip(order, solve(system, known), strict=True))


def best_gains(mdp, sign=1):
    """{node: gain} of the best (or worst) policy: one is the best everywhere."""
    best = {}
    for chain in policies(written_out(mdp)):
        gain = gains_and_biases(chain)[0]
        for n in chain:
            best[n] = max(best.get(n, sign * gain[n]), sign * gain[n])
    return {n: sign * value for n, value in best.items()}


def first_steps(mdp, s):
    """[(reward, {node: probability})] of each choice in a state without a previous action."""
    result = []
    for weights in naive_mdp.executed(mdp, mdp.num_actions).tolist():
        total, reward, after = sum(map(Fraction, weights)), Fraction(0), {}
        for x, weight in enumerate(weights):
            moves = [(t, Fraction(p)) for t, p in naive_mdp.outcomes(mdp, s, x) if p > 1e-15]
            share, mass = Fraction(weight) / total, sum(p for _, p in moves)
            reward += share * Fraction(float(mdp.rewards[s, x]))
            for t, p in moves:
                node = None if t < 0 or mdp.terminal[t] else (t, x if mdp.is_sticky else None)
                after[node] = after.get(node, Fraction(0)) + share * p / mass
        result.append((reward, after))
    return result


def chain_of(mdp, actions):
    """The chain of a policy of actions (S,)."""
    return {n: choices[actions[n[0]]] for n, choices in written_out(mdp).items()}
