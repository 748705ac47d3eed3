"""Action-gap regularity, distribution mismatch and mixing time: against explicit matrices, and known chains."""

import importlib
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from test_diameter import ring

import pharos
from naive.mdp import absorbing, augmented, is_over
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.mdp import (
    TabularMDP,
    random_actions,
    states_within,
    sticky_actions,
)
from refusals import refusal
from strategies import examples, small_mdps

_occupancy = importlib.import_module("pharos.hardness.visitation")


def chain_of(mdp, restart=True):
    """(P of uniform play over the nodes that can be reached, their states): the end is state S."""
    P, _, start = augmented(mdp)
    width = mdp.num_actions + 1
    ended = np.flatnonzero(is_over(mdp))
    for n in ended:
        P[n] = start if restart else np.eye(len(P))[n]
    for n in ended[:-1]:  # what has ended does not remember the previous action
        if n % width:
            P[:, :, n - n % width] += P[:, :, n]
            P[:, :, n] = 0
            start[n - n % width] += start[n]
            start[n] = 0
    chain = P.mean(axis=1)
    reached = {int(n) for n in np.flatnonzero(start)}
    while True:
        more = {int(m) for n in reached for m in np.flatnonzero(chain[n])} - reached
        if not more:
            break
        reached |= more
    nodes = sorted(reached)
    return chain[np.ix_(nodes, nodes)], np.array(nodes)


def naive_mixing_time(chain, most=300):
    """The first t at which all rows are within 1/4 of the limit; None where there is none within `most` steps."""
    far = chain
    for _ in range(20):
        far = far @ far
        far /= far.sum(axis=1, keepdims=True)
    for row in far:
        if not np.allclose(row, far[0], atol=1e-9) or not np.allclose(row, row @ chain, atol=1e-9):
            return None
    power = np.eye(len(chain))
    for t in range(most):
        if 0.5 * np.abs(power - far[0]).sum(axis=1).max() <= 0.25 + 1e-12:
            return t
        power = power @ chain
    return None


def lump(chain, nodes, mdp):
    """Without sticky actions the previous action does not matter: one node for each state."""
    owner = nodes // (mdp.num_actions + 1)
    states = np.unique(owner)
    members = (owner[:, None] == states).astype(float)
    first = members.argmax(axis=0)
    return (chain @ members)[first]


@pytest.mark.long
@examples(150, small_mdps(max_states=5, max_actions=2), st.booleans())
def test_the_mixing_time_is_that_of_powers_of_the_matrix(mdp, restart):
    chain, nodes = chain_of(mdp, restart)
    if not mdp.is_sticky:
        chain = lump(chain, nodes, mdp)
    found = hardness.mixing_time(mdp, restart=restart)
    expected = naive_mixing_time(chain)
    if expected is not None:
        assert found.period == 1
        assert found.value == expected
    else:
        assert found.value > 300 or math.isinf(found.value)


@pytest.mark.parametrize("length", [3, 4, 7])
def test_a_ring_has_its_length_as_period_and_the_lazy_ring_mixes_the_later_the_longer_it_is(length):
    found = hardness.mixing_time(ring(length))
    assert found.period == length and math.isinf(found.value)
    short, long = (hardness.mixing_time(ring(each), lazy=True).value for each in (length, 2 * length))
    assert short < long < math.inf


@pytest.mark.parametrize("p", [0.05, 0.2, 0.5])
def test_two_states_mix_as_the_second_eigenvalue_says(p):
    """From a state, |P^t - mu| = (1 - 2 p)^t / 2."""
    chain = TabularMDP.from_matrices(np.array([[[1 - p, p]], [[p, 1 - p]]]), np.zeros((2, 1)))
    expected = 0 if p >= 1 else next(t for t in range(1000) if (1 - 2 * p) ** t / 2 <= 0.25)
    assert hardness.mixing_time(chain).value == expected


def test_several_recurrent_classes_never_mix():
    two = TabularMDP.from_arrays([[0, 1], [1, 1], [2, 2]], np.ones((3, 2)), gamma=0.9).with_initial([0, 2])
    found = hardness.mixing_time(two)
    assert math.isinf(found.value) and found.period == 0
    assert found.to_dict()["infinite"]


@pytest.mark.long
@examples(100, small_mdps(max_states=5, max_actions=3))
def test_the_mismatch_contains_the_largest_ratio_of_visits(mdp):
    solution = pharos.value_iteration(mdp, 1e-9)
    P, _, start = absorbing(mdp)
    width = mdp.num_actions + 1
    choice = np.append(np.repeat(np.asarray(solution.policy), width), 0)
    if np.asarray(solution.policy).ndim == 2:
        choice = np.append(np.asarray(solution.policy).ravel(), 0)

    def visits(policy):
        chain = np.einsum("na,nam->nm", policy, P)
        d = np.linalg.solve(np.eye(len(P)) - mdp.gamma * chain.T, start)
        return np.append(d[:-1].reshape(mdp.num_states, width).sum(axis=1), d[-1])

    best = visits(np.eye(mdp.num_actions)[choice])
    other = visits(np.full((len(P), mdp.num_actions), 1 / mdp.num_actions))
    met = best > 1e-8
    expected = (best[met] / other[met]).max()
    found = hardness.distribution_mismatch(mdp, solution=solution)
    assert 1 <= found.lower <= expected * (1 + 1e-6) + 1e-9
    assert found.upper >= expected * (1 - 1e-6) - 1e-9
    if found.exact and mdp.gamma > 0:
        assert found.upper == pytest.approx(expected, rel=1e-5)


@pytest.mark.long
def test_the_mismatch_counts_terminal_states_and_the_end_alike():
    """Half of uniform play comes to the state that the optimal policy always comes to; it is the same process, told in
    three ways."""
    rewards = [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
    plain = TabularMDP.from_arrays([[1, 2], [1, 1], [2, 2]], rewards, gamma=0.9)
    terminal = TabularMDP.from_arrays([[1, 2], [1, 1], [2, 2]], rewards, gamma=0.9, terminal=[False, True, True])
    ending = TabularMDP.from_arrays([[-1, 1], [1, 1]], rewards[:2], gamma=0.9)
    for mdp in (plain, terminal, ending):
        found = hardness.distribution_mismatch(mdp)
        assert found.exact and found.lower <= 2.0 <= found.upper


@pytest.mark.parametrize("tolerance", [5.0, 1.0, 0.1, 1e-3, 1e-9])
def test_the_mismatch_lies_in_its_interval_however_coarse_the_visits_are(tolerance):
    """The best action goes to and fro between two states for ever, the other leaves them."""
    rewards = [[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    mdp = TabularMDP.from_arrays([[1, 2], [0, 2], [2, 2]], rewards, gamma=0.9)
    gamma = Fraction(0.9)
    best, uniform = gamma / (1 - gamma**2), gamma / 2 / (1 - gamma**2 / 4)
    found = hardness.distribution_mismatch(mdp, tolerance=tolerance)
    assert Fraction(found.lower) <= best / uniform <= Fraction(found.upper)


@pytest.mark.parametrize("backwards", [False, True])
def test_the_mismatch_counts_states_that_are_met_after_all_that_is_worth_a_step(backwards):
    """A path: one action goes on and pays 1, the other ends. d*(s) / d(s) = 2^s, while gamma^s sinks below any
    tolerance."""
    length = 60
    following = np.full((length, 2), -1)
    following[:-1, 0] = np.arange(1, length)
    rewards = np.tile([1.0, 0.0], (length, 1))
    start = 0
    if backwards:
        following = np.where(following < 0, -1, length - 1 - following)[::-1]
        start = length - 1
    mdp = TabularMDP.from_arrays(following, rewards, gamma=0.5).with_initial(start)
    found = hardness.distribution_mismatch(mdp)
    assert found.lower <= 2.0 ** (length - 1) * (1 + 1e-9) and found.upper >= 2.0 ** (length - 1) * (1 - 1e-9)
    assert found.lower > 1e4


@pytest.mark.long
@examples(100, small_mdps(max_states=6, max_actions=3), st.integers(0, 2**32 - 1))
def test_support_is_where_the_walk_may_be(mdp, seed):
    """Without chance each state is met within S steps, under sticky actions each pair within S A."""
    random = np.random.default_rng(seed)
    policy = random.integers(mdp.num_actions, size=mdp.num_states)
    walk = hardness.occupancy(mdp.with_horizon(None), policy, horizon=mdp.num_states * (mdp.num_actions + 1) + 1)
    live = ~np.asarray(mdp.terminal)
    assert (_occupancy.support_with_ends(mdp, policy)[:-1] & live == (walk.largest.sum(axis=1) > 0)).all()
    P, _, start = augmented(mdp)  # of terminal states and the end: what executed actions lead to
    width = mdp.num_actions + 1
    chain = P[np.arange(len(P)), np.append(np.repeat(policy, width), 0)]
    met = start > 0
    for _ in range(len(P)):
        met = met | ((chain[met & ~is_over(mdp)] > 0).any(axis=0))
    states = np.append(met[:-1].reshape(mdp.num_states, width).any(axis=1), met[-1])
    assert (_occupancy.support_with_ends(mdp, policy) == states).all()


@pytest.mark.slow
def test_the_mismatch_of_the_optimal_policy_with_itself_is_one():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    solution = pharos.value_iteration(mdp, 1e-9)
    found = hardness.distribution_mismatch(mdp, solution.policy, solution)
    assert found.lower == pytest.approx(1) and found.upper == pytest.approx(1, abs=1e-6)


@pytest.mark.long
@examples(100, small_mdps(max_states=5, max_actions=3), st.sampled_from([0.0, 0.5, 1.0, 2.0]))
def test_the_action_gap_is_as_regular_as_all_gaps_say(mdp, zeta):
    solution = pharos.value_iteration(mdp, 1e-9)
    found = hardness.action_gap_regularity(mdp, solution, zeta=zeta)
    gaps = []
    reached = states_within(mdp)
    if not mdp.is_sticky:
        for s in range(mdp.num_states):
            if reached[s] and not mdp.terminal[s]:
                row = [found_gap for found_gap in solution.v[s] - solution.q[s] if found_gap > found.tie_tolerance]
                gaps.append(min(row, default=math.inf))
        gaps = np.array(gaps)
        finite = gaps[np.isfinite(gaps)]
        expected = max(((gaps <= g * (1 + 1e-12)).mean() / g**zeta for g in finite), default=0.0)
        assert found.constant == pytest.approx(expected, rel=1e-6)
        assert found.states == len(gaps)
    for t in np.geomspace(1e-6, 10, 40):
        share = found.shares[np.searchsorted(found.gaps, t, side="right") - 1] if (found.gaps <= t).any() else 0.0
        assert share <= found.constant * t**zeta * (1 + 1e-9)


@pytest.mark.long
def test_they_are_part_of_a_report_when_asked_for():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    names = ["action_gap_regularity", "distribution_mismatch", "mixing_time", "tight_effective_horizon"]
    assert not set(names) & set(hardness.report(mdp, keep=False).results)
    found = hardness.report(mdp, "all", keep=False, horizon=10)
    assert set(names) <= set(found.results)
    assert all(not found[name].undefined for name in names)
    chancy = hardness.report(sticky_actions(mdp, 0.25), names, keep=False, horizon=10)
    assert "deterministic" in chancy["tight_effective_horizon"].undefined


@pytest.mark.slow
def test_what_is_not_defined_says_why():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=1.0)
    assert "gamma < 1" in refusal(UndefinedMeasure, hardness.distribution_mismatch, mdp)
    assert "epsilon" in refusal(ParameterError, hardness.mixing_time, mdp, epsilon=0.7)
    assert "zeta" in refusal(ParameterError, hardness.action_gap_regularity, mdp.with_horizon(5), zeta=-1.0)
    with pytest.raises(UndefinedMeasure, match="4096"):
        hardness.mixing_time(random_actions(pharos.build(pharos.make("freeway/20x5-speed1")).mdp(), 0.1))
