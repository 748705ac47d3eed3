"""A knob means the same everywhere: each implementation of it against the same enumeration of a small world.

What is enumerated is the definition of docs/knobs.md, by the rules of the world and nothing else. Exact solvers have to
agree with it to 1e-9; what draws has to pass a chi-square (or Kolmogorov-Smirnov) test at LEVEL, with fixed seeds.
"""

import itertools
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

import pharos
from naive.learning import paid as paid_of
from pharos import importers
from pharos.agents import QLearning
from pharos.agents.batched import BatchRun
from pharos.agents.batched.lane import BatchedEpisodes
from pharos.environments import Layer
from pharos.errors import ParameterError
from pharos.interaction import GymEnv, VectorEnv
from pharos.mdp import ChanceSetting, lazy_actions, paid_outcomes, rewards_of_staying
from pharos.policies.policy import TableAnswers
from pharos.policies.value import estimate
from pharos.rules.stepping import InterpretedStepping
from pharos.training import Task, evaluate_agent
from worlds import Row

LEVEL = 1e-4  # probability that a right implementation fails
KNOBS = {
    "none": {},
    "sticky": {"sticky": 0.4},
    "random": {"random": 0.4},
    "lazy": {"lazy": 0.3},
    "sticky and random": {"sticky": 0.5, "random": 0.5},
    "all": {"sticky": 0.3, "random": 0.4, "lazy": 0.2},
}
POLICY = np.array([2, 0, 1, 2])
HORIZON = 3


@dataclass(frozen=True, kw_only=True)
class Ring(Row):
    """Four cells in a ring, numbered as a search meets them: an action goes on, one time in four a cell further."""

    length: int = 4

    name = "ring_of_knobs"
    actions = ("one", "two", "three")
    outcomes = 2

    def probability(self, state, action, outcome):
        return 0.75 if outcome == 0 else 0.25

    def transition(self, state, action, outcome, out):
        out[0] = (state[0] + action + 1 + outcome) % 4

    layers = {"agent": Layer("A", (0, 0, 255))}

    def grid(self):
        return (1, 4)

    def draw(self, state, planes):
        planes[0, 0, state[0]] = 1

    def reward(self, state, action, next_state):
        return (state[0] + 1) * (action + 1) / 8


RING = Ring()


@pytest.fixture(scope="module")
def space():
    return pharos.build(RING, progress=False)


def paths(policy, steps, *, sticky=0.0, random=0.0, lazy=0.0):
    """{(s0, e0, s1, e1, ..., sn): probability} of states and executed actions; policy: states so far -> action."""
    law = {(0,): 1.0}
    for _ in range(steps):
        longer = Counter()
        for path, mass in law.items():
            s, executed = path[-1], np.full(3, random / 3)
            executed[policy(path[::2])] += 1 - random
            if len(path) > 1:
                executed *= 1 - sticky
                executed[path[-2]] += sticky
            for e, outcome in itertools.product(range(3), range(2)):
                moved = mass * executed[e] * (1 - lazy) * RING.probability((s,), e, outcome)
                longer[(*path, e, RING.next_state((s,), e, outcome)[0])] += moved
            for e in range(3):
                longer[(*path, e, s)] += mass * executed[e] * lazy
        law = longer
    return law


def value(law):
    """Expected return of paths."""
    return sum(mass * returned(path) for path, mass in law.items())


def returned(path):
    return sum(RING.reward((s,), e, None) for s, e in zip(path[:-1:2], path[1::2], strict=True))


def of_a_table(states):
    return POLICY[states[-1]]


@pytest.mark.long
def test_a_lazy_step_and_an_outcome_say_how_probable_they_were(space):
    expected = {}
    outcomes = paid_outcomes(lazy_actions(space.mdp(), 0.3))
    for row, after, probability in zip(outcomes.which, outcomes.states, outcomes.probabilities, strict=True):
        expected[row // 3, row % 3, after] = probability
    env = GymEnv(RING, lazy=0.3, time_limit=None)
    before, seen = int(env.reset(seed=1)[1]["state"][0]), set()
    for step in range(300):
        info = env.step(step % 2)[4]  # action 2 may go once around, which looks like staying
        move = before, info["executed_action"], int(info["state"][0])
        assert info["prob"] == pytest.approx(expected[move], rel=1e-12)
        before = move[2]
        seen.add(move)
    assert len(seen) == 4 * 2 * 3


# Two steps of many episodes by each implementation: (N, 3) states --------------------------------------------------


def by_rules(knobs, space):
    return in_vectors(VectorEnv(RING, 6000, time_limit=HORIZON, **knobs))


def by_table(knobs, space):
    return in_vectors(VectorEnv(RING, 6000, time_limit=HORIZON, space=space, **knobs))


def by_interpreted_rules(knobs, space):
    env = VectorEnv(RING, 3000, time_limit=HORIZON, **knobs)
    env._stepper._step_many = InterpretedStepping(RING).step_many
    return in_vectors(env)


def in_vectors(env):
    env.reset(seed=11)
    states = [env.states[:, 0]]
    for _ in range(2):
        env.step(POLICY[states[-1]])
        states.append(env.states[:, 0])
    return np.stack(states, axis=1)


def one_by_one(knobs, space):
    env, episodes = GymEnv(RING, time_limit=HORIZON, **knobs), []
    env.reset(seed=12)
    for _ in range(3000):
        states = [int(env.reset()[1]["state"][0])]
        for _ in range(2):
            states.append(int(env.step(POLICY[states[-1]])[4]["state"][0]))
        episodes.append(states)
    return np.array(episodes)


def learner(knobs, space, limit=HORIZON):
    """Q-learning that always acts by POLICY, and whose entry is what it was paid last."""
    task = Task.of(RING, horizon=limit, **knobs)
    pay = {"reward_noise": task.chance.reward_noise, "reward_delay": task.chance.reward_delay}
    greedy = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0, "learning_rate": 1.0, "gamma": 0.0}
    return QLearning(task.mdp, total_steps=1, seed=13, time_limit=limit, **pay, **greedy)


def step_of(learner):
    """(state, what is paid) of a step: (-1, ...) at the end."""
    learner.q[:] = -1e9
    learner.q[np.arange(4), POLICY] = 0.0
    state = 0 if learner.cursor[0] < 0 else int(learner.cursor[0])
    learner.learn(1)
    return int(learner.cursor[0]), float(learner.q[state, POLICY[state]])


def by_q_learning(knobs, space):
    agent, episodes = learner(knobs, space), []
    for _ in range(3000):
        episodes.append([0, *(step_of(agent)[0] for _ in range(HORIZON))][:HORIZON])
    return np.array(episodes)


def batch(knobs, space, copies, limit=HORIZON, frames=1):
    mdp = Task.of(RING, horizon=limit, **{name: p for name, p in knobs.items() if name != "lazy"}).mdp
    staying = rewards_of_staying(space).array.astype(float)
    run = BatchRun(mdp, None, limit, {}, 1, 0, 99, chance=ChanceSetting(**knobs), staying=staying)
    return BatchedEpisodes([run], np.array([run.key], np.uint64), copies, frames)


def by_batches(knobs, space):
    episodes = batch(knobs, space, 6000)
    states = [episodes.state[0].copy()]
    for step in range(2):
        episodes.step(step, POLICY[episodes.state], counts=True)
        states.append(episodes.state[0].copy())
    return np.stack(states, axis=1)


DRAWN = [by_rules, by_interpreted_rules, by_table, one_by_one, by_q_learning, by_batches]


@pytest.mark.slow
@pytest.mark.parametrize("implementation", DRAWN, ids=lambda function: function.__name__)
@pytest.mark.parametrize("knobs", KNOBS.values(), ids=KNOBS)
def test_states_are_as_probable_as_the_definition_of_the_knobs_says(implementation, knobs, space):
    law = Counter()
    for path, mass in paths(of_a_table, 2, **knobs).items():
        law[path[::2]] += mass
    episodes = implementation(knobs, space)
    counts = Counter(map(tuple, episodes.tolist()))
    possible = [states for states, mass in law.items() if mass > 0]
    assert set(counts) <= set(possible)
    expected = len(episodes) * np.array([law[states] for states in possible])
    assert chisquare([counts[states] for states in possible], expected).pvalue > LEVEL


@pytest.mark.long
@pytest.mark.parametrize("knobs", KNOBS.values(), ids=KNOBS)
def test_values_are_those_of_the_enumerated_paths(knobs):
    """Exact evaluation, and the mean of simulated episodes within four standard errors."""
    law = paths(of_a_table, HORIZON, **knobs)
    mdp = Task.of(RING, horizon=HORIZON, **knobs).mdp
    assert pharos.evaluate_policy(mdp, POLICY).value_at_start == pytest.approx(value(law), abs=1e-9)
    mean, _ = estimate(TableAnswers(POLICY, mdp), (0.0, 5.0), 20_000, np.random.default_rng(14))
    variance = sum(mass * (returned(path) - value(law)) ** 2 for path, mass in law.items())
    assert mean == pytest.approx(value(law), abs=4 * np.sqrt(variance / 20_000))


# What is paid -------------------------------------------------------------------------------------------------------


def pay_by_vectors(knobs, space, steps, limit, copies=50):
    env = VectorEnv(RING, copies, time_limit=limit, autoreset_mode="SAME_STEP", **knobs)
    env.reset(seed=15)
    for _ in range(steps):
        states = env.states[:, 0]
        _, pay, _, truncated, info = env.step(POLICY[states])
        np.testing.assert_array_equal(info["earned_reward"], earned_in(states))
        yield states, pay, truncated


def pay_by_tables(knobs, space, steps, limit):
    yield from pay_by_vectors({**knobs, "space": space}, space, steps, limit)


def pay_one_by_one(knobs, space, steps, limit):
    env = GymEnv(RING, time_limit=limit, **knobs)
    env.reset(seed=16)
    for _ in range(50 * steps):
        state = np.array(env.state)
        _, pay, _, truncated, info = env.step(POLICY[state[0]])
        assert info["earned_reward"] == earned_in(state)
        yield state, np.array([pay]), np.array([truncated])
        if truncated:
            env.reset()


def pay_by_q_learning(knobs, space, steps, limit):
    agent = learner(knobs, space, limit)
    for _ in range(50 * steps):
        state = max(agent.cursor[0], 0)
        after, pay = step_of(agent)
        yield np.array([state]), np.array([pay]), np.array([after < 0])


def pay_by_batches(knobs, space, steps, limit):
    episodes = batch(knobs, space, 50, limit)
    for step in range(steps):
        states = episodes.state[0].copy()
        episodes.step(step, POLICY[episodes.state], counts=True)
        yield states, episodes.reward[0].copy(), episodes.flags[0] > 0


def earned_in(states):
    return (states + 1) * (POLICY[states] + 1) / 8


PAID = [pay_by_vectors, pay_by_tables, pay_one_by_one, pay_by_q_learning, pay_by_batches]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1, 2, 5])
@pytest.mark.parametrize("implementation", PAID, ids=lambda function: function.__name__)
def test_what_is_earned_is_paid_so_many_steps_later_and_at_the_end_at_once(implementation, delay, space):
    ends, due = 0, None
    for states, pay, ended in implementation({"reward_delay": delay}, space, 13, 4):
        due = due or [[] for _ in states]
        for i, rewards in enumerate(due):
            rewards.append(earned_in(states)[i])
            assert pay[i] == paid_of(rewards, delay, ended[i])
        due = [[] if over else rewards for rewards, over in zip(due, ended, strict=True)]
        ends += int(ended.sum())
    assert ends >= 100


@pytest.mark.slow
@pytest.mark.parametrize("implementation", PAID, ids=lambda function: function.__name__)
def test_noise_is_normal_about_what_is_earned(implementation, space):
    noise = [pay - earned_in(states) for states, pay, _ in implementation({"reward_noise": 0.5}, space, 60, 4)]
    assert kstest(np.concatenate(noise) / 0.5, "norm").pvalue > LEVEL


@pytest.mark.long
def test_values_do_not_know_how_rewards_are_paid():
    plain, other = (Task.of(RING, horizon=4, **pay) for pay in ({}, {"reward_noise": 0.5, "reward_delay": 2}))
    assert plain.optimal.value_at_start == other.optimal.value_at_start


# Frames ---------------------------------------------------------------------------------------------------------------


FRAMES = {"observation": "simple_image", "observation_options": {"frames": 2}}


def cells_in(frames):
    """(N, 2) the cells of both frames, of images (N, 2, H, W) or of one."""
    columns = np.asarray(frames).max(axis=-2)
    return np.atleast_2d(columns.argmax(axis=-1) // (columns.shape[-1] // 4))


def in_frames(frames):
    """Three on where both frames are the same, else one."""
    cells = cells_in(frames)
    return np.where(cells[:, 0] == cells[:, 1], 2, 0)


def of_two_states(states):
    return 2 if len(states) == 1 or states[-1] == states[-2] else 0


@pytest.mark.parametrize("knobs", KNOBS.values(), ids=KNOBS)
def test_a_policy_of_two_frames_has_the_value_of_the_enumerated_paths(knobs):
    task = Task.of(RING, horizon=HORIZON, **FRAMES, **knobs)
    evaluation = evaluate_agent(in_frames, task)
    assert evaluation.exact
    assert evaluation.value == pytest.approx(value(paths(of_two_states, HORIZON, **knobs)), abs=1e-9)


@pytest.mark.slow
def test_frames_are_the_last_states_of_the_episode_and_its_first_one_before(space):
    options = {"time_limit": 5, **FRAMES}
    many, one = VectorEnv(RING, 20, autoreset_mode="SAME_STEP", **options), GymEnv(RING, **options)
    seen, alone, episodes = many.reset(seed=17)[0], one.reset(seed=17)[0], batch({}, space, 20, 5, frames=2)
    before, state, batched = many.states[:, 0], one.state[0], episodes.state[0].copy()
    np.testing.assert_array_equal(cells_in(seen), np.stack([before, before], axis=1))
    np.testing.assert_array_equal(cells_in(alone), [[state, state]])
    np.testing.assert_array_equal(episodes.seen[0], np.stack([batched, batched], axis=1))
    for step in range(12):
        seen, _, _, ended, _ = many.step(np.full(20, 2))
        now = many.states[:, 0]
        np.testing.assert_array_equal(cells_in(seen), np.stack([np.where(ended, now, before), now], axis=1))
        alone, _, _, over, _ = one.step(2)
        np.testing.assert_array_equal(cells_in(alone), [[state, one.state[0]]])
        if over:
            alone = one.reset()[0]
            np.testing.assert_array_equal(cells_in(alone), [[one.state[0]] * 2])
        episodes.step(step, np.full((1, 20), 2), counts=True)
        first, current = (episodes.flags[0] > 0), episodes.state[0].copy()
        np.testing.assert_array_equal(episodes.seen[0], np.stack([np.where(first, current, batched), current], axis=1))
        before, state, batched = now, one.state[0], current


@pytest.mark.long
def test_rewards_in_another_unit_are_paid_and_the_earned_ones_are_told():
    env = pharos.GymEnv("river_swim", length=4, scale_rewards=4, reward_delay=0)
    env.reset(seed=0)
    steps = [env.step(action) for action in [1, 1, 1, 0, 1, 0, 0, 1] * 8]
    assert all(reward == info["earned_reward"] / 4 for _, reward, _, _, info in steps)
    assert any(reward for _, reward, *_ in steps)


@pytest.mark.parametrize("wrong", [0, -1, "many", math.inf])
def test_rewards_are_not_divided_by_what_is_no_unit(wrong):
    with pytest.raises(ParameterError, match="expected a number above 0, or range"):
        ChanceSetting(scale_rewards=wrong)
    with pytest.raises(ParameterError, match="expected a number here"):
        pharos.GymEnv("river_swim", length=4, scale_rewards="range")


def test_a_reward_scale_is_a_number_in_runs_and_a_word_in_cells():
    assert ChanceSetting.from_dict({"scale_rewards": 4}) == ChanceSetting(scale_rewards="4")
    assert ChanceSetting(scale_rewards=4).to_dict() == {"sticky": 0.0, "random": 0.0, "scale_rewards": 4.0}
    assert str(ChanceSetting(scale_rewards=4, lazy=0.1)) == "lazy 0.1, scale_rewards 4"
    assert str(ChanceSetting(scale_rewards="range")) == "scale_rewards range"
    assert str(ChanceSetting()) == "plain" and not ChanceSetting()


@pytest.mark.long
def test_a_table_learns_the_same_in_any_unit(tmp_path, monkeypatch):
    """A power of two rounds nothing, so policies are the same to the last bit; V* - U divides to 1 in any unit."""
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    table, rewards = [[0, 1], [0, 2], [0, 2]], np.array([[0.25, 0.0], [0.25, 0.0], [0.25, 1.0]])

    def curve(unit, **options):
        mdp = pharos.TabularMDP.from_arrays(table, unit * rewards, gamma=0.9, horizon=20)
        options |= {"steps": 800, "evaluation_interval": 100, "reward_noise": 0.5}
        run = pharos.train("q_learning", importers.environment(mdp), **options)
        return [row["normalized_regret"] for row in run.curve], run.config["chance"]

    usual, _ = curve(1.0)
    scaled, chance = curve(4.0, scale_rewards=4)
    assert chance["scale_rewards"] == 4.0 and scaled == usual and len(set(usual)) > 1
    (one, chance), (other, _) = (curve(unit, scale_rewards="range") for unit in (1.0, 8.0))
    assert chance["scale_rewards"] == "range" and one == other


@pytest.mark.slow
def test_batches_divide_what_is_paid_and_count_what_is_earned(space):
    usual, scaled = (batch({"reward_delay": 1, "scale_rewards": unit}, space, 200) for unit in (1, 4))
    for step in range(2 * HORIZON):
        for episodes in (usual, scaled):
            episodes.step(step, POLICY[episodes.state], counts=True)
        assert (scaled.reward == usual.reward / 4).all() and (scaled.state == usual.state).all()
    assert usual.reward.any() and scaled.returns == usual.returns != 0


@pytest.mark.long
def test_the_unit_of_a_task_is_its_value_less_that_of_uniform_play():
    task = Task.of("river_swim", {"length": 4}, scale_rewards="range")
    spread = task.reference.optimal - task.reference.uniform
    assert task.scaled_chance.reward_scale == task.interaction["chance"].reward_scale == spread
