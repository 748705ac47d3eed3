"""Loops of the user's own: a task of a suite that records policies, `pharos.Run`, and the check of an agent."""

import json
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import pharos
from command_line import answer, run
from pharos import benchmark
from pharos.benchmark import BenchmarkTask, BudgetSpent, Protocol, Suite, write_suite
from pharos.benchmark.suite import digest_of_suite, frozen
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.training import RegretCurve, evaluate_agent, load_agent, read_record, read_rows

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
TASKS = (
    BenchmarkTask("sea", "deep_sea", {"size": 4, "mapping_seed": 1}, "one_hot"),
    BenchmarkTask("lake", "frozen_lake", {}, "vector", chance={"sticky": 0.25}),
)
LEARN = """
import numpy as np


def learn(env, steps, seed):
    draw, wins = np.random.default_rng(seed), np.zeros(env.action_space.n)
    env.reset(seed=seed)
    for step in range(1, steps + 1):
        action = int(draw.integers(len(wins)))
        _, reward, terminated, truncated, _ = env.step(action)
        wins[action] += reward
        if terminated or truncated:
            env.reset()
        if step % 60 == 0:
            yield lambda seen, best=int(wins.argmax()): np.full(len(seen), best)
"""


@pytest.fixture(scope="module")
def suite():
    whole = Suite("small", PROTOCOL, tuple(frozen(task, PROTOCOL) for task in TASKS), (), "", {})
    return replace(whole, digest=digest_of_suite(whole))


def play(env, steps, action=0):
    """Play one action; whether the budget ended it."""
    env.reset()
    for _ in range(steps):
        if any(env.step(action)[2:4]):
            env.reset()


def always(action):
    return lambda observations: np.full(len(observations), action)


def test_a_table_of_a_loop_is_evaluated_from_its_folder_and_steps_are_numbers_of_steps(tmp_path):
    options = {"steps": 100, "height": 3, "width": 3}
    with pharos.Run("simple_grid", out=tmp_path / "table", **options) as loop:
        for step, policy, said in ((-1, 0, "step is -1"), (1.5, 0, "step is 1.5"), (10, None, "policy is None")):
            with pytest.raises(ParameterError, match=said):
                loop.evaluate(step, policy)
        value = loop.evaluate(100.0, np.ones(9, int))["value"]
    task, table = load_agent(tmp_path / "table")
    assert evaluate_agent(table, task).value == value
    with pharos.Run("simple_grid", out=tmp_path / "function", **options) as loop:
        loop.evaluate(100, always(0))
    with pytest.raises(FileFormatError, match="keeps its policy if that is a table"):
        load_agent(tmp_path / "function")


def test_results_of_a_suite_in_a_file_say_that_it_is_to_be_named(tmp_path, suite):
    write_suite(suite, tmp_path / "small.yaml")
    options = ("--agent", "q_learning", "--seeds", "0:2", "--out", tmp_path / "r")
    assert run("benchmark", "run", "--suite", tmp_path / "small.yaml", *options).exit_code == 0
    words = ("benchmark", "report", tmp_path / "r", "--out", tmp_path / "r.html")
    assert "suite 'small', which is not shipped; give its file: --suite" in run(*words).output
    assert run(*words, "--suite", tmp_path / "small.yaml").exit_code == 0 and (tmp_path / "r.html").stat().st_size


# Tasks ----------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_loop_leaves_the_files_of_the_same_generator(suite, tmp_path):
    """The loop is that of LEARN, written out around the environment of each task."""
    (tmp_path / "mine.py").write_text(LEARN)
    expected = benchmark.run(f"{tmp_path / 'mine.py'}:learn", suite, out=tmp_path / "run", seeds=range(2), workers=1)
    names = {}
    exec(LEARN, names)  # the generator as a loop
    for name in ("lake", "sea"):
        for seed in range(2):
            with benchmark.task(name, suite=suite, seed=seed, out=tmp_path / "own", agent="mine") as env:
                assert env.steps == 300
                for policy in names["learn"](env, env.steps, seed):
                    env.record(policy)
    own = benchmark.read_results(tmp_path / "own")
    assert own.agent == "mine" and own.seeds == (0, 1) and own.digest == suite.digest
    for task, curve in expected.results.curves.items():
        np.testing.assert_array_equal(own.curves[task], curve)
        for seed in range(2):
            here, there = (tmp_path / folder / "runs" / task / f"seed-{seed}" for folder in ("own", "run"))
            assert {path.name for path in here.iterdir()} == {path.name for path in there.iterdir()}
            assert (here / "curve.csv").read_bytes() == (there / "curve.csv").read_bytes()
            assert (here / "policy.npy").read_bytes() == (there / "policy.npy").read_bytes()
    both = benchmark.compare(tmp_path / "own", tmp_path / "run", suite=suite)
    assert both.core.interval.value == 0 and own.record["steps_used"] == 1200
    benchmark.report(tmp_path / "own", tmp_path / "own.html", beside=[tmp_path / "run"], suite=suite)
    assert "1,200" in (tmp_path / "own.html").read_text()


def test_results_have_tasks_of_which_all_seeds_are_there(suite, tmp_path):
    def end(name, seed):
        with benchmark.task(name, suite=suite, seed=seed, out=tmp_path) as env:
            play(env, 30)
            env.record(always(1))

    end("sea", 0)
    assert list(benchmark.read_results(tmp_path).curves) == ["sea"]
    end("lake", 1)  # neither has both seeds
    assert list(benchmark.read_results(tmp_path).curves) == ["sea"]
    end("sea", 1)
    assert benchmark.read_results(tmp_path).curves["sea"].shape == (2, 3)
    end("lake", 0)
    assert list(benchmark.read_results(tmp_path).curves) == ["lake", "sea"]


def test_the_budget_ends_a_with_block_and_an_error_is_the_run_s_own(suite, tmp_path):
    with benchmark.task("sea", suite=suite, out=tmp_path) as env:
        play(env, 10)
        env.record(always(1))
        play(env.copy(), 10**6)
    record = read_record(tmp_path / "runs" / "sea" / "seed-0")
    assert record["status"] == "finished" and record["result"]["counted_steps"] == 300
    with pytest.raises(ParameterError, match="is closed"):
        env.record(always(0))
    with pytest.raises(ZeroDivisionError), benchmark.task("sea", suite=suite, seed=1, out=tmp_path) as env:
        play(env, 10)
        _ = 1 / 0
    record = read_record(tmp_path / "runs" / "sea" / "seed-1")
    assert record["status"] == "failed" and "ZeroDivisionError: division by zero" in record["error"]


def test_without_a_folder_there_is_the_curve(suite):
    env = benchmark.task("sea", suite=suite)
    with pytest.raises(BudgetSpent):
        play(env, 10**6)
    env.record(always(1))
    assert [row["step"] for row in env.curve().rows] == [0, 100, 200, 300]
    assert env.notes()["late policy"].startswith("its first policy came after 300 of 300 steps: 2 of 3 evaluations")
    env.close()
    with pytest.raises(UnknownName, match="task of suite v1 'deep_see-8'; did you mean"):
        benchmark.task("deep_see-8")
    with pytest.raises(ParameterError, match="seed is -1"):
        benchmark.task("sea", suite=suite, seed=-1)


def test_a_folder_has_one_setting(suite, tmp_path):
    for rate, error in ((0.1, None), (0.1, None), (0.2, "another hyperparameters")):
        env = benchmark.task("sea", suite=suite, out=tmp_path, hyperparameters={"rate": rate})
        play(env, 5)
        env.record(always(1))
        if error is None:
            env.close()
            continue
        with pytest.raises(ParameterError, match=error):
            env.close()


@pytest.mark.long
def test_a_loop_of_stable_baselines3_takes_the_environment_and_its_model_is_a_policy(suite, tmp_path):
    """PPO on the environment itself, and on copies with a callback that records; the budget ends its own loop."""
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv

    options = {"n_steps": 30, "batch_size": 30, "seed": 0, "device": "cpu"}
    with benchmark.task("lake", suite=suite, seed=0, out=tmp_path / "out") as env:
        model = sb3.PPO("MlpPolicy", env, **options)
        model.learn(120)
        env.record(model)
        with pytest.raises(ParameterError, match="of Stable-Baselines3: the model itself"):
            env.record(model.policy)
        model.learn(180, reset_num_timesteps=False)
        env.record(model)
    assert env.budget.steps == 300 and not env.notes()
    value = evaluate_agent(model, env._task).value
    assert env.curve().rows[-1]["value"] == pytest.approx(value, abs=1e-6)

    class Recording(BaseCallback):
        def _on_rollout_end(self):
            env.record(self.model)

        def _on_step(self):
            return True

    with benchmark.task("lake", suite=suite, seed=1, out=tmp_path / "out") as env:
        copies = DummyVecEnv([env.copy] * 3)
        sb3.PPO("MlpPolicy", copies, **options).learn(10**6, callback=Recording())
    assert env.budget.steps == 300 and env.budget.episodes > 0 and not env.notes()
    assert benchmark.read_results(tmp_path / "out").curves["lake"].shape == (2, 3)


# Any target -----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_of_any_target_has_the_folder_of_train(tmp_path):
    options = {"random": 0.1, "size": 4, "observation": "one_hot"}
    with pharos.Run("frozen_lake", steps=400, out=tmp_path / "run", **options) as run:
        run.evaluate(0, always(0))
        play(run.env, 200)
        row = run.record(always(1))
        table = np.full(run.task.mdp.num_states, 2)
        run.evaluate(400, table)
    mdp = pharos.random_actions(pharos.build("frozen_lake/4x4", progress=False).mdp(gamma=1.0).with_horizon(100), 0.1)
    best = pharos.value_iteration(mdp).value_at_start
    values = [pharos.evaluate_policy(mdp, np.full(16, action)[: mdp.num_states]).value_at_start for action in range(3)]
    assert [each["step"] for each in run.rows] == [0, 200, 400] and row["episodes"] == run.env.budget.episodes > 0
    np.testing.assert_allclose([each["value"] for each in run.rows], values)
    np.testing.assert_allclose([each["expected_regret"] for each in run.rows], best - np.array(values))
    record = read_record(tmp_path / "run")
    assert record["status"] == "finished" and record["result"]["counted_steps"] == 200
    assert [each["value"] for each in read_rows(tmp_path / "run")] == [each["value"] for each in run.rows]
    np.testing.assert_allclose(RegretCurve.read(tmp_path / "run").expected, best - np.array(values))
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "policy.npy"), table)
    pharos.train("q_learning", "frozen_lake", steps=400, out=tmp_path / "train", random=0.1, size=4)
    assert {*record} == {*read_record(tmp_path / "train")} - {"compiling_seconds"}
    with pytest.raises(ParameterError, match="holds a finished run; choose another folder"):
        pharos.Run("frozen_lake", steps=400, out=tmp_path / "run", **options)


def test_what_is_wrong_with_a_run_is_said(tmp_path):
    with pytest.raises(UnknownName, match="frozen_lake"):
        pharos.Run("frozen_lak")
    with pytest.raises(ParameterError, match="without a policy"), pharos.Run("frozen_lake", steps=10):
        pass
    with pharos.Run("frozen_lake", steps=10) as run:
        run.evaluate(5, always(1))
        with pytest.raises(ParameterError, match="step 5 comes after step 5"):
            run.evaluate(5, always(1))
        with pytest.raises(ParameterError, match="sum to"):
            run.evaluate(6, lambda seen: np.full((len(seen), 4), 0.3))
        play(run.env, 100)  # is ended by the budget
    assert run.env.budget.steps == 10 and len(run.rows) == 1
    with pytest.raises(RuntimeError), pharos.Run("frozen_lake", steps=10, out=tmp_path / "failed"):
        raise RuntimeError("no")
    assert read_record(tmp_path / "failed")["error"] == "RuntimeError: no"
    with pharos.Run("frozen_lake", steps=10, out=tmp_path / "failed") as run:  # and again
        run.record(always(1))
    assert read_record(tmp_path / "failed")["status"] == "finished"
    with pytest.raises(ParameterError, match="another run"):
        (tmp_path / "other").mkdir()
        with pytest.raises(KeyError), pharos.Run("frozen_lake", steps=11, out=tmp_path / "other"):
            raise KeyError
        pharos.Run("frozen_lake", steps=10, out=tmp_path / "other")


@pytest.mark.long
def test_environments_of_a_run_go_into_vector_environments():
    with pharos.Run("catch", steps=100, rows=4, columns=3) as run:
        run.evaluate(0, always(0))
        envs = gymnasium.vector.SyncVectorEnv([run.env.copy] * 4)
        _, info = envs.reset(seed=0)
        assert info == {}
        for _ in range(1000):
            envs.step(np.zeros(4, int))
        pytest.fail("the budget was not spent")
    assert run.env.budget.steps == 100 and len(run.rows) == 1


# The check of an agent ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_check_of_an_agent_says_what_is_wrong(tmp_path, monkeypatch):
    file, spoilt = tmp_path / "mine.py", tmp_path / "spoilt.py"
    file.write_text(LEARN)
    spoilt.write_text(LEARN.replace("yield lambda seen,", "env.reset(mode=1); yield lambda seen,"))
    done = pharos.check_agent(f"{file}:learn")
    assert done and not done.errors and not done.notes and {*done.scores} == {"vectors", "images"}
    assert str(done).startswith(f"{file}:learn: keeps the contract; scores ")
    done = pharos.check_agent(f"{spoilt}:learn")
    assert not done and len(done.errors) == 4 and not done.scores
    assert all("TypeError" in each and "(spoilt.py, line 15)" in each and "\n" not in each for each in done.errors)
    assert "  error: " in str(done)
    drawn = "yield lambda seen, w=draw.normal(size=(*env.observation_space.shape, len(wins))): "
    drawn += "np.tensordot(seen, w, w.ndim - 1).argmax(1)"
    text = LEARN.replace("yield lambda seen, best=int(wins.argmax()): np.full(len(seen), best)", drawn)
    (tmp_path / "same.py").write_text(
        text.replace("default_rng(seed)", "default_rng(0)").replace("seed=seed", "seed=0")
    )
    (tmp_path / "other.py").write_text(text.replace("default_rng(seed)", "default_rng()"))
    said = answer("benchmark", "check", f"{tmp_path / 'same.py'}:learn")
    assert said["errors"] == [] and any("the same curve" in note for note in said["notes"])
    assert any(
        "another run with the same seed" in note for note in pharos.check_agent(f"{tmp_path}/other.py:learn").notes
    )
    done = run("benchmark", "check", f"{file}:nothing")
    assert done.exit_code == 1 and "mine.py has no 'nothing'" in done.stdout
    write_suite(Suite("x", PROTOCOL, (), (), "", {}), tmp_path / "x.yaml")
    assert json.loads(run("benchmark", "check", f"{file}:learn", "--json").stdout)["agent"] == f"{file}:learn"


def test_a_loop_on_one_task_without_readings_is_diagnosed(tmp_path):
    with benchmark.task("deep_sea-8", out=tmp_path / "mine", agent="mine") as env:
        play(env, 10)
        env.record(always(0))
    done = run("diagnose", "--results", tmp_path / "mine")
    assert done.exit_code == 0 and "warning" not in done.output
    assert "Known faults are not compared" in done.output and "run your loop on these tasks" in done.output
