"""Agents that are functions: trained by everything that trains, with the curve that their policies make."""

from pathlib import Path

import numpy as np
import pytest

from batched_runs import Killed
from command_line import answer, usage_error
from command_line import run as command
from pharos import study
from pharos.errors import ParameterError, UnknownName, UntrustedCode
from pharos.system import sources
from pharos.training import (
    FailedRun,
    RunConfig,
    Task,
    evaluate_agent,
    load_agent,
    read_record,
    read_rows,
    train,
    train_configs,
    train_many,
    tune,
)
from pharos.training.budget import generated_curve
from pharos.training.results import write_curve
from refusals import refusal

GRID = "simple_grid/4x4-plain"
LEARN = """
import numpy as np


def learn(env, steps, seed, *, rate=0.5):
    rng, q = np.random.default_rng(seed), np.zeros((env.observation_space.shape[0], env.action_space.n))
    x, _ = env.reset(seed=seed)
    for step in range(steps):
        action = int(rng.integers(q.shape[1]))
        after, reward, terminated, truncated, _ = env.step(action)
        q[:, action] += rate * x * (reward + 0.9 * (not terminated) * (after @ q).max() - x @ q[:, action])
        x = env.reset()[0] if terminated or truncated else after
        if step % 50 == 49:
            yield lambda seen: (seen @ q).argmax(axis=1)
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """The name of a function in a file of the current folder: Q-learning on one-hot observations."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(LEARN)
    return "mine.py:learn"


def constants(changes):
    """A function that steps on, and whose policy after so many steps is to choose one action."""

    def learn(env, steps, seed):
        env.reset()
        for step in range(steps + 1):
            if step in changes:
                yield lambda seen, action=changes[step]: np.full(len(seen), action)
            _, _, terminated, truncated, _ = env.step(step % env.action_space.n)
            if terminated or truncated:
                env.reset()

    return learn


def values_of(learn, steps, interval, **options):
    run = train(learn, GRID, steps=steps, evaluation_interval=interval, **options)
    return {row["step"]: row["value"] for row in run.curve}


def test_at_each_evaluation_the_policy_counts_that_was_yielded_last_at_that_step_or_before():
    task = Task.of(GRID, random=0.2)
    value = {action: evaluate_agent(np.full(task.mdp.num_states, action), task).value for action in range(4)}
    uniform = evaluate_agent(np.full((task.mdp.num_states, 4), 0.25), task).value
    changes = {45: 0, 60: 1, 61: 2, 100: 3}
    expected = {0: uniform, 30: uniform, 60: value[1], 90: value[2], 100: value[3]}
    assert values_of(constants(changes), 100, 30, random=0.2) == pytest.approx(expected, abs=1e-12)
    assert values_of(constants({}), 40, 20, random=0.2) == pytest.approx(dict.fromkeys((0, 20, 40), uniform), abs=1e-12)
    assert values_of(constants({0: 2}), 20, 10, random=0.2) == pytest.approx(
        {0: uniform, 10: value[2], 20: value[2]}, abs=1e-12
    )


def test_a_run_has_the_curve_that_the_same_function_has_in_the_benchmark(mine, tmp_path):
    train(mine, GRID, observation="one_hot", steps=300, evaluation_interval=100, seed=3, sticky=0.25, out="run")
    learn = sources.load_source(sources.find_source(mine))
    task = Task.of(GRID, observation="one_hot", sticky=0.25)
    curve = generated_curve(learn, task, steps=300, evaluations=3, seed=3)
    (tmp_path / "other").mkdir()
    write_curve(tmp_path / "other", curve.rows)
    assert Path("run", "curve.csv").read_bytes() == Path("other", "curve.csv").read_bytes()
    record = read_record("run")
    assert record["result"] == pharos_json(curve.result()) and record["result"]["counted_steps"] == 300
    assert record["config"]["sources"]["agent"]["name"] == mine
    assert np.array_equal(np.load("run/policy.npy"), curve.table)


def pharos_json(result):
    return {name: None if value != value else value for name, value in result.items()}


def test_what_looks_like_a_mistake_is_a_note_of_the_run_and_of_the_summary(mine):
    def careless(env, steps, seed):
        env.reset()
        for _ in range(steps // 3):
            env.step(1)  # and no reset
        yield lambda seen: np.zeros(len(seen), int)

    run = train(careless, GRID, steps=300, evaluation_interval=100, out="run")
    assert list(run.notes) == ["steps after an end", "few steps"]
    assert (
        read_record("run")["notes"]
        == run.notes
        == train(careless, GRID, steps=300, evaluation_interval=100, out="run").notes
    )
    file = Path("mine.py")
    file.write_text(file.read_text().replace("if step % 50 == 49:", "if False:"))
    said = answer("train", GRID, "--agent", mine, "--steps", "300", "--observation", "one_hot")
    assert (
        said["notes"] == {"no policy": said["notes"]["no policy"]} and "yielded no policy" in said["notes"]["no policy"]
    )
    words = ("train", GRID, "--agent", mine, "--steps", "300", "--observation", "one_hot", "--seeds", "0:2")
    assert list(answer(*words)["notes"]["no policy"]) == ["seed 0", "seed 1"]
    assert "seed 0 and 1 more: yielded no policy" in " ".join(command(*words).stdout.split())


@pytest.mark.long
def test_where_uniform_play_is_optimal_no_normalised_regret_is_shown(mine):
    words = ("train", "simple_grid/4x4-plain", "--agent", "q_learning", "--steps", "300", "--horizon", "1000")
    for more in ((), ("--seeds", "0:2")):
        assert "uniform play is optimal as well" in " ".join(command(*words, *more).stdout.split())


def test_it_learns_and_is_loaded_again_where_it_is_trusted(mine):
    run = train(mine, GRID, observation="one_hot", steps=2000, evaluation_interval=500, out="run")
    assert run.result["final_regret"] == pytest.approx(0.0, abs=1e-9)
    task, policy = load_agent("run")  # this process has imported it
    assert evaluate_agent(policy, task).value == pytest.approx(run.result["final_value"], abs=1e-12)
    sources._LOADED.pop(mine)
    assert "add --trust" in refusal(UntrustedCode, load_agent, "run")
    assert evaluate_agent(load_agent("run", trust=True)[1], task).value == run.result["final_value"]


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 2)])
def test_a_function_that_was_killed_begins_anew_and_ends_with_the_same_bytes(mine, seeds):
    options = {"observation": "one_hot", "steps": 300, "evaluation_interval": 50, "seeds": seeds}

    def kill(now):
        if now.done >= 100:
            raise Killed

    whole = train_many(mine, GRID, out="whole", **options)
    with pytest.raises(Killed):
        train_many(mine, GRID, out="killed", progress=kill, **options)
    assert not list(Path("killed").rglob("checkpoint*/*"))
    again = train_many(mine, GRID, out="killed", **options)
    assert [end.result for end in again] == [end.result for end in whole]
    for seed in seeds:
        whole, killed = (Path(name, f"seed-{seed}") for name in ("whole", "killed"))
        for name in ("curve.csv", "policy.npy"):
            assert (whole / name).read_bytes() == (killed / name).read_bytes()
        assert sorted(path.name for path in killed.iterdir()) == ["curve.csv", "policy.npy", "run.json"]


def test_keywords_of_a_function_are_its_hyperparameters(mine):
    options = {"observation": "one_hot", "steps": 200, "evaluation_interval": 50}
    usual, same, other = (
        train(mine, GRID, hyperparameters=given, **options).curve for given in ({}, {"rate": 0.5}, {"rate": -0.5})
    )
    assert str(usual) == str(same) != str(other)
    with pytest.raises(UnknownName, match=r"unknown hyperparameter of mine.py:learn 'rat'; did you mean 'rate'\?"):
        train(mine, GRID, hyperparameters={"rat": 1}, **options)
    Path("bare.py").write_text("def learn(env, steps, seed):\n    yield 1\n")
    with pytest.raises(ParameterError, match=r"hyperparameters in its code; found rate; name them behind a \*"):
        train("bare.py:learn", GRID, hyperparameters={"rate": 1}, **options)


def test_an_argument_with_a_default_is_a_hyperparameter_and_no_key_of_jax(mine):
    text = Path("mine.py").read_text()
    assert "seed, *, rate" in text
    Path("plain.py").write_text(text.replace("seed, *, rate", "seed, rate"))
    options = {"observation": "one_hot", "steps": 200, "evaluation_interval": 50}
    for given in ({}, {"rate": -0.5}):
        behind, plain = (train(name, GRID, hyperparameters=given, **options) for name in (mine, "plain.py:learn"))
        assert str(behind.curve) == str(plain.curve)
    with pytest.raises(UnknownName, match=r"unknown hyperparameter of plain.py:learn 'seed'"):
        train("plain.py:learn", GRID, hyperparameters={"seed": 1}, **options)


def test_what_is_no_agent_is_refused_in_one_line(mine):
    Path("bad.py").write_text("number = 3\ndef two(env, steps): pass\ndef none(env, steps, seed): return 5\n")
    for name, said in (
        ("bad.py:missing", "bad.py has no 'missing'"),
        ("bad.py:number", "is 3; expected a class for Stable-Baselines3, or a function learn(env, steps, seed)"),
        ("bad.py:two", "expected a function learn(env, steps, seed)"),
        ("bad.py:none", "learn(env, steps, seed) returned 5; expected a generator"),
    ):
        assert said in refusal(ParameterError, train, name, GRID, steps=20)
    assert "expected a class for Stable-Baselines3" in refusal(ParameterError, train, 7, GRID, steps=20)

    def cheat(env, steps, seed):
        yield lambda seen: np.full(len(seen), 1)

    assert "0 of its 20 steps were counted" in refusal(ParameterError, train, cheat, GRID, steps=20)
    with pytest.raises(ParameterError, match=r"is a function, which has no logs of TensorBoard"):
        train(mine, GRID, steps=20, observation="one_hot", tensorboard=True, out="logged")


def test_a_generator_without_an_end_has_ended_when_its_steps_are_spent_and_is_refused_before():
    def endless(env, steps, seed, *, share=1.0):
        env.reset()
        for _ in range(int(share * steps)):
            if any(env.step(1)[2:4]):
                env.reset()
        while True:
            yield lambda seen: np.full(len(seen), 1)

    options = {"steps": 40, "evaluation_interval": 20}
    run = train(endless, GRID, hyperparameters={"share": 1}, **options)
    assert run.result["counted_steps"] == 40 and (run.agent[:, 1] == 1).all()
    said = refusal(ParameterError, train, endless, GRID, hyperparameters={"share": 0.5}, **options)
    assert "policies in a row without a step, after 20 of 40" in said


def test_an_error_in_a_function_is_that_of_its_run(mine):
    Path("broken.py").write_text("def learn(env, steps, seed):\n    env.reset()\n    yield [1, 2][seed]\n    1 / 0\n")
    task = Task.of(GRID)
    configs = [RunConfig.of_task(task, "broken.py:learn", steps=20, seed=seed) for seed in range(3)]
    ends = train_configs(configs, [Path(f"{seed}") for seed in range(3)])
    assert all(isinstance(end, FailedRun) for end in ends)
    words = "agent broken.py:learn raised IndexError: list index out of range (broken.py, line 3)"
    assert ends[2].error == words == read_record("2")["error"]


def test_a_function_of_this_process_has_a_name_here_alone(tmp_path):
    learn = constants({10: 1})
    run = train(learn, GRID, steps=40, evaluation_interval=20, out=tmp_path / "run")
    assert run.agent.shape == (16, 4) and (run.agent[:, 1] == 1).all()
    again = train(learn, GRID, steps=40, evaluation_interval=20, out=tmp_path / "run")
    assert again.result == run.result and again.agent is None
    assert run.config["agent"] == f"{__name__}:constants.<locals>.learn"


def test_a_search_tries_keywords_and_begins_with_the_defaults(mine):
    space = {"rate": ("log", 0.001, 1.0)}
    found = tune(mine, GRID, observation="one_hot", steps=400, trials=3, seeds=[0], space=space, out="tuned")
    assert found.trials[0]["hyperparameters"] == {"rate": 0.5} and found.score <= found.first_score
    assert "has no space to search" in refusal(ParameterError, tune, mine, GRID, steps=40)
    told = answer(
        *("train", GRID, "--agent", mine, "--observation", "one_hot", "--steps", 60),
        *("--hyperparameters", "tuned/hyperparameters.yaml"),
    )
    assert told["config"]["hyperparameters"] == found.hyperparameters
    assert told["counted_steps"] == 60


@pytest.mark.long
def test_a_study_trains_functions_of_files_and_a_received_one_needs_trust(mine, tmp_path):
    block = f"{{environments: [{GRID}], observations: [one_hot], agents: ['{mine}', q_learning]}}"
    Path("own.yaml").write_text(f"name: own\nsteps: 200\nevaluations: 4\nseeds: 2\nblocks: [{block}]\n")
    end = study.run("own.yaml", "results", workers=2)
    assert (end.finished, end.errors) == (4, {})
    spec = study.specification("own.yaml")
    run = next(run for run in spec.runs if run.configuration.agent == mine)
    train(mine, GRID, observation="one_hot", steps=200, evaluation_interval=50, out="alone")
    there = tmp_path / "results" / "runs" / run.id
    assert [row["value"] for row in read_rows(there)] == [row["value"] for row in read_rows("alone")]
    assert "is code, which is executed only if you trust it" in usage_error("study", "status", "results")
    assert answer("study", "status", "results", "--trust")["finished"] == 4


KILLED = """
import os, signal

def learn(env, steps, seed):
    if seed == 0 or not os.path.exists(f"mark-{seed}"):
        open(f"mark-{seed}", "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    env.reset()
    while True:
        env.step(0)
        yield lambda seen: seen[:, 0].astype(int)
"""


@pytest.mark.long
def test_processes_that_are_killed_are_begun_again_and_only_a_run_that_always_dies_has_failed(mine):
    Path("killed.py").write_text(KILLED)
    task = Task.of(GRID, observation="one_hot")
    configs = [RunConfig.of_task(task, "killed.py:learn", steps=20, seed=seed) for seed in range(3)]
    dead, *others = train_configs(configs, [Path(f"{seed}") for seed in range(3)], workers=2)
    assert isinstance(dead, FailedRun)
    assert dead.error == "its process ended by SIGKILL, 3 times; was there memory enough?" == read_record("0")["error"]
    assert [end.result["counted_steps"] for end in others] == [20, 20]


@pytest.mark.slow
def test_a_function_of_jax_learns_with_all_seeds_as_one_program(mine, tmp_path):
    jax = pytest.importorskip("jax")
    pytest.importorskip("gymnax")
    programs = []

    def learn(env, params, steps, key, *, scale=1.0):
        programs.append(steps)
        snapshots = scale * jax.random.normal(key, (4, env.num_actions))
        return lambda logits, seen: jax.nn.softmax(jax.numpy.broadcast_to(logits, (len(seen), 4))), snapshots

    options = {"steps": 40, "evaluation_interval": 10, "observation": "one_hot"}
    ends = train_many(learn, GRID, seeds=(0, 1, 2), out=tmp_path / "runs", **options)
    assert len(programs) == 1
    task = Task.of(GRID, observation="one_hot")
    logits = np.asarray(jax.random.normal(jax.random.PRNGKey(1), (4, 4)), float)
    for row, weights in zip(ends[1].curve[1:], np.exp(logits), strict=True):
        table = np.tile(weights / weights.sum(), (task.mdp.num_states, 1))
        assert row["value"] == pytest.approx(evaluate_agent(table, task).value, abs=1e-5)
    alone = train(learn, GRID, seed=1, **options)
    assert str(alone.curve) == str(ends[1].curve)
    assert "expected a divisor" in refusal(ParameterError, train, learn, GRID, steps=40, evaluation_interval=15)


class Stepped:
    """Q-learning on one-hot observations, as a class whose steps pharos takes."""

    def __init__(self, observation_space, action_space, num_envs, seed, rate=0.5):
        assert num_envs == 1
        self.q, self.rng = np.zeros((observation_space.shape[0], action_space.n)), np.random.default_rng(seed)
        self.rate = rate

    def act(self, observations):
        return self.rng.integers(self.q.shape[1], size=len(observations))

    def observe(self, observations, actions, rewards, next_observations, terminated, truncated):
        (x,), (action,), (after,) = observations, actions, next_observations
        best = 0.9 * (not terminated[0]) * (after @ self.q).max()
        self.q[:, action] += self.rate * x * (rewards[0] + best - x @ self.q[:, action])

    def policy(self, observations):
        return (observations @ self.q).argmax(axis=1)


def as_function(env, steps, seed, *, rate=0.5):
    agent = Stepped(env.observation_space, env.action_space, 1, seed, rate)
    x, _ = env.reset(seed=seed)
    for step in range(steps):
        action = agent.act(x[None])
        after, reward, terminated, truncated, _ = env.step(int(action[0]))
        agent.observe(x[None], action, [reward], after[None], [terminated], [truncated])
        x = env.reset()[0] if terminated or truncated else after
        if step % 50 == 49:
            yield agent.policy


def test_a_class_with_act_observe_and_policy_learns_as_its_loop_written_out_does(tmp_path):
    options = {"observation": "one_hot", "random": 0.2, "steps": 400, "evaluation_interval": 50, "seed": 3}
    for rate in (0.5, 0.1):
        curves = [
            train(agent, GRID, **options, hyperparameters={"rate": rate}).curve for agent in (Stepped, as_function)
        ]
        assert repr(curves[0]) == repr(curves[1]) and len({row["value"] for row in curves[0]}) > 2
    with pytest.raises(UnknownName, match=r"hyperparameter of .*Stepped.*'rat'.*did you mean 'rate'"):
        train(Stepped, GRID, **options, hyperparameters={"rat": 0.1})


def test_actions_of_a_wrong_shape_are_one_line(tmp_path):
    class Scalar(Stepped):
        def act(self, observations):
            return 0

    with pytest.raises(ParameterError, match=r"act\(observations\) gave an array of shape \(\); expected \(1,\)"):
        train(Scalar, GRID, observation="one_hot", steps=100)
