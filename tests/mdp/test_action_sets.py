"""Actions that exist in some states only: constructors, values and measures, against plain Python."""

from functools import partial

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from pharos import hardness
from pharos.errors import DivergenceError, ParameterError
from pharos.mdp import TabularMDP, end_components
from pharos.solvers import evaluate_policy, uniform_policy, uniform_value, worst_value
from refusals import refusal
from strategies import examples

STATES, ACTIONS, GAMMA = 5, 3, 0.8
CHANCE = st.sampled_from([(0.0, 0.0), (0.3, 0.0), (0.0, 0.25), (0.3, 0.25), (1.0, 0.0)])


@st.composite
def worlds(draw):
    """(probabilities (S, A, S), rewards, sets) of a random MDP, some of whose actions are not available."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sets = rng.random((STATES, ACTIONS)) < 0.5
    sets[np.arange(STATES), rng.integers(ACTIONS, size=STATES)] = True
    sets[0] = [False, True, True]
    outcomes = 1 if draw(st.booleans()) else 2
    P = np.zeros((STATES, ACTIONS, STATES))
    for s, a, _ in np.ndindex(STATES, ACTIONS, outcomes):
        P[s, a, rng.integers(STATES)] += 1 / outcomes
    return P, np.round(rng.normal(size=(STATES, ACTIONS)), 1), sets


def of_chance(world, sticky, random, gamma=GAMMA, ends=False):
    P, R, sets = world
    mdp = TabularMDP.from_matrices(P, np.where(sets, R, -np.inf), gamma=gamma, axes="SAS", ends=ends)
    mdp = pharos.sticky_actions(mdp, sticky) if sticky else mdp
    return pharos.random_actions(mdp, random) if random else mdp


def available(sets, s):
    return [a for a in range(ACTIONS) if sets[s, a]]


def executed(sets, s, b, choice, sticky, random):
    """{action: probability} of what is executed in s after b, A for none, when `choice` is chosen."""
    actions = available(sets, s)
    chances = {a: random / len(actions) + (1 - random) * (a == choice) for a in actions}
    if b in actions:
        chances = {a: (1 - sticky) * p + sticky * (a == b) for a, p in chances.items()}
    return chances


def naive_values(world, sticky, random, choose):
    """V(s, b), b = A for none, by sweeps; choose: (s, {action: value of choosing}) -> value."""
    P, R, sets = world
    v = np.zeros((STATES, ACTIONS + 1))
    for _ in range(150):
        q = R + GAMMA * np.einsum("sat,ta->sa", P, v[:, :ACTIONS])
        new = np.empty_like(v)
        for s in range(STATES):
            for b in range(ACTIONS + 1):
                of_choice = {
                    c: sum(p * q[s, a] for a, p in executed(sets, s, b, c, sticky, random).items())
                    for c in available(sets, s)
                }
                new[s, b] = choose(s, of_choice)
        v = new
    return v


@pytest.mark.long
@examples(25, worlds(), CHANCE)
def test_values_are_those_of_plain_python(world, chance):
    sets, mdp = world[2], of_chance(world, *chance)
    policy = sets * np.random.default_rng(0).random(sets.shape)
    policy /= policy.sum(axis=1, keepdims=True)
    kinds = [
        (pharos.value_iteration(mdp, 1e-9), lambda s, q: max(q.values())),
        (worst_value(mdp, 1e-9), lambda s, q: min(q.values())),
        (uniform_value(mdp, 1e-9), lambda s, q: sum(q.values()) / len(q)),
        (evaluate_policy(mdp, policy, 1e-9), lambda s, q: sum(policy[s, a] * value for a, value in q.items())),
    ]
    for solution, choose in kinds:
        if solution.mdp.is_sticky and solution.mdp.chance.uniform == 1.0:
            continue  # uniform play replaces what sticks, too
        expected = naive_values(world, *chance, choose)
        v = solution.v if mdp.is_sticky else solution.v[:, None]
        if solution.mdp is mdp:
            np.testing.assert_allclose(v, expected[:, : mdp.width], atol=1e-7)
            assert solution.value_at_start == pytest.approx(expected[0, ACTIONS], abs=1e-7)
    for solution in (pharos.value_iteration(mdp, 1e-9), worst_value(mdp, 1e-9)):
        assert sets[np.arange(STATES), solution.policy].all()
        assert (np.isinf(solution.q) == ~sets).all()
        again = evaluate_policy(mdp, solution.policy, 1e-9)
        assert again.value_at_start == pytest.approx(solution.value_at_start, abs=1e-7)
    visits = hardness.occupancy(mdp, policy, executed=True, tolerance=1e-10).visits
    assert not visits[~sets].any()
    value = evaluate_policy(mdp, policy, 1e-9).value_at_start
    assert (visits * mdp.rewards).sum() == pytest.approx(value, abs=1e-6)


@pytest.mark.long
@examples(15, worlds(), st.sampled_from([(0.0, 0.0), (0.0, 0.25)]))
def test_uniform_play_takes_what_is_available(world, chance):
    mdp = of_chance(world, *chance)
    expected = naive_values(world, 0.0, 1.0, lambda s, q: max(q.values()))[0, ACTIONS]
    assert uniform_value(mdp, 1e-9).value_at_start == pytest.approx(expected, abs=1e-7)
    assert evaluate_policy(mdp, uniform_policy(mdp), 1e-9).value_at_start == pytest.approx(expected, abs=1e-7)
    episodes = mdp.with_gamma(1.0).with_horizon(4)
    returns = hardness.return_distribution(episodes, uniform_policy(mdp))
    assert returns.mean == pytest.approx(evaluate_policy(episodes, uniform_policy(mdp)).value_at_start, abs=1e-9)


def reached(world, sticky):
    """Pairs (state, previous action) that available actions lead to; A for none, and where it does not matter."""
    P, _, sets = world
    pairs, waiting = {(0, ACTIONS)}, [(0, ACTIONS)]
    while waiting:
        s, _ = waiting.pop()
        for a in available(sets, s):
            for t in np.flatnonzero(P[s, a]):
                pair = int(t), a if sticky else ACTIONS
                if pair not in pairs:
                    pairs.add(pair)
                    waiting.append(pair)
    return pairs


@pytest.mark.long
@examples(20, worlds(), st.sampled_from([(0.0, 0.0), (0.3, 0.0), (0.0, 0.25), (0.3, 0.25)]))
def test_gaps_and_the_value_norm_are_those_of_actions_that_exist(world, chance):
    (P, R, sets), mdp = world, of_chance(world, *chance)
    v = naive_values(world, *chance, lambda s, q: max(q.values()))
    gaps, pairs, variance = [], 0, 0.0
    for s, b in reached(world, mdp.is_sticky):
        of_choice = []
        for c in available(sets, s):
            chances = executed(sets, s, b, c, *chance)
            next_values = {a: v[:, a if mdp.is_sticky else ACTIONS] for a in chances}
            of_choice.append(sum(p * (R[s, a] + GAMMA * P[s, a] @ next_values[a]) for a, p in chances.items()))
            mean = sum(p * P[s, a] @ next_values[a] for a, p in chances.items())
            variance = max(variance, sum(p * P[s, a] @ (next_values[a] - mean) ** 2 for a, p in chances.items()))
        pairs += len(of_choice)
        gaps += [gap for value in of_choice if (gap := max(of_choice) - value) > 1e-7]
    result = hardness.gaps(mdp)
    assert (result.count, result.ties) == (len(gaps), pairs - len(gaps))
    assert result.sum_of_reciprocals == pytest.approx(sum(1 / gap for gap in gaps), rel=1e-5)
    assert result.histogram.sum() == len(gaps)
    assert result.minimal == pytest.approx(min(gaps, default=np.inf), rel=1e-5)
    assert hardness.environmental_value_norm(mdp) == pytest.approx(variance**0.5, abs=1e-6)


@pytest.mark.long
@examples(15, worlds(), st.sampled_from([(0.0, 0.0), (0.3, 0.0)]))
def test_covering_is_of_uniform_play_over_what_is_available(world, chance):
    (P, _, sets), mdp = world, of_chance(world, *chance)
    mass, most = {(0, ACTIONS): 1.0}, {}
    for _ in range(4):
        most |= {pair: max(most.get(pair, 0.0), p) for pair, p in mass.items()}
        after: dict = {}
        for (s, b), p in mass.items():
            for c in available(sets, s):
                for a, q in executed(sets, s, b, c, *chance).items():
                    for t in np.flatnonzero(P[s, a]):
                        pair = int(t), a if mdp.is_sticky else ACTIONS
                        after[pair] = after.get(pair, 0.0) + p * q * P[s, a, t] / sets[s].sum()
        mass = {pair: p for pair, p in after.items() if p > 0}
    omega = min(p / sets[s].sum() for (s, _), p in most.items())
    result = hardness.covering(mdp, horizon=4)
    assert result.omega_max == pytest.approx(omega, rel=1e-9)
    length = np.log(2 * sum(sets[s].sum() for s, _ in most)) / omega
    assert result.length_bound == pytest.approx(length, rel=1e-9)


@pytest.mark.long
@examples(10, worlds())
def test_an_action_that_is_not_available_is_a_copy_of_one_that_is_to_optimal_play(world):
    P, R, sets = world
    mdp = of_chance(world, 0.0, 0.0)
    first = sets.argmax(axis=1)
    own = np.where(sets, np.arange(ACTIONS), first[:, None])
    rows = np.arange(STATES)[:, None]
    copies = TabularMDP.from_matrices(P[rows, own], R[rows, own], gamma=GAMMA, axes="SAS")
    same = [pharos.value_iteration(each, 1e-9).v for each in (mdp, copies)]
    np.testing.assert_array_equal(*same)
    assert hardness.diameter(mdp).upper == hardness.diameter(copies).upper


@pytest.mark.long
def test_the_largest_set_is_the_base_of_the_effective_horizon():
    # a column of actions that never exist changes nothing
    chain = np.array([[1, 0, 0], [2, 0, 0], [2, 2, 2]])
    rewards = np.array([[0.0, 0.1, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    sets = np.array([[True, True, False]] * 2 + [[True] * 3])
    both = TabularMDP.from_arrays(chain[:, :2], rewards[:, :2], gamma=1.0, terminal=[False, False, True])
    masked = TabularMDP.from_arrays(chain, rewards, gamma=1.0, terminal=[False, False, True], available=sets)
    one, other = (hardness.effective_horizon(each, horizon=4) for each in (both, masked))
    assert (one.value, one.k_min, one.ks, one.ms) == (other.value, other.k_min, other.ks, other.ms)
    assert one.random_return == pytest.approx(other.random_return)
    one, other = (hardness.stationary_effective_horizon(each.with_gamma(0.9)) for each in (both, masked))
    assert one.value == other.value


# Constructors ---------------------------------------------------------------------------------------------------------


def test_minus_infinity_empty_rows_and_sets_say_the_same():
    P = np.array([[[0.5, 0.5], [0.0, 1.0]], [[1.0, 0.0], [0.0, 0.0]]])
    R = np.array([[1.0, 2.0], [0.5, 7.0]])
    sets = np.array([[True, True], [True, False]])
    whole = P.copy()
    whole[1, 1] = [0.25, 0.75]
    mdps = [
        TabularMDP.from_matrices(P, R, axes="SAS"),
        TabularMDP.from_matrices(whole, np.where(sets, R, -np.inf), axes="SAS"),
        TabularMDP.from_matrices(whole, R, axes="SAS", available=sets),
        TabularMDP.from_outcomes([[[0, 1]] * 2] * 2, whole, np.where(sets, R, -np.inf)),
        TabularMDP.from_outcomes([[[0, 1]] * 2] * 2, whole, R, available=sets),
    ]
    for mdp in mdps:
        np.testing.assert_array_equal(mdp.available, sets)
        np.testing.assert_allclose(pharos.value_iteration(mdp, 1e-9).v, pharos.value_iteration(mdps[0], 1e-9).v)


def test_sets_in_which_all_is_available_are_none():
    assert TabularMDP.from_arrays([[1, 0], [0, 1]], np.ones((2, 2)), available=np.ones((2, 2), bool)).available is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"available": [[True, True], [False, False]]}, "state 1 has no available action"),
        ({"rewards": [[0.0, 1.0], [-np.inf, -np.inf]]}, "state 1 has no available action"),
        ({"available": [[True, True]]}, r"available has shape \(1, 2\)"),
        ({"available": [[0.5, 1.0], [1.0, 1.0]]}, "type float64"),
        ({"rewards": [[0.0, np.inf], [0.0, 0.0]]}, "is inf; expected a finite number"),
    ],
)
def test_what_is_no_set_is_refused(change, reason):
    arguments = {"next_states": [[1, 0], [0, 1]], "rewards": np.ones((2, 2)), **change}
    with pytest.raises(ParameterError, match=reason):
        TabularMDP.from_arrays(**arguments)


def test_minus_infinity_for_an_action_that_is_available_is_no_reward():
    mdp = TabularMDP.from_arrays([[1, 1], [0, 1], [-1, -1]], [[-1.0, -np.inf], [-2.0, -3.0], [0.0, 0.0]])
    wrong = np.array([[-1.0, 0.0], [-2.0, -np.inf], [0.0, 0.0]])
    outcomes = partial(TabularMDP.from_outcomes, [[[1], [1]], [[0], [1]], [[-1], [-1]]], np.ones((3, 2, 1)))
    for call in (
        lambda: mdp.with_rewards(wrong),
        lambda: pharos.lazy_actions(mdp, 0.5, staying=wrong),
        lambda: outcomes(wrong[:, :, None], available=mdp.available),
    ):
        assert "state 1, action 1" in refusal(ParameterError, call) and "-inf" in refusal(ParameterError, call)
    right = np.array([[-1.0, -np.inf], [-2.0, -4.0], [-np.inf, -np.inf]])  # nothing is chosen in a terminal state
    mdp = TabularMDP.from_arrays([[1, 1], [0, 1], [2, 2]], right, terminal=[False, False, True])
    assert (mdp.with_rewards(right).rewards == [[-1.0, -1.0], [-2.0, -4.0], [0.0, 0.0]]).all()


def test_an_empty_row_of_an_action_that_is_said_to_be_available_is_refused():
    message = refusal(
        ParameterError,
        TabularMDP.from_matrices,
        [np.eye(2), np.diag([1.0, 0.0])],
        np.zeros(2),
        available=np.ones((2, 2), bool),
    )
    assert "state 1, action 1 sums to 0; expected 1: the action is available, but its row is empty" in message


def test_a_policy_that_takes_an_action_that_is_not_available_is_refused():
    mdp = TabularMDP.from_arrays([[1, 0], [0, 1]], [[1.0, -np.inf], [0.0, 0.0]])
    for policy in (np.array([1, 0]), np.full((2, 2), 0.5), lambda states: np.ones(len(states), int)):
        message = refusal(ParameterError, evaluate_policy, mdp, policy)
        assert message == "the policy takes action 1 in state 0, where it is not available; expected one of 0"


@pytest.mark.long
@examples(40, worlds(), st.sampled_from([0.0, 0.25, 1.0]))
def test_total_rewards_choose_what_is_available(world, random):
    """Worlds that end by each action with probability 0.1: the total is that of a long horizon."""
    P, R, sets = world
    mdp = TabularMDP.from_matrices(0.9 * P, np.where(sets, -np.abs(R), -np.inf), gamma=1.0, axes="SAS", ends=True)
    mdp = pharos.random_actions(mdp, random) if random else mdp
    for solve in (pharos.value_iteration, worst_value, uniform_value):
        total, long = solve(mdp), solve(mdp.with_horizon(600))
        assert np.abs(total.v - long.v).max() <= total.error_bound + long.error_bound + 1e-9
    policy = pharos.value_iteration(mdp).policy
    assert sets[np.arange(STATES), policy].all()
    lake = pharos.reach(mdp, [STATES - 1])
    costs = np.where(np.arange(STATES)[:, None] == STATES - 1, 0.0, np.abs(np.where(sets, R, 0.0)))
    other = pharos.reach(mdp, [STATES - 1], costs=np.where(sets, costs, 99.0))
    assert (lake.minimum.lower <= lake.maximum.upper).all()
    assert np.array_equal(lake.least_cost.lower, other.least_cost.lower)


# Until the end --------------------------------------------------------------------------------------------------------


@st.composite
def worlds_that_may_end(draw):
    """As `worlds`, with rewards of which many are 0, and rows that may end."""
    P, _, sets = draw(worlds())
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    P[rng.random((STATES, ACTIONS)) < 0.3] *= 0.5
    return P, rng.choice([-1.0, -0.5, 0.0, 0.0, 0.0, 0.25], size=(STATES, ACTIONS)), sets


def written_out(world, sticky, random):
    """The MDP without chance of acting whose states are the nodes (s, b)."""
    P, R, sets = world
    nodes = STATES * ACTIONS
    matrix, rewards = np.zeros((nodes, ACTIONS, nodes)), np.full((nodes, ACTIONS), -np.inf)
    for s, b in np.ndindex(STATES, ACTIONS):
        for c in available(sets, s):
            rewards[s * ACTIONS + b, c] = 0.0
            for a, p in executed(sets, s, b, c, sticky, random).items():
                rewards[s * ACTIONS + b, c] += p * R[s, a]
                matrix[s * ACTIONS + b, c, a:nodes:ACTIONS] += p * P[s, a]
    return TabularMDP.from_matrices(matrix, rewards, gamma=1.0, axes="SAS", ends=True)


def outcome_of(solve, mdp):
    try:
        return solve(mdp)
    except DivergenceError:
        return None


@pytest.mark.long
@examples(150, worlds_that_may_end(), st.sampled_from([(0.25, 0.0), (0.25, 0.5), (1.0, 0.0), (0.0, 0.5)]))
def test_total_rewards_under_chance_are_those_of_the_nodes_written_out(world, chance):
    sets, mdp = world[2], of_chance(world, *chance, gamma=1.0, ends=True)
    nodes = written_out(world, *chance)
    parts, expected = end_components(mdp), end_components(nodes)
    if mdp.is_sticky:
        labels, others = parts.labels.ravel(), expected.labels
        assert ((labels < 0) == (others < 0)).all()
        assert ((labels[:, None] == labels) == (others[:, None] == others)).all()
    for solve in (pharos.value_iteration, worst_value, uniform_value):
        if solve is uniform_value and (mdp.is_sticky or mdp.is_random):
            continue  # uniform play replaces what sticks, too
        solution, truth = outcome_of(solve, mdp), outcome_of(solve, nodes)
        assert (solution is None) == (truth is None)
        if truth is not None:
            v = solution.v if mdp.is_sticky else np.repeat(solution.v, ACTIONS)
            error = solution.error_bound + truth.error_bound + 1e-12
            np.testing.assert_allclose(np.ravel(v), truth.v, rtol=0, atol=error)
            assert sets[np.arange(STATES), solution.policy.T].all()


@pytest.mark.long
@examples(60, worlds_that_may_end(), st.sampled_from([(0.25, 0.0), (0.25, 0.5), (1.0, 0.0), (0.0, 0.5)]))
def test_reaching_under_chance_is_that_of_the_nodes_written_out(world, chance):
    """The start, where there is no previous action, is one more node, whose choices are executed as on a first step."""
    P, R, sets = world
    mdp = of_chance(world, *chance, gamma=1.0, ends=True)
    nodes, target = written_out(world, *chance), np.arange(STATES) == STATES - 1
    costs = np.where(target[:, None], 0.0, np.abs(np.where(sets, R, 0.0)))
    of_nodes = np.zeros((STATES * ACTIONS, ACTIONS))
    for s, b in np.ndindex(STATES, ACTIONS):
        for c in available(sets, s):
            of_nodes[s * ACTIONS + b, c] = sum(p * costs[s, a] for a, p in executed(sets, s, b, c, *chance).items())
    lake = pharos.reach(mdp, target, costs=costs)
    truth = pharos.reach(nodes, np.repeat(target, ACTIONS), costs=of_nodes)
    for name, best in (("maximum", max), ("minimum", min), ("least_cost", min), ("largest_cost", max)):
        bounds, expected = getattr(lake, name), getattr(truth, name)
        middle = (expected.lower + expected.upper) / 2
        for s in range(STATES - 1):
            values = []
            for c in available(sets, s):
                total = 0.0
                for a, p in executed(sets, s, ACTIONS, c, *chance).items():
                    after = sum(q * middle[t * ACTIONS + a] for t, q in enumerate(P[s, a]) if q > 0)
                    ends = 1 - P[s, a].sum() > 1e-9
                    paid = costs[s, a] + (np.inf if ends else 0.0) if name.endswith("cost") else 0.0
                    total += p * (paid + after) if p > 0 else 0.0
                values.append(total)
            value = best(values)
            if np.isinf(value):
                assert np.isinf(bounds.upper[s])
            else:
                assert bounds.lower[s] - 2e-6 <= value <= bounds.upper[s] + 2e-6
