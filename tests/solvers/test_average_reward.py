"""Long-run averages against rational numbers and every policy, published values, theorems and textbooks."""

import math

import numpy as np
import pytest
import quantecon as qe
from hypothesis import strategies as st
from test_total_reward import mdps_with_cycles

import pharos
from naive import average as naive
from pharos.errors import ParameterError, PrecisionError, UnknownName
from pharos.mdp import BEST, Residual, TabularMDP
from pharos.policies import average_regret
from pharos.solvers import average
from strategies import deterministic_mdps, examples, small_mdps

CHAINS = mdps_with_cycles(rewards=(-1.0, 0.0, 1.0, 0.1, 3.0))


def is_within(bounds, exact):
    """Whether exact numbers {state: number} are within the bounds, and these near enough."""
    return all(bounds.lower[s] <= x <= bounds.upper[s] for s, x in exact.items())


def by_state(mdp, of_node, sign=1, action=None):
    """{state: number} of an episode's first step, from {node: number}; the best choice, or an action."""
    result = {}
    for s in np.flatnonzero(~np.asarray(mdp.terminal)).tolist():
        choices = naive.first_steps(mdp, s)
        numbers = [sum(p * of_node[m] for m, p in after.items()) for _, after in choices]
        result[s] = sign * max(sign * x for x in numbers) if action is None else numbers[action[s]]
    return result


def check(mdp, policy, sign):
    expected = naive.best_gains(mdp, sign) | {None: 0}
    tolerance = 1e-6
    result = pharos.average_reward(mdp, policy, tolerance=tolerance)
    assert is_within(result.gain, by_state(mdp, expected, sign))
    assert (result.gain.upper - result.gain.lower).max() <= 2 * tolerance
    # the policy attains it
    again = pharos.average_reward(mdp, result.policy, tolerance=tolerance)
    assert np.abs(again.gain.lower - result.gain.lower).max() <= 3 * tolerance


@pytest.mark.long
@examples(200, CHAINS, st.sampled_from([("optimal", 1), ("worst", -1)]))
def test_gains_are_those_of_the_best_policy_of_all(mdp, kind):
    check(mdp, *kind)


@pytest.mark.long
@examples(100, deterministic_mdps(max_states=4))
def test_cycles(mdp):
    check(mdp, None, 1)


@pytest.mark.long
@examples(200, small_mdps(max_states=3))
def test_every_kind_of_mdp_and_chance(mdp):
    if mdp.num_actions ** (mdp.num_states * mdp.width) <= 300:
        check(mdp, None, 1)


def check_policy(mdp, actions):
    gain, bias = naive.gains_and_biases(naive.chain_of(mdp, actions))
    result = pharos.average_reward(mdp, actions)
    exact = by_state(mdp, gain, action=actions)
    assert is_within(result.gain, exact)
    assert is_within(result.bias, bias_by_state(mdp, bias, exact, actions))
    assert (result.gain.upper - result.gain.lower).max() <= 2e-6


def bias_by_state(mdp, bias, gain, actions):
    steps = {s: naive.first_steps(mdp, s)[actions[s]] for s in gain}
    return {s: r - gain[s] + sum(p * bias[m] for m, p in after.items()) for s, (r, after) in steps.items()}


@pytest.mark.long
@examples(200, CHAINS, st.data())
def test_gain_and_bias_of_policies(mdp, data):
    check_policy(mdp, np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)]))


@pytest.mark.long
@examples(200, small_mdps(max_states=3), st.data())
def test_gain_and_bias_of_policies_under_every_chance(mdp, data):
    check_policy(mdp, np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)]))


@pytest.mark.long
@examples(100, CHAINS, st.sampled_from([("optimal", 1), ("worst", -1)]))
def test_sweeps_alone_prove_the_same(mdp, kind):
    """Components too large for equations, and many nodes where play may end up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(average, "MOST_UNSWEPT_NODES", 0)
        patch.setattr(average, "MOST_GAIN_SWEEPS", 3000)
        patch.setattr(average.MeanPayoff, "_improve", lambda *_: False)
        patch.setattr(average.MeanPayoff, "_in_rational_numbers", lambda _: False)
        try:
            check(mdp, *kind)
        except PrecisionError:  # probabilities of 1e-12
            assert min(mdp.dynamics.matrix().data) < 1e-3


# Theorems -------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@examples(200, small_mdps(max_states=4), st.data())
def test_values_near_gamma_1_are_gains_and_biases(mdp, data):
    """V_gamma = g / (1 - gamma) + h - (1 - gamma) sum gamma^t P^(t + 1) h, so it is within 2 max |h| of the first."""
    actions = np.array([data.draw(st.integers(0, mdp.num_actions - 1)) for _ in range(mdp.num_states)])
    result, gamma = pharos.average_reward(mdp, actions), 0.999
    solution = pharos.evaluate_policy(mdp.with_gamma(gamma).with_horizon(None), actions, 1e-4)
    size = max(np.abs(result.bias.lower).max(), np.abs(result.bias.upper).max())
    if mdp.is_sticky:  # states stand for first steps, whose biases need not bound those of later ones
        size += 2 * np.abs(mdp.rewards).max() * 1000
    room = (1 - gamma) * (2 * size + solution.error_bound) + 1e-9
    start = (1 - gamma) * solution.value_at_start
    assert result.gain_at_start.lower - room <= start <= result.gain_at_start.upper + room


@pytest.mark.long
@examples(60, small_mdps(max_states=4))
def test_gains_follow_the_rewards(mdp):
    """r -> 3 r + 2 where nothing ends; the worst gain is that of the negated rewards, negated."""
    best = pharos.average_reward(mdp)
    worst = pharos.average_reward(mdp.with_rewards(-mdp.rewards), "worst")
    assert np.abs(best.gain.lower + worst.gain.upper).max() <= 4e-6
    if np.asarray(mdp.terminal).any() or (mdp.dynamics.matrix().indices == mdp.num_states).any():
        return
    scaled = pharos.average_reward(mdp.with_rewards(3 * mdp.rewards + 2))
    assert np.abs(scaled.gain.lower - 3 * best.gain.lower - 2).max() <= 1e-5
    assert np.abs(scaled.gain.lower - scaled.gain.upper).max() <= 2e-6


@pytest.mark.long
@examples(60, st.integers(1, 7), st.integers(0, 2**32 - 1))
def test_policies_have_the_gains_of_their_stationary_distributions(num_states, seed):
    rng = np.random.default_rng(seed)
    P = rng.dirichlet(np.ones(num_states), (num_states, 2)) * (rng.random((num_states, 2, num_states)) < 0.6)
    P[..., 0] += P.sum(axis=2) == 0
    P /= P.sum(axis=2, keepdims=True)
    mdp = TabularMDP.from_matrices(P, rng.normal(size=(num_states, 2)), axes="SAS")
    uniform = pharos.average_reward(mdp, "uniform", tolerance=1e-10)
    chain = qe.MarkovChain(P.mean(axis=1))
    for nodes, weights in zip(chain.recurrent_classes_indices, chain.stationary_distributions, strict=True):
        gain = weights @ mdp.rewards.mean(axis=1)
        assert np.abs(uniform.gain.lower[nodes] - gain).max() <= 1e-9
        bias = (uniform.bias.lower + uniform.bias.upper) / 2
        assert abs(weights @ bias) <= 1e-9  # the stationary mean of the bias is 0
    again = pharos.average_reward(mdp, np.full((num_states, 2), 0.5), tolerance=1e-10)
    assert (again.gain.lower == uniform.gain.lower).all()


@examples(30, st.integers(0, 1000))
def test_every_mdp_within_the_residual_is_within_the_bounds(seed):
    rng, size = np.random.default_rng(seed), 1e-7
    P = rng.dirichlet(np.ones(4), (4, 2))
    rewards = rng.normal(size=(4, 2))
    near = P * (1 + size * rng.uniform(-1, 1, P.shape))
    near /= near.sum(axis=2, keepdims=True)
    off = float(np.abs(near - P).sum(axis=2).max())
    mdp, other = (TabularMDP.from_matrices(each, rewards, axes="SAS") for each in (P, near))
    object.__setattr__(mdp, "residual", Residual(off, 0.0))
    wide, narrow = pharos.average_reward(mdp, tolerance=1e-12), pharos.average_reward(other, tolerance=1e-9)
    assert (wide.gain.lower <= narrow.gain.lower + 1e-12).all() and (narrow.gain.upper - 1e-12 <= wide.gain.upper).all()


# Chains that are known ------------------------------------------------------------------------------------------------


def test_a_chain_of_two_states_that_take_turns():
    mdp = TabularMDP.from_arrays(np.array([[1], [0]]), np.array([[1.0], [3.0]]))
    result = pharos.average_reward(mdp)
    assert result.gain_at_start.lower <= 2 <= result.gain_at_start.upper < 2 + 1e-12
    assert is_within(result.bias, {0: -0.5, 1: 0.5}) and (result.bias.upper - result.bias.lower).max() < 1e-12


def test_sweeps_settle_where_chains_are_periodic():
    """Undamped, differences of two sweeps go round with the chain, and the span does not shrink."""
    states = np.arange(7)
    mdp = TabularMDP.from_arrays(((states + 1) % 7)[:, None], (states == 3)[:, None] * 1.0)
    nodes = average.WrittenOut.of(mdp, BEST)
    sweeps = average.Sweeps(average._inner(nodes, states))
    assert sweeps.go_on(2000, 1e-9)


def test_a_cycle_of_a_thousand_states():
    states = np.arange(1000)
    rewards = np.stack([np.where(states == 999, 1000.0, 0.0), np.full(1000, 0.9)], axis=1)
    mdp = TabularMDP.from_arrays(np.stack([(states + 1) % 1000, states], axis=1), rewards)
    result = pharos.average_reward(mdp, tolerance=1e-9)
    assert is_within(result.gain, dict.fromkeys(range(1000), 1.0)) and (result.policy == 0).all()
    assert is_within(result.bias, {s: s - 499.5 for s in range(1000)})  # paid at the end of a round
    assert pharos.average_reward(mdp, "worst").gain_at_start == pytest.approx((0.9, 0.9))


# Howard (1960), "Dynamic programming and Markov processes": the toymaker of chapter 4, the taxicab of chapter 5; the
# second town has two actions, the others three.
TOYMAKER = [[[0.5, 0.5], [0.8, 0.2]], [[0.4, 0.6], [0.7, 0.3]]], [[6, 4], [-3, -5]]
TAXICAB = (
    [
        [[1 / 2, 1 / 4, 1 / 4], [1 / 16, 3 / 4, 3 / 16], [1 / 4, 1 / 8, 5 / 8]],
        [[1 / 2, 0, 1 / 2], [1 / 16, 7 / 8, 1 / 16], [1 / 2, 0, 1 / 2]],
        [[1 / 4, 1 / 4, 1 / 2], [1 / 8, 3 / 4, 1 / 8], [3 / 4, 1 / 16, 3 / 16]],
    ],
    [[8, 2.75, 4.25], [16, 15, 16], [7, 4, 4.5]],
)


def test_the_toymaker():
    mdp = TabularMDP.from_matrices(np.array(TOYMAKER[0]), np.array(TOYMAKER[1], float), axes="SAS")
    best = pharos.average_reward(mdp)
    assert best.gain_at_start.lower <= 2 <= best.gain_at_start.upper and best.policy.tolist() == [1, 1]
    first = pharos.average_reward(mdp, [0, 0])
    assert first.gain_at_start.lower <= 1 <= first.gain_at_start.upper
    differences = first.bias.lower - first.bias.lower[1]
    assert differences[0] == pytest.approx(10)  # v1 - v2
    assert (best.bias.lower - best.bias.lower[1])[0] == pytest.approx(10)


def test_the_taxicab_whose_towns_have_sets_of_actions():
    sets = np.array([[True] * 3, [True, True, False], [True] * 3])
    mdp = TabularMDP.from_matrices(np.array(TAXICAB[0]), np.array(TAXICAB[1]), axes="SAS", available=sets)
    best = pharos.average_reward(mdp)
    assert best.policy.tolist() == [1, 1, 1]
    assert best.gain_at_start.lower == pytest.approx(13.34, abs=0.005)
    v = best.bias.lower - best.bias.lower[2]
    assert v == pytest.approx([-1.18, 12.66, 0], abs=0.005)
    assert pharos.average_reward(mdp, [0, 0, 0]).gain_at_start.lower == pytest.approx(9.2, abs=0.005)
    uniform = np.array([[1 / 3] * 3, [1 / 2, 1 / 2, 0], [1 / 3] * 3])
    of_sets = pharos.average_reward(mdp, uniform).gain_at_start
    assert pharos.average_reward(mdp, "uniform").gain_at_start == pytest.approx(of_sets)


@pytest.mark.long
@pytest.mark.parametrize("chance", [(0.25, 0.0), (0.3, 0.2)])
def test_the_taxicab_whose_actions_stick(chance):
    """(1 - gamma) V_gamma is near the gain, in whatever way the sets of actions and chance go together."""
    sets = np.array([[False, True, True], [True, True, False], [True] * 3])
    mdp = TabularMDP.from_matrices(np.array(TAXICAB[0]), np.array(TAXICAB[1]), axes="SAS", available=sets)
    mdp = pharos.random_actions(pharos.sticky_actions(mdp, chance[0]), chance[1])
    near = mdp.with_gamma(1 - 1e-6)
    for policy, solve in (("optimal", pharos.value_iteration), ("uniform", pharos.solvers.values.uniform_value)):
        solution, result = solve(near, 1.0), pharos.average_reward(mdp, policy)
        assert result.gain_at_start.lower == pytest.approx(1e-6 * solution.value_at_start, abs=1e-4)
    best = pharos.average_reward(mdp)
    again = pharos.average_reward(mdp, best.policy)
    assert again.gain_at_start == pytest.approx(best.gain_at_start, abs=2e-6)


def test_a_component_inside_a_component_and_one_that_is_left():
    """0 and 1 take turns for 1 a step; 1 may go on to 2, which may come back, so that all are one component; 3 cannot
    be left, and pays 2; 4 ends, or goes to 3 with probability 1/4.
    """
    P = np.zeros((5, 2, 5))
    P[0, :, 1] = P[1, 0, 0] = P[1, 1, 2] = P[2, 0, 0] = P[3, :, 3] = 1
    P[2, 1, 3] = P[4, 0, 3] = P[4, 1, 3] = 0.25
    P[2, 1, 0] = 0.75
    rewards = np.array([[1, 1], [1, 0], [0, 0], [2, 1], [5, -1.0]])
    mdp = TabularMDP.from_matrices(P, rewards, axes="SAS", ends=True)
    best, worst = pharos.average_reward(mdp), pharos.average_reward(mdp, "worst")
    assert is_within(best.gain, {0: 2, 1: 2, 2: 2, 3: 2, 4: 0.5})
    assert is_within(worst.gain, {0: 1 / 3, 1: 1 / 3, 2: 1 / 3, 3: 1, 4: 0.25})
    assert best.policy[1:3].tolist() == [1, 1]


# Published ------------------------------------------------------------------------------------------------------------


# Its page on MDPs prints those of SimpleGridContinuous(seed=0, size=4, p_rand=0.01, n_starting_states=3).
COLOSSEUM = {"optimal": 0.996, "worst": 0.004, "uniform": 0.500}


def stationary(P):
    """The stationary distribution of an irreducible chain as Colosseum computes it, without a subtraction.

    Source: Grassmann, Taksar and Heyman (1985).
    """
    A = np.array(P)
    for i in range(len(A) - 1):
        A[i + 1 :, i] /= A[i, i + 1 :].sum()
        A[i + 1 :, i + 1 :] += np.outer(A[i + 1 :, i], A[i, i + 1 :])
    x = np.ones(len(A))
    for i in range(len(A) - 2, -1, -1):
        x[i] = x[i + 1 :] @ A[i + 1 :, i]
    return x / x.sum()


@pytest.mark.long
@pytest.mark.parametrize("policy", COLOSSEUM)
def test_averages_that_colosseum_prints(policy):
    env = pharos.make("corner_grid", size=4, p_rand=0.01, n_starting_states=3, seed=0)
    gain = pharos.average_reward(pharos.build(env).mdp(), policy).gain_at_start
    assert round(gain.lower, 3) == round(gain.upper, 3) == COLOSSEUM[policy]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("corner_grid", {"size": 10, "p_lazy": 0.2, "p_rand": 0.01}),
        ("endless_sea", {"size": 20, "p_rand": 0.1}),
        ("mini_grid_empty", {"size": 8, "n_starting_states": 3, "p_lazy": 0.1, "p_rand": 0.2}),
        ("river_swim/colosseum", {"length": 30, "p_lazy": 0.1, "p_rand": 0.2}),
    ],
)
def test_averages_of_colosseums_worlds_by_its_method(name, parameters):
    """Instances without episodes: the reward of the stationary distribution, for the optimal and for uniform play."""
    mdp = pharos.build(pharos.make(name, **parameters)).mdp()
    P = mdp.dynamics.matrix()[:, :-1].toarray().reshape(mdp.num_states, mdp.num_actions, -1)
    uniform = stationary(P.mean(axis=1)) @ mdp.rewards.mean(axis=1)
    gain = pharos.average_reward(mdp, "uniform").gain_at_start
    assert gain.lower - 1e-12 <= uniform <= gain.upper + 1e-12
    best = pharos.average_reward(mdp)
    rows = np.arange(mdp.num_states), best.policy
    chain = average.recurrent_classes(
        best.mdp.dynamics.matrix()[rows[0] * mdp.num_actions + rows[1], :-1].tocsr(), rows[0] >= 0
    )
    inside = np.flatnonzero(chain[1])
    assert chain[0].max() == 0
    of_best = stationary(P[rows][inside][:, inside]) @ mdp.rewards[rows][inside]
    assert best.gain_at_start.lower - 1e-12 <= of_best <= best.gain_at_start.upper + 1e-12


@pytest.mark.long
def test_the_river_is_swum_to_its_end():
    """Always right is a birth and death process: pi(s + 1) / pi(s) is the ratio of going right and coming back."""
    env = pharos.make("river_swim/osband")
    mdp = pharos.build(env).mdp()
    P = mdp.dynamics.matrix()[:, :-1].toarray().reshape(mdp.num_states, 2, -1)[:, 1]
    weights = np.cumprod([1.0, *(P[s, s + 1] / P[s + 1, s] for s in range(mdp.num_states - 1))])
    right = weights @ mdp.rewards[:, 1] / weights.sum()
    gain = pharos.average_reward(mdp).gain_at_start
    assert gain.lower - 1e-12 <= right <= gain.upper + 1e-12


# Regret ---------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_average_regret_of_what_was_learnt():
    """Half of the dives to the right, half to the left: what a policy of observations loses is what its table loses."""
    mdp = pharos.build(pharos.make("endless_sea", size=4)).mdp()
    right = average_regret(mdp, np.ones(mdp.num_states, int))
    # right pays 1 in each dive of 4 steps; left pays 1/16 in each step
    assert right.regret.lower == 0 <= right.regret.upper < 1e-12
    assert right.optimal.lower <= 1 / 4 <= right.optimal.upper
    left = average_regret(mdp, np.zeros(mdp.num_states, int))
    assert left.regret.lower <= 1 / 4 - 1 / 16 <= left.regret.upper < 0.1875 + 1e-12
    seen = average_regret(mdp, lambda observations: np.full((len(observations), 2), 0.5), observation="vector")
    uniform = average_regret(mdp, "uniform")
    assert seen.regret == pytest.approx(uniform.regret, abs=1e-12)
    assert average_regret(mdp, "worst", optimal=right.optimal).regret.lower >= left.regret.lower - 1e-12


# Refusals -------------------------------------------------------------------------------------------------------------


def test_what_is_refused():
    mdp = TabularMDP.from_arrays(np.array([[1, 0], [0, 1]]), np.array([[1.0, 0], [3.0, 0]]))
    with pytest.raises(UnknownName, match="policy 'best'"):
        pharos.average_reward(mdp, "best")
    with pytest.raises(ParameterError, match="3 rows; expected 2"):
        pharos.average_reward(mdp, np.zeros(3, int))
    with pytest.raises(PrecisionError, match="tolerance of 1e-18"):
        pharos.average_reward(mdp.with_rewards(mdp.rewards / 3), tolerance=1e-18)


def test_discount_and_horizon_do_not_count():
    mdp = TabularMDP.from_arrays(np.array([[1, 0], [0, 1]]), np.array([[1.0, 0], [3.0, 0]]), gamma=0.1)
    result = pharos.average_reward(mdp.with_horizon(3))
    assert result.mdp.horizon is None and result.gain_at_start.lower <= 2 <= result.gain_at_start.upper
    assert math.isclose(result.gain_at_start.upper, 2)
