"""The budget of a run: steps of whatever copy of its environment are counted, or it refuses in one line."""

import copy
import json
import multiprocessing
import os
import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import pharos
from pharos import benchmark
from pharos.benchmark import BenchmarkTask, BudgetSpent, Protocol, Suite
from pharos.benchmark.suite import digest_of_suite, frozen
from pharos.errors import AllRunsFailed, ParameterError
from pharos.training.budget import CountedEnv, StepBudget, generated_curve

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
SEA = BenchmarkTask("sea", "deep_sea", {"size": 4, "mapping_seed": 1}, "one_hot")
LAKE = BenchmarkTask("lake", "frozen_lake", {}, "vector", chance={"sticky": 0.25})
COPIES = {"env.copy": lambda env: env.copy(), "copy": copy.copy, "deepcopy": copy.deepcopy}


def counted(task=LAKE, limit=300, seed=0):
    return CountedEnv(task.training_task(PROTOCOL), StepBudget(limit, limit // 3), seed)


def curve_of(learn, task=LAKE):
    return generated_curve(learn, task.training_task(PROTOCOL), steps=300, evaluations=3, seed=0)


def stepped(env):
    """Steps that an environment allows before the budget is spent."""
    steps = 0
    env.reset()
    try:
        while True:
            _, _, terminated, truncated, _ = env.step(0)
            steps += 1
            if terminated or truncated:
                env.reset()
    except BudgetSpent:
        return steps


@pytest.mark.parametrize("name", COPIES)
def test_every_copy_counts_against_the_same_budget(name):
    env = counted()
    copies = [COPIES[name](env) for _ in range(4)]
    assert all(each.env is not env.env and each.budget is env.budget for each in copies)
    assert [stepped(each) for each in copies] == [300, 0, 0, 0] and stepped(env) == 0
    assert env.budget.steps == 300 and env.budget.episodes >= 3


@pytest.mark.parametrize("name", COPIES)
def test_copies_before_the_first_reset_have_other_random_numbers(name):
    env = counted()
    rows = []
    for each in (COPIES[name](env) for _ in range(4)):
        each.reset()
        rows.append([tuple(each.step(k % 4)[0].tolist()) for k in range(10)])
        rows[-1].append(tuple(each.action_space.sample() for _ in range(20)))
    assert len(set(map(tuple, rows))) == 4


@pytest.mark.parametrize("name", ["copy", "deepcopy"])
def test_a_copy_goes_on_from_the_same_state_and_changes_nothing_of_the_first(name):
    env = counted()
    env.reset(seed=3)
    env.step(1)
    before = env.unwrapped.state
    twin = COPIES[name](env)
    assert twin.unwrapped.state == before
    after = [twin.step(2) and twin.unwrapped.state for _ in range(3)]
    assert env.unwrapped.state == before
    assert [env.step(2) and env.unwrapped.state for _ in range(3)] == after
    assert env.budget.steps == twin.budget.steps == 7


def test_copies_within_wrappers_and_vector_environments_count_too():
    env = counted()
    wrapped = copy.deepcopy(gymnasium.wrappers.RecordEpisodeStatistics(env))
    vector = copy.deepcopy(gymnasium.vector.SyncVectorEnv([env.copy] * 2))
    wrapped.reset(), vector.reset()
    wrapped.step(0), vector.step(np.zeros(2, int))
    assert env.budget.steps == 3


@pytest.mark.parametrize("dumps", ["pickle", "cloudpickle"])
@pytest.mark.parametrize("what", ["environment", "method", "wrapper"])
def test_it_cannot_be_pickled_and_says_what_to_do(dumps, what):
    env = counted()
    given = {"environment": env, "method": env.copy, "wrapper": gymnasium.wrappers.TimeLimit(env, 5)}[what]
    module = pickle if dumps == "pickle" else pytest.importorskip("cloudpickle")
    with pytest.raises(ParameterError, match=r"cannot be pickled: .*SyncVectorEnv\(\[env\.copy\] \* 4\)") as error:
        module.dumps(given)
    assert "\n" not in str(error.value)


def test_another_process_refuses_to_step():
    env = counted()
    env.reset()
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def work():
        said = []
        for use in (env.reset, lambda: env.step(0), lambda: env.copy().reset(), lambda: copy.deepcopy(env).step(0)):
            try:
                use()
                said.append("")
            except ParameterError as error:
                said.append(str(error))
        sender.send(said)

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    said = receiver.recv()
    process.join()
    assert len(said) == 4 and all(f"made in process {os.getpid()}" in each and "\n" not in each for each in said)
    env.step(0)
    assert env.budget.steps == 1


@pytest.mark.filterwarnings("ignore")
def test_an_asynchronous_vector_environment_is_refused_in_one_line():
    def learn(env, steps, seed):
        envs = gymnasium.vector.AsyncVectorEnv([env.copy] * 2, context="fork")
        try:
            envs.reset(seed=seed)
            for _ in range(steps):
                envs.step(np.zeros(2, int))
            yield lambda seen: np.zeros(len(seen), int)
        finally:
            envs.close(terminate=True)

    with pytest.raises(ParameterError, match=r"AsyncVectorEnv.*SyncVectorEnv\(\[env\.copy\] \* 4\)") as error:
        curve_of(learn)
    assert "\n" not in str(error.value)


def test_one_environment_in_several_places_of_a_vector_environment_is_refused():
    env = counted()
    with pytest.raises(ParameterError, match=r"seed 5, then with 6.*several times"):
        gymnasium.vector.SyncVectorEnv([lambda: env] * 4).reset(seed=5)
    gymnasium.vector.SyncVectorEnv([env.copy] * 4).reset(seed=5)
    env = counted()
    for seed in (5, 5, 9, None, 10, 10):  # what an honest program may do
        env.reset(seed=seed)
    env.reset(seed=7), env.step(0), env.reset(seed=8)


@pytest.mark.long
def test_a_policy_without_a_counted_step_is_refused():
    """The agent of an honest user of `deepcopy` as it was, whose steps nobody counted; here it steps what is within."""

    def uncounted(env, steps, seed):
        inner = env.unwrapped
        inner.reset(seed=seed)
        for _ in range(20 * steps):
            if any(inner.step(1)[2:4]):
                inner.reset()
        yield lambda seen: np.full(len(seen), 1)

    def twice(env, steps, seed):
        yield lambda seen: np.full(len(seen), 0)
        yield lambda seen: np.full(len(seen), 1)
        stepped(env)

    for learn in (uncounted, twice):
        with pytest.raises(ParameterError, match=r"0 of its 300 steps were counted.*env\.copy") as error:
            curve_of(learn)
        assert "\n" not in str(error.value)


def test_uniform_play_and_a_first_policy_before_the_first_step_are_none_of_it():
    def nothing(env, steps, seed):
        yield from ()

    def uniform(env, steps, seed):
        yield lambda seen: np.full((len(seen), 4), 0.25)

    def initial(env, steps, seed):
        yield lambda seen: np.full(len(seen), 1)
        stepped(env)

    assert [curve_of(learn).counted_steps for learn in (nothing, uniform, initial)] == [0, 0, 300]


@pytest.mark.long
def test_facts_on_policies_are_those_of_plain_counting():
    """A policy that prefers optimal actions with probability 0.7 is optimal if it is played greedily."""
    task = SEA.training_task(PROTOCOL)
    best = pharos.value_iteration(task.mdp).policy
    best = np.asarray(best[0] if np.ndim(best) > 1 else best)

    def yielding(table):
        def learn(env, steps, seed):
            answers = {observation_of(task, state).tobytes(): table[state] for state in range(task.mdp.num_states)}
            env.reset()
            env.step(0)
            yield lambda seen: np.array([answers[each.tobytes()] for each in seen])

        return learn

    noisy = np.full((task.mdp.num_states, 2), 0.3)
    noisy[np.arange(len(noisy)), best] = 0.7
    curve = curve_of(yielding(noisy), SEA)
    states = [state for state in range(task.mdp.num_states) if not task.mdp.terminal[state]]
    share = max(sum(best[state] == action for state in states) for action in range(2)) / len(states)
    facts = curve.policies
    assert (facts["one_action"], facts["deterministic"]) == (pytest.approx(share), False)
    assert facts["greedy_regret"] == pytest.approx([0.0] * 3, abs=1e-9)
    assert curve.rows[-1]["normalized_regret"] > 0.1

    certain = curve_of(yielding(np.eye(2)[[0] * task.mdp.num_states]), SEA).policies
    assert certain == {"one_action": 1.0, "deterministic": True}
    uniform = curve_of(yielding(np.full_like(noisy, 0.5)), SEA).policies
    assert uniform == {"one_action": 0.0, "deterministic": False}


def observation_of(task, state):
    """The observation of one state."""
    return task.observer.observe(task.space.states([state]), np.array([-1]), np.array([0]))[0]


def test_counted_steps_stand_in_the_record_of_each_run(tmp_path):
    made = frozen(SEA, PROTOCOL)
    suite = Suite("small", PROTOCOL, (made,), (), "", {})
    suite = replace(suite, digest=digest_of_suite(suite))

    def learn(env, steps, seed):
        copies = [copy.deepcopy(env) for _ in range(3)]
        for each in copies:
            each.reset()
            for _ in range(4):
                each.step(0)
        yield lambda seen: np.full(len(seen), 0)

    benchmark.run(learn, suite, out=tmp_path / "out", seeds=range(2))
    for seed in range(2):
        record = json.loads((tmp_path / "out" / "runs" / "sea" / f"seed-{seed}" / "run.json").read_text())
        assert record["result"]["counted_steps"] == 12
        assert record["policies"] == {"one_action": 1.0, "deterministic": True}
    stored = benchmark.AgentResults.read(tmp_path / "out")
    assert stored.record["policies"] == {"sea": {"one_action": 1.0, "deterministic": 1.0}}

    def cheat(env, steps, seed):
        yield lambda seen: np.full(len(seen), 0)

    with pytest.raises(AllRunsFailed, match="0 of its 300 steps were counted"):
        benchmark.run(cheat, suite, out=tmp_path / "cheat", seeds=range(2))
