"""Readings of values against tables whose equation is known, solved state by state in plain Python."""

from dataclasses import replace

import numpy as np
import pytest

from pharos.benchmark.doctor import (
    EQUATIONS,
    GAMMAS,
    RIGHT_EQUATION,
    contrast,
    cut_shares,
    on_policy,
    optimal,
    readings,
    residuals,
    reward_slope,
    same_runs,
    steps_to_end,
    targets,
)
from pharos.benchmark.examination import Examination, WorldArrays

GAMMA = 0.9
STATES, ACTIONS = 9, 3
BY_VALUES = [name for name in EQUATIONS if name not in (RIGHT_EQUATION, "to_next_episode")]


def world(seed):
    """A world in which a state leads to one of three later ones, round and round, and the last one is terminal."""
    rng = np.random.default_rng(seed)
    transitions = np.zeros((STATES, ACTIONS, STATES))
    for s in range(STATES - 1):
        for a in range(ACTIONS):
            after = rng.choice(STATES, 2, replace=False)
            transitions[s, a, after] = rng.dirichlet((1, 1))
    rewards = rng.choice([-5.0, -1.0, 0.0, 0.3, 2.0], (STATES, ACTIONS))
    rewards[-1], terminal = 0, np.arange(STATES) == STATES - 1
    return WorldArrays(transitions, rewards, terminal, np.eye(STATES)[0], np.ones(4, bool))


def examination(world, *, q=None, v=None, policy=None, seed=0, cuts=0.2, **more):
    rng = np.random.default_rng(seed)
    visits = rng.integers(20, 60, (STATES, ACTIONS)) * ~world.terminal[:, None]
    policy = np.eye(ACTIONS)[(np.zeros(STATES, int) if q is None else q.argmax(axis=1))] if policy is None else policy
    reaction, share = np.ones(len(world.vary)), (visits * cuts).astype(int)
    entries = {"visits": visits, "late": visits, "last": visits, "cuts": share, "reaction": reaction, **more}
    return Examination(
        "twin", seed, world, policy=policy, q=q, v=v, wavering=0.0, regret=0.0, late_regret=0.0, **entries
    )


def solve(world, name, gamma, cuts, policy=None, scale=1.0, at_terminal=0.7):
    """Q of an equation by loops; of a terminal state `at_terminal`; with a policy, its values."""
    states, actions = range(STATES), range(ACTIONS)
    steps = examination(world)
    paid, arrivals = [0.0] * STATES, [0.0] * STATES
    for s in states:
        for a in actions:
            for after in states:
                goes_on = (steps.visits[s, a] - steps.cuts[s, a]) * world.transitions[s, a, after]
                ends = steps.cuts[s, a] * world.transitions[s, a, after]
                for place, flow in ((0 if world.terminal[after] else after, goes_on), (0, ends)):
                    paid[place], arrivals[place] = paid[place] + flow * world.rewards[s, a], arrivals[place] + flow
    q = [[at_terminal if world.terminal[s] else 0.0 for _ in actions] for s in states]
    for _ in range(1500):
        new = [list(row) for row in q]
        for s in states:
            if world.terminal[s]:
                continue
            for a in actions:
                reward = float(world.rewards[s, a]) * scale
                reward = float(np.sign(reward)) if name == "signs" else -reward if name == "negative" else reward
                if name == "earlier_reward":
                    reward = paid[s] / arrivals[s] if arrivals[s] else 0.0
                onward = 0.0
                for after in states:
                    row = q[s] if name == "itself" else q[after]
                    value = sum(row) / ACTIONS if name == "mean" else max(row)
                    if policy is not None:
                        value = sum(p * x for p, x in zip(policy[after], row, strict=True))
                    if name == "to_next_episode" and world.terminal[after]:
                        value = sum(p * x for p, x in zip(policy[0], q[0], strict=True))
                    elif world.terminal[after] and name != "through_ends":
                        value = 0.0
                    if name == "itself" and world.terminal[after]:
                        value = 0.0
                    onward += world.transitions[s, a, after] * value
                new[s][a] = reward + gamma * onward * (1 - cuts[s][a] if name == "cut_is_end" else 1)
        q = new
    return np.array(q)


def test_optimal_values_are_those_of_plain_loops():
    for seed in range(3):
        here = world(seed)
        expected = solve(here, RIGHT_EQUATION, GAMMA, np.zeros((STATES, ACTIONS)), at_terminal=0.0)
        assert np.abs(optimal(here, GAMMA) - expected).max() < 1e-6


@pytest.mark.parametrize("name", BY_VALUES)
def test_values_that_obey_a_wrong_equation_are_nearer_to_it(name):
    here = world(1)
    each = examination(here)
    cuts = each.cuts / np.maximum(each.visits, 1)
    rng = np.random.default_rng(5)
    q = solve(here, name, GAMMA, cuts, at_terminal=4.0)
    q += 0.002 * q.std() * rng.standard_normal(q.shape)
    wrong = examination(here, q=q)
    assert contrast(wrong, name, GAMMA, GAMMA) < -0.3
    assert GAMMAS[int(residuals(wrong)[name].argmin())] == GAMMA


@pytest.mark.parametrize("seed", range(4))
def test_healthy_values_with_noise_obey_no_wrong_equation(seed):
    here = world(seed)
    q, rng = optimal(here, GAMMA), np.random.default_rng(seed)
    q[here.terminal] = 3.0  # never learnt: anything
    q += 0.01 * q.std() * rng.standard_normal(q.shape)
    right = examination(here, q=q)
    contrasts = {name: contrast(right, name, GAMMA, GAMMA) for name in BY_VALUES}
    assert min(contrasts.values()) > 0, contrasts
    numbers = readings([right])
    assert numbers["gamma"] == pytest.approx(-np.log10(1 - GAMMA))
    assert numbers["truth"] > 0.99 and abs(numbers["slope"]) < 0.05 and abs(numbers["size"]) < 0.05


@pytest.mark.long
def test_values_of_a_policy_are_told_from_those_that_run_on_into_the_next_episode():
    here, rng = world(2), np.random.default_rng(0)
    policy = rng.dirichlet(np.ones(ACTIONS), STATES)
    none = np.zeros((STATES, ACTIONS))
    for name, is_wrong in ((RIGHT_EQUATION, False), ("to_next_episode", True)):
        q = solve(here, name, GAMMA, none, policy=policy)
        each = examination(here, v=(policy * q).sum(axis=1), policy=policy, cuts=0)
        assert (contrast(each, "to_next_episode", GAMMA, GAMMA) < 0) == is_wrong
        assert residuals(each)[name].min() < 1e-6


def test_values_of_what_was_played_obey_the_equation_of_a_learner_on_policy_alone():
    here, none = world(1), np.zeros((STATES, ACTIONS))
    steps = examination(here, q=none)
    frequency = steps.visits / np.maximum(steps.visits.sum(axis=1, keepdims=True), 1)
    q = solve(here, RIGHT_EQUATION, GAMMA, none, policy=frequency, at_terminal=0.0)
    each = examination(here, q=q)
    place = GAMMAS.index(GAMMA)
    assert residuals(on_policy(each))[RIGHT_EQUATION][place] < 1e-6 < 0.05 < residuals(each)[RIGHT_EQUATION].min()
    numbers, played = readings([each]), readings([on_policy(each)])
    assert numbers["on_policy"] == played["consistency"] == pytest.approx(np.log10(0.02), abs=1e-3)
    assert played["gamma"] == pytest.approx(-np.log10(1 - GAMMA)) and played["truth"] > 0.999
    assert abs(played["slope"]) < 1e-3 and abs(played["size"]) < 1e-3
    greedy = examination(here, q=optimal(here, GAMMA))
    assert residuals(greedy)[RIGHT_EQUATION][place] < 1e-6 < 0.05 < residuals(on_policy(greedy))[RIGHT_EQUATION].min()


def test_values_of_states_that_the_agent_has_left_are_no_sign_of_an_end_at_the_time_limit():
    here = replace(world(1), rewards=np.abs(world(1).rewards))
    policy = np.eye(ACTIONS)[np.zeros(STATES, int)]
    v, has_left = (policy * optimal(here, GAMMA, policy)).sum(axis=1), np.arange(STATES) >= 5
    v[has_left] *= 0.2  # of an earlier policy; the others are backed up from them
    for _ in range(300):
        v = np.where(has_left, v, targets(examination(here, v=v, policy=policy), GAMMA)[RIGHT_EQUATION])
    each = examination(here, v=v, policy=policy)
    late = each.visits * ~has_left[:, None]
    assert cut_shares(each, GAMMA)[0] > 0.45
    assert cut_shares(each, GAMMA, late) == pytest.approx((0, 0), abs=1e-6)


def test_values_with_the_time_limit_as_an_end_are_all_of_the_way():
    here = world(1)
    each = examination(here)
    cuts = each.cuts / np.maximum(each.visits, 1)
    for name, share in ((RIGHT_EQUATION, 0), ("cut_is_end", 1)):
        q = solve(here, name, GAMMA, cuts, at_terminal=0.0)
        assert cut_shares(examination(here, q=q), GAMMA) == pytest.approx((share, share), abs=1e-6)
    assert np.isnan(cut_shares(examination(here, q=q, cuts=0), GAMMA)).all()


@pytest.mark.long
def test_the_factor_of_rewards_is_their_slope():
    here = world(3)
    for scale in (0.01, 0.5, 10.0):
        q = solve(here, RIGHT_EQUATION, GAMMA, np.zeros((STATES, ACTIONS)), scale=scale, at_terminal=0.0)
        assert reward_slope(examination(here, q=q), GAMMA) == pytest.approx(np.log10(scale), abs=1e-6)
    q = solve(here, RIGHT_EQUATION, GAMMA, np.zeros((STATES, ACTIONS)), scale=-1.0, at_terminal=0.0)
    slope = reward_slope(examination(here, q=q), GAMMA)
    assert slope == -3 or slope < 0


def test_residuals_are_those_of_the_visits_that_are_asked_for():
    here = world(0)
    q = optimal(here, GAMMA)
    last = np.zeros((STATES, ACTIONS), int)
    last[0] = 10
    elsewhere = (here.transitions[0].sum(axis=0) == 0) & (np.arange(STATES) > 0)
    assert elsewhere.sum() >= 2
    noise = 3 * q.std() * np.random.default_rng(0).standard_normal((STATES, ACTIONS))
    each, place = examination(here, q=q + elsewhere[:, None] * noise, last=last), GAMMAS.index(GAMMA)
    assert residuals(each, last)[RIGHT_EQUATION][place] < 1e-6
    assert residuals(each)[RIGHT_EQUATION][place] > 0.1
    assert abs(readings([examination(here, q=q, last=last)])["forgets"]) < 0.05


def test_steps_to_the_end_are_those_of_breadth_first_search():
    for seed in range(3):
        here = world(seed)
        steps, frontier = {STATES - 1: 0}, [STATES - 1]
        while frontier:
            after = frontier.pop(0)
            for s in range(STATES):
                if s not in steps and (here.transitions[s, :, after] > 0).any():
                    steps[s] = steps[after] + 1
                    frontier.append(s)
        assert steps_to_end(here).tolist() == [steps.get(s, STATES) for s in range(STATES)]


def test_behaviour_that_the_policy_shifts_is_seen_and_equal_runs_are():
    here = world(0)
    q = optimal(here, GAMMA)
    late = np.zeros((STATES, ACTIONS), int)
    late[np.arange(STATES - 1), q[:-1].argmax(axis=1)] = 50
    same = readings([examination(here, q=q, late=late)] * 2)
    shifted = readings([examination(here, q=q, late=late, policy=np.eye(ACTIONS)[(q.argmax(axis=1) + 1) % ACTIONS])])
    assert same["overlap"] == pytest.approx(1) and same["overlap_shifted"] < -0.9 and same["equal_seeds"] == 1
    assert shifted["overlap"] == pytest.approx(0) and shifted["overlap_shifted"] > 0.9
    both = [examination(here, q=q, seed=seed) for seed in range(2)]
    assert same_runs(both) == {"twin": False}
    deaf = examination(here, q=q, reaction=np.array([1.0, 1.0, 1.0, 0.0]))
    assert readings([deaf])["deaf_last"] == 1 and readings([deaf])["deaf"] == 0.25


def test_an_agent_that_diverges_has_finite_readings():
    q = np.full((STATES, ACTIONS), np.nan)
    q[0] = np.inf
    numbers = readings([examination(world(0), q=q)])
    assert np.isfinite([*numbers.values()]).all() and numbers["consistency"] > 0
