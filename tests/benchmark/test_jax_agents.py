"""Agents in JAX on tasks of the benchmark: which snapshot counts, and that its value is exact. Skipped without JAX."""

import os
from dataclasses import replace

import numpy as np
import pytest

import pharos
from pharos import benchmark
from pharos.benchmark import BenchmarkTask, Protocol, Suite
from pharos.benchmark.suite import digest_of_suite, frozen
from pharos.errors import AllRunsFailed, ParameterError
from pharos.training import Task, evaluate_agent
from pharos.training.functions import compiled_curves

GRID = "simple_grid/4x4-plain"


@pytest.fixture(scope="module")
def jax():
    pytest.importorskip("gymnax")
    return pytest.importorskip("jax")


def learner(jax, number):
    """Q-learning with a linear function, `number` snapshots."""
    jnp = jax.numpy

    def learn(env, params, steps, key):
        def step(carry, key):
            q, seen, state = carry
            key_action, key_coin, key_step = jax.random.split(key, 3)
            other = jax.random.randint(key_action, (), 0, env.num_actions)
            action = jnp.where(jax.random.uniform(key_coin) < 0.5, other, jnp.argmax(seen @ q))
            after, state, reward, terminated, _, info = env.step(key_step, state, action, params)
            ahead = jnp.where(terminated, 0.0, jnp.max(info["final_observation"] @ q))
            q = q.at[:, action].add(0.2 * (reward + 0.9 * ahead - seen @ q[:, action]) * seen)
            return (q, after, state), None

        def part(carry, keys):
            carry, _ = jax.lax.scan(step, carry, keys)
            return carry, {"q": carry[0]}

        key, key_reset = jax.random.split(key)
        seen, state = env.reset(key_reset, params)
        keys = jax.random.split(key, steps).reshape(number, steps // number, -1)
        _, snapshots = jax.lax.scan(part, (jnp.zeros((seen.size, env.num_actions)), seen, state), keys)
        return lambda parameters, observations: jnp.argmax(observations @ parameters["q"], axis=1), snapshots

    return learn


def constants(jax, weights):
    """Snapshots of policies that play by fixed logits (K, A), whatever they see."""

    def learn(env, params, steps, key):
        def policy(logits, observations):
            return jax.nn.softmax(jax.numpy.broadcast_to(logits, (len(observations), env.num_actions)))

        return policy, jax.numpy.asarray(weights)

    return learn


@pytest.mark.slow
def test_an_agent_learns_and_its_curve_is_that_of_its_policies(jax):
    task = Task.of(GRID, observation="one_hot", random=0.1)
    learn, seeds = learner(jax, 5), (3, 4)
    curves = compiled_curves(learn, task, steps=5000, evaluations=5, seeds=seeds)
    env = pharos.to_gymnax(task.mdp, "one_hot", time_limit=task.env.max_episode_steps)
    for seed, curve in zip(seeds, curves, strict=True):
        snapshots = jax.jit(lambda key: learn(env, env.default_params, 5000, key)[1])(jax.random.PRNGKey(seed))
        tables = np.argmax(np.asarray(env.default_params.observations[:-1] @ snapshots["q"]), axis=2)
        values = [evaluate_agent(table, task).value for table in tables]
        assert [row["step"] for row in curve.rows] == [0, 1000, 2000, 3000, 4000, 5000]
        assert all(row["exact"] for row in curve.rows)
        assert [row["value"] for row in curve.rows[1:]] == pytest.approx(values, abs=1e-12)
        assert curve.rows[0]["normalized_regret"] == pytest.approx(1.0)
        assert curve.rows[-1]["normalized_regret"] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("number", "expected"), [(6, [1, 3, 5]), (3, [0, 1, 2]), (2, [-1, 0, 1]), (1, [-1, -1, 0])])
def test_the_snapshot_that_was_taken_last_counts(jax, number, expected):
    task = Task.of(GRID)
    weights = np.random.default_rng(0).normal(size=(number, 4)).astype(np.float32)
    (curve,) = compiled_curves(constants(jax, weights), task, steps=300, evaluations=3, seeds=[0])
    tables = [*np.exp(weights.astype(float)), np.ones(4)]
    for row, place in zip(curve.rows[1:], expected, strict=True):
        table = np.tile(tables[place] / tables[place].sum(), (task.mdp.num_states, 1))
        assert row["value"] == pytest.approx(evaluate_agent(table, task).value, abs=1e-5)


@pytest.mark.slow
def test_rewards_have_the_noise_of_the_task(jax):
    space = pharos.build(GRID, progress=False)
    plain, noisy = pharos.to_gymnax(space), pharos.to_gymnax(space, reward_noise=2.0)
    keys = jax.random.split(jax.random.PRNGKey(0), 4000)

    def pay(env, key):
        _, state = env.reset(key)
        _, after, reward, *_ = env.step_env(key, state, 1, env.default_params)
        return after.index, reward

    index, rewards = jax.vmap(lambda key: pay(plain, key))(keys)
    index_with, rewards_with = jax.vmap(lambda key: pay(noisy, key))(keys)
    assert (index == index_with).all()
    noise = np.asarray(rewards_with - rewards)
    assert abs(noise.mean()) < 4 * 2.0 / np.sqrt(4000)
    assert noise.std() == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "simple_image", "observation_options": {"frames": 2}}, "have no frames"),
        ({"reward_delay": 2}, "have no reward_delay"),
        ({"previous_action": True}, "have no previous_action"),
    ],
)
def test_what_is_in_no_table_is_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        compiled_curves(None, Task.of(GRID, **options), steps=3, evaluations=3, seeds=[0])


def test_snapshots_without_a_common_axis_are_refused(jax):
    task = Task.of(GRID)
    for snapshots in ((np.zeros(2), np.zeros(3)), np.float32(1)):
        learn = lambda *_, each=snapshots: (None, jax.tree.map(jax.numpy.asarray, each))  # noqa: E731
        with pytest.raises(ParameterError, match="expected one number of at least 1"):
            compiled_curves(learn, task, steps=3, evaluations=3, seeds=[0])


@pytest.mark.slow
def test_a_suite_is_run_and_goes_on(jax, tmp_path):
    protocol = Protocol(steps=300, evaluations=3, seeds=2)
    suite = _suite(protocol)
    calls = tmp_path / "calls"

    def learn(env, params, steps, key):
        with calls.open("a") as file:
            print(steps, file=file)
        return learner(jax, 3)(env, params, steps, key)

    found = benchmark.run(learn, suite, out=tmp_path / "mine", seeds=range(2))
    assert calls.read_text() == "300\n" and found.results.record["form"] == "jax" and not found.missing
    assert found.results.curves["grid-4"].shape == (2, 3)
    again = benchmark.run(learn, suite, out=tmp_path / "mine", seeds=range(2))
    assert calls.read_text() == "300\n"
    np.testing.assert_array_equal(again.results.curves["grid-4"], found.results.curves["grid-4"])

    def broken(env, params, steps, key):
        raise ValueError("no gradient")

    with pytest.raises(AllRunsFailed, match="no gradient"):
        benchmark.run(broken, suite, out=tmp_path / "broken", seeds=range(2))


@pytest.mark.slow
def test_a_program_has_a_process_of_its_own_with_a_limit_and_its_crash_costs_its_own_task(jax, tmp_path):
    helper = jax.jit(lambda key: jax.random.uniform(key, (3, 4)))  # sent by value with the function

    def learn(env, params, steps, key, *, fault=""):
        (tmp_path / str(os.getpid())).touch()
        if fault == "crash" and len(params.observations) == 17:  # 16 states, and the end
            os._exit(9)
        while fault == "loop":
            pass
        return lambda logits, seen: jax.nn.softmax(jax.numpy.broadcast_to(logits, (len(seen), 4))), helper(key)

    suite = _suite(Protocol(steps=300, evaluations=3, seeds=2), 4, 5)
    end = benchmark.run(learn, suite, out=tmp_path / "crash", seeds=range(2), hyperparameters={"fault": "crash"})
    said = end.missing
    assert list(said) == ["grid-4, seed 0", "grid-4, seed 1"] and "exit code 9" in said["grid-4, seed 1"]
    assert list(end.results.curves) == ["grid-5"]
    assert len(list(tmp_path.glob("[0-9]*"))) == 2 and not (tmp_path / str(os.getpid())).exists()
    options = {"timeout": 0.5, "hyperparameters": {"fault": "loop"}, "tasks": "grid-4"}
    with pytest.raises(AllRunsFailed, match=r"took longer than 0\.5 s"):
        benchmark.run(learn, suite, out=tmp_path / "loop", seeds=[0], **options)


def _suite(protocol, *sizes):
    options = {f"grid-{size}": {"height": size, "width": size} for size in sizes or [4]}
    tasks = [BenchmarkTask(name, "simple_grid", sides, "one_hot") for name, sides in options.items()]
    suite = Suite("one", protocol, tuple(frozen(task, protocol) for task in tasks), (), "", {})
    return replace(suite, digest=digest_of_suite(suite))
