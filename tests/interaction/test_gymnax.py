"""`to_gymnax`: the table steps in JAX as it does elsewhere. Skipped where JAX and gymnax are not installed."""

import subprocess
import sys

import numpy as np
import pytest

import pharos
from pharos.errors import MissingExtra, ParameterError
from refusals import refusal


def test_without_jax_it_says_which_extra_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    monkeypatch.delitem(sys.modules, "pharos.interaction.gymnax_env", raising=False)
    with pytest.raises(MissingExtra, match=r"to_gymnax needs jax.*\[jax\]"):
        pharos.to_gymnax(pharos.build("simple_grid/4x4-plain", progress=False))


@pytest.mark.long
def test_nothing_loads_jax_unless_it_is_asked_for():
    code = "import pharos, pharos.interaction; pharos.to_gymnax; import sys; print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.fixture(scope="module")
def jax():
    pytest.importorskip("gymnax")
    return pytest.importorskip("jax")


@pytest.fixture(scope="module")
def space():
    return pharos.build("frozen_lake/4x4", progress=False)


def walks(jax, env, number, steps, seed=0):
    """Uniform walks: index, executed action, reward, terminated, truncated and the index after it, (steps, number)."""
    params = env.default_params

    def step(carry, key):
        state = carry
        key_action, key_step = jax.random.split(key)
        action = jax.random.randint(key_action, (), 0, env.num_actions)
        seen, after, reward, terminated, truncated, info = env.step(key_step, state, action, params)
        following = info["final_observation"]
        row = (state.index, info["executed"], reward, terminated, truncated, after.index, following, action, seen)
        return after, row

    def walk(key):
        key_reset, key_steps = jax.random.split(key)
        _, state = env.reset(key_reset, params)
        return jax.lax.scan(step, state, jax.random.split(key_steps, steps))[1]

    keys = jax.random.split(jax.random.PRNGKey(seed), number)
    return [np.swapaxes(np.asarray(each), 0, 1) for each in jax.jit(jax.vmap(walk))(keys)]


def test_the_interface_is_that_of_gymnax(jax, space):
    env = pharos.to_gymnax(space)
    params, key = env.default_params, jax.random.PRNGKey(0)
    seen, state = env.reset(key, params)
    for _ in range(20):
        action = env.action_space(params).sample(key)
        assert env.action_space(params).contains(action)
        seen, state, reward, *_, info = env.step(key, state, action, params)
        assert env.observation_space(params).contains(seen)
        assert seen.shape == env.observation_space(params).shape and seen.dtype == env.observation_space(params).dtype
        assert 0 <= state.index < space.num_states and reward.shape == () and info["discount"].shape == ()
        key, _ = jax.random.split(key)
    assert env.num_actions == 4 and env.name.startswith("FrozenLake")


@pytest.mark.slow
def test_the_wrappers_of_gymnax_take_it(jax, space):
    from gymnax.wrappers import GymnaxToGymWrapper

    wrapped = GymnaxToGymWrapper(pharos.to_gymnax(space))
    seen, _ = wrapped.reset(seed=0)
    assert wrapped.observation_space.contains(np.asarray(seen))
    assert len(wrapped.step(wrapped.action_space.sample())) == 5


@pytest.mark.slow
def test_walks_are_those_of_the_table(jax, space):
    mdp = pharos.sticky_actions(space.mdp(gamma=1.0), 0.25)
    env = pharos.to_gymnax(mdp, time_limit=9)
    index, executed, reward, terminated, truncated, after, following, action, _ = walks(jax, env, 400, 60)
    table = np.asarray(space.successors)[index, executed]
    over = terminated | truncated
    assert (after[~over] == table[~over]).all()
    seen = pharos.observe(space.environment, "vector")(space.states(slice(None)))
    assert (following == seen[table]).all()
    assert (terminated == np.asarray(space.terminal)[table]).all()
    assert np.allclose(reward, np.asarray(mdp.rewards)[index, executed])
    assert set(np.unique(after[over])) <= set(mdp.start_states.tolist())
    times = [np.diff(np.flatnonzero(column), prepend=-1).max() for column in over.T if column.any()]
    assert max(times) == 9
    share = (executed != action)[1:][~over[:-1]].mean()
    assert share == pytest.approx(0.25 * 0.75, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frozen_lake/4x4", "cliff_walking/4x12-slippery"])
def test_returns_of_uniform_walks_have_the_mean_that_is_solved_for(jax, name):
    from pharos.solvers import uniform_value

    space = pharos.build(name, progress=False)
    mdp = pharos.random_actions(space.mdp(gamma=1.0), 0.2).with_horizon(30)
    _, _, reward, terminated, truncated, *_ = walks(jax, pharos.to_gymnax(mdp), 20_000, 30)
    ended = np.cumsum(terminated | truncated, axis=0) - (terminated | truncated) > 0
    returns = np.where(ended, 0.0, reward).sum(axis=0)
    error = 4 * returns.std() / np.sqrt(len(returns))
    assert abs(returns.mean() - uniform_value(mdp).value_at_start) < error


@pytest.mark.slow
def test_steps_within_sets_are_those_of_the_mdp(jax):
    """Each state and action as often as the chain of uniform choices says, under sticky and random actions."""
    world = np.random.default_rng(5)
    table, sets = world.integers(4, size=(4, 3)), np.array([[0, 1, 1], [1, 0, 0], [1, 1, 1], [1, 0, 1]], bool)
    plain = pharos.TabularMDP.from_arrays(table, world.normal(size=(4, 3)), gamma=1.0, available=sets)
    mdp = pharos.random_actions(pharos.sticky_actions(plain, 0.4), 0.3)
    env = pharos.to_gymnax(mdp, np.eye(4, dtype=np.float32), time_limit=6)
    index, executed, reward, _, truncated, after, _, action, _ = walks(jax, env, 40_000, 6)
    assert sets[index, executed].all()
    assert (after[~truncated] == table[index, executed][~truncated]).all()
    np.testing.assert_allclose(reward, np.asarray(mdp.rewards)[index, executed], rtol=1e-6)
    # what is executed, by plain Python, of a choice that acts as the first available action if it is not available
    for step in (0, 3):
        counts, expected = {}, {}
        rows = zip(
            index[step], executed[step - 1] if step else [None] * 40_000, action[step], executed[step], strict=True
        )
        for s, b, choice, a in rows:
            key = int(s), (None if b is None or not sets[s, b] else int(b)), int(choice)
            counts.setdefault(key, np.zeros(3))[a] += 1
        for (s, b, choice), sampled in counts.items():
            chosen = choice if sets[s, choice] else int(sets[s].argmax())
            expected = 0.3 * sets[s] / sets[s].sum() + 0.7 * (np.arange(3) == chosen)
            if b is not None:
                expected = 0.6 * expected + 0.4 * (np.arange(3) == b)
            deviation = np.sqrt(expected * (1 - expected) / sampled.sum())
            assert (np.abs(sampled / sampled.sum() - expected) <= 5 * deviation + 1e-9).all()
    _, state = env.reset(jax.random.PRNGKey(0), env.default_params)
    assert env.action_mask(state).tolist() == sets[int(state.index)].tolist()
    info = env.step(jax.random.PRNGKey(0), state, 1, env.default_params)[-1]
    assert info["action_mask"].tolist() == sets[table[int(state.index), int(info["executed"])]].tolist()


def test_what_says_too_little_is_refused(jax, space):
    chain = pharos.TabularMDP.from_arrays(np.array([[0, 1], [0, 1]]), np.zeros((2, 2)), gamma=0.9)
    assert "give a time_limit" in refusal(ParameterError, pharos.to_gymnax, chain)
    assert "give an array" in refusal(ParameterError, pharos.to_gymnax, chain, time_limit=5)
    env = pharos.to_gymnax(chain, np.eye(2, dtype=np.float32), time_limit=5, joined_ends=True)
    _, state = env.reset(jax.random.PRNGKey(0), env.default_params)
    assert len(env.step(jax.random.PRNGKey(0), state, 1, env.default_params)) == 5
    with pytest.raises(ParameterError, match="has 3 rows; expected one for each of 2"):
        pharos.to_gymnax(chain, np.eye(3), time_limit=5)
