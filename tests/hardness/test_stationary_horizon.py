"""The stationary effective horizon: against its definition on explicit matrices, and against the time-indexed one."""

import importlib
import math

import numpy as np
import pytest
from hypothesis import strategies as st
from test_effective_horizon import lock

import pharos
from naive.mdp import absorbing, optimal_values, values_of
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.mdp import TabularMDP
from strategies import deterministic_mdps, examples, small_mdps

TIE, SLACK = 1e-6, 1e-8


def analysis(mdp, steps):
    """k_min, window, H by loops over dictionaries, on explicit matrices."""
    (P, R, start), gamma = absorbing(mdp), mdp.gamma
    uniform = np.full(R.shape, 1 / R.shape[1])
    explored = R + gamma * P @ values_of(P, R, gamma, uniform)
    best = R + gamma * P @ optimal_values(P, R, gamma)
    worst = R + gamma * P @ optimal_values(P, R, gamma, sign=-1)
    good = best >= best.max(axis=1, keepdims=True) - TIE
    starts = set(np.flatnonzero(start).tolist())

    def closure(actions):
        met, todo = set(starts), list(starts)
        while todo:
            n = todo.pop()
            for a in np.flatnonzero(actions[n]):
                for m in np.flatnonzero(P[n, a]).tolist():
                    if m not in met:
                        met.add(m)
                        todo.append(m)
        return sorted(met)

    def first_greedy(q):
        for k in range(1, steps + 1):
            greedy = q >= q.max(axis=1, keepdims=True) - SLACK
            met = closure(greedy)
            if not (greedy & ~good)[met].any():
                return k
            q = R + gamma * P @ q.max(axis=1)
        return steps

    found, lists, k = float(steps), [], 1
    q, variance = explored, (explored - worst) * (best - worst)
    while k < found:
        second = np.where(good, -math.inf, q).max(axis=1)
        met = closure(q > second[:, None] + SLACK)
        if not (q.max(axis=1) - second <= SLACK)[met].any():
            needed = [
                16 * variance[n].max() / (q[n].max() - second[n]) ** 2 * math.log(2 * steps * R.shape[1] ** k)
                for n in met
                if second[n] > -math.inf
            ]
            lists.append((k, max([1, *map(math.ceil, needed)])))
            found = min(found, k + (math.log(lists[-1][1]) / math.log(R.shape[1]) if R.shape[1] > 1 else 0.0))
        largest = variance.max(axis=1)
        variance = gamma**2 * np.array([[largest[P[n, a] > 0].max() for a in range(R.shape[1])] for n in range(len(P))])
        q, k = R + gamma * P @ q.max(axis=1), k + 1
    return first_greedy(explored), first_greedy(R), found, lists


@pytest.mark.long
@examples(120, small_mdps(max_states=4, max_actions=2), st.integers(1, 8))
def test_it_is_what_its_definition_says(mdp, steps):
    found = hardness.stationary_effective_horizon(mdp, steps=steps, tie_tolerance=TIE)
    k_min, window, value, lists = analysis(mdp, steps)
    assert (found.k_min, found.effective_planning_window) == (k_min, window)
    assert found.ks == [k for k, _ in lists]
    assert found.ms == pytest.approx([m for _, m in lists], rel=1e-4)
    assert found.value == pytest.approx(value, rel=1e-4)


@st.composite
def layered(draw):
    """MDPs in which each state has one depth, and every episode ends after as many steps."""
    depth, width, actions = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 3))
    following = np.full((1 + depth * width, actions), -1)
    rewards = np.zeros(following.shape)
    for s in range(len(following)):
        level = 0 if s == 0 else 1 + (s - 1) // width
        for a in range(actions):
            rewards[s, a] = draw(st.sampled_from([-1.0, 0.0, 0.5, 1.0]))
            if level < depth:
                following[s, a] = 1 + level * width + draw(st.integers(0, width - 1))
    return following, rewards, depth + 1


@pytest.mark.long
@examples(100, layered())
def test_where_each_state_has_one_depth_it_is_the_time_indexed_one(case):
    following, rewards, steps = case
    near = TabularMDP.from_arrays(following, rewards, gamma=1 - 1e-9)
    timed = hardness.effective_horizon(TabularMDP.from_arrays(following, rewards, gamma=1.0), horizon=steps)
    found = hardness.stationary_effective_horizon(near, steps=steps, tie_tolerance=1e-4)
    assert found.k_min == timed.k_min
    assert found.effective_planning_window == timed.effective_planning_window
    assert found.ks == timed.ks
    assert found.ms == pytest.approx(timed.ms, rel=1e-3, abs=1)


def test_to_open_a_combination_lock_one_must_see_all_of_it():
    for length in (2, 4, 6, 8):
        found = hardness.stationary_effective_horizon(lock(length).with_gamma(0.95), steps=100)
        assert found.effective_planning_window == length
        assert found.k_min <= length


def test_it_is_part_of_a_report_when_asked_for_and_says_what_is_not_defined():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    found = hardness.report(mdp, "stationary_effective_horizon", keep=False)
    assert found["stationary_effective_horizon"].value["k_min"] >= 1
    with pytest.raises(UndefinedMeasure, match="gamma < 1"):
        hardness.stationary_effective_horizon(pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=1.0))
    with pytest.raises(ParameterError, match="steps is 0"):
        hardness.stationary_effective_horizon(mdp, steps=0)


@pytest.mark.long
@examples(40, deterministic_mdps(max_states=6, max_actions=3))
def test_values_that_are_not_written_out_are_the_same(mdp):
    module = importlib.import_module("pharos.hardness.effective_horizon")
    expected = hardness.stationary_effective_horizon(mdp.with_gamma(0.9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "WRITTEN_OUT", 0)
        assert hardness.stationary_effective_horizon(mdp.with_gamma(0.9)) == expected
