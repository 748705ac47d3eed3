"""Deep sea, river swim, catch and the other chains: bsuite's rules and optimal returns, published probabilities."""

import itertools

import numpy as np
import pytest

import pharos
from naive import bsuite
from pharos.environments import start_distribution

pytestmark = pytest.mark.long  # with each class compiled and walked through in full


def assert_plays_like(env, twin, actions):
    """Environment and twin agree on every state, reward and end up to the end of the game."""
    state = twin.state()
    assert state in [tuple(start) for start, _ in env.initial_states()]
    for action in actions:
        following = env.next_state(state, action)
        reward, ended = twin.step(action)
        assert following == twin.state()
        assert env.reward(state, action, following) == pytest.approx(reward, abs=1e-15)
        assert env.is_terminal(following) == ended
        if ended:
            return
        assert not env.has_age or env.age(following) > env.age(state)
        state = following
    raise AssertionError("the game goes on after its limit")


def games(env, number=60):
    """Random actions, as many as the limit allows."""
    rng = np.random.default_rng(0)
    return [rng.integers(env.num_actions, size=env.max_episode_steps) for _ in range(number)]


def test_deep_sea_and_the_chains_are_played_by_the_rules_of_bsuite():
    for size, seed in ((2, 0), (7, 42), (10, 3)):
        env = pharos.make("deep_sea", size=size, mapping_seed=seed)
        for actions in (*games(env), [env.right[row, row] for row in range(size)]):
            assert_plays_like(env, bsuite.DeepSea(size, seed), actions)
    for rows, columns in ((10, 5), (3, 4), (2, 1)):
        env = pharos.make("catch", rows=rows, columns=columns)
        for ball, actions in itertools.product(range(columns), games(env)):
            assert_plays_like(env, bsuite.Catch(rows, columns, ball), actions)
    env = pharos.make("memory_chain", memory_length=3, num_bits=2)
    for *bits, query in itertools.product(range(2), repeat=3):
        for actions in games(env, 10):
            assert_plays_like(env, bsuite.MemoryChain(3, bits, query), actions)
    for length, need, have in itertools.product((1, 2, 9), range(2), range(2)):
        env = pharos.make("umbrella_chain", chain_length=length)
        for actions in games(env, 10):
            assert_plays_like(env, bsuite.UmbrellaChain(length, need, have), actions)
    for seed in (0, 4, 7):
        env = pharos.make("discounting_chain", mapping_seed=seed)
        for actions in games(env, 20):
            assert_plays_like(env, bsuite.DiscountingChain(seed), actions)


def test_a_stochastic_sea_fails_as_often_as_that_of_bsuite():
    env = pharos.make("deep_sea", size=4, stochastic=True, mapping_seed=5)
    for row, column in ((0, 0), (2, 1), (3, 3)):
        right = int(env.right[row, column])
        assert [env.probability((row, column), right, outcome) for outcome in range(2)] == [0.75, 0.25]
        assert [env.probability((row, column), 1 - right, outcome) for outcome in range(2)] == [1.0, 0.0]
        for outcome, fails in ((0, False), (1, True)):
            twin = bsuite.DeepSea(4, 5, lambda fails=fails: fails)
            twin.row, twin.column = row, column
            reward, _ = twin.step(right)
            following = env.next_state((row, column), right, outcome)
            assert (following, env.reward((row, column), right, following)) == (twin.state(), reward)


def optimum(name, **parameters):
    """Its exact optimal return from the start, undiscounted."""
    gamma = parameters.pop("gamma", 1.0)
    space = pharos.build(pharos.make(name, **parameters), progress=False)
    return pharos.value_iteration(space.mdp(gamma=gamma)).value_at_start


@pytest.mark.parametrize(
    ("name", "parameters", "value"),
    [
        ("deep_sea", {"size": 10, "mapping_seed": 42}, 0.99),
        ("catch", {}, 1.0),
        ("memory_chain", {"memory_length": 3, "num_bits": 2}, 1.0),
        ("umbrella_chain", {}, 1.0),
        ("discounting_chain", {"mapping_seed": 4}, 1.1),
    ],
)
def test_optimal_returns_are_those_of_bsuite(name, parameters, value):
    assert optimum(name, **parameters) == pytest.approx(value, abs=1e-12)


def test_a_ball_out_of_reach_is_lost():
    """Two moves for a paddle in the middle of seven columns: the outermost on either side are out of reach."""
    assert optimum("catch", rows=3, columns=7) == pytest.approx((5 - 2) / 7)


def test_a_discount_decides_which_chain_is_best():
    for gamma in (0.9, 0.95, 0.99):
        value = max(gamma ** (delay - 1) * (1.1 if delay == 3 else 1.0) for delay in (1, 3, 10, 30, 100))
        assert optimum("discounting_chain", mapping_seed=1, gamma=gamma) == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("size", [4, 10])
def test_the_optimum_of_a_stochastic_sea_stops_paying_once_the_treasure_is_lost(size):
    """bsuite's optimal return, p^(N-1) - 0.01, is that of going right every time: 0.01 p^N less than the optimum."""
    p = 1 - 1 / size
    always_right = p ** (size - 1) - 0.01
    space = pharos.build(pharos.make("deep_sea", size=size, stochastic=True, mapping_seed=42), progress=False)
    mdp = space.mdp(gamma=1.0)
    right = space.environment.right
    rows, columns = np.array([space.state(index) for index in range(space.num_states)]).T
    policy = right[np.minimum(rows, size - 1), columns]
    assert pharos.evaluate_policy(mdp, policy).value_at_start == pytest.approx(always_right, abs=1e-12)
    assert pharos.value_iteration(mdp).value_at_start == pytest.approx(always_right + 0.01 * p**size, abs=1e-12)


# River swim ---------------------------------------------------------------------------------------------------------


def law_of(env, action):
    """(places, places): probabilities of next places, by the interpreted rules."""
    P = np.zeros((env.length, env.length))
    for place, outcome in np.ndindex(env.length, env.outcomes):
        probability = env.probability((place,), action, outcome)
        if probability > 0:
            P[place, env.next_state((place,), action, outcome)[0]] += probability
    return P


# to the right: stay, ahead, back, place by place; Strehl and Littman (2008), figure of RiverSwim
STREHL_LITTMAN = [0.7, 0.6, 0.6, 0.6, 0.6, 0.3], [0.3] * 5, [0.1, 0.1, 0.1, 0.1, 0.7]
OSBAND = [0.4, 0.6, 0.6, 0.6, 0.6, 0.6], [0.6, 0.35, 0.35, 0.35, 0.35], [0.05, 0.05, 0.05, 0.05, 0.4]


@pytest.mark.parametrize(("instance", "right"), [("strehl-littman", STREHL_LITTMAN), ("osband", OSBAND)])
def test_rivers_have_their_published_probabilities(instance, right):
    env, (stay, ahead, back) = pharos.make(f"river_swim/{instance}"), right
    assert law_of(env, 1) == pytest.approx(np.diag(stay) + np.diag(ahead, 1) + np.diag(back, -1), abs=1e-15)
    assert (law_of(env, 0) == np.eye(6, k=-1) + np.diag([1, 0, 0, 0, 0, 0])).all()


def test_the_river_of_strehl_and_littman_starts_at_the_second_or_third_place_and_pays_5_and_10000():
    env = pharos.make("river_swim")
    states, probabilities = start_distribution(env)
    assert (states, list(probabilities)) == ([(1,), (2,)], [0.5, 0.5])
    paid = {
        (place, action, following): env.reward((place,), action, (following,))
        for place, action in np.ndindex(6, 2)
        for following in np.flatnonzero(law_of(env, action)[place])
    }
    assert {key: reward for key, reward in paid.items() if reward} == {(0, 0, 0): 5.0, (5, 1, 5): 10000.0}
    swept = pharos.make("river_swim/osband")
    assert [swept.reward((5,), 1, (following,)) for following in (4, 5)] == [1.0, 1.0]


def test_the_value_of_a_river_is_that_of_its_matrices():
    env = pharos.make("river_swim")
    P = np.array([law_of(env, action) for action in range(2)])
    v = np.zeros(6)
    for _ in range(3000):
        q = 0.95 * P @ v
        q[0, 0] += 5
        q[1, 5] += 0.3 * 10000
        v = q.max(axis=0)
    assert optimum("river_swim", gamma=0.95) == pytest.approx((v[1] + v[2]) / 2, rel=1e-9)


# Corners ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pays", "corners"), [("and", "-+--"), ("nand", "+-++"), ("or", "++-+"), ("xor", "+--+")])
def test_corners_pay_what_they_pay_in_colosseum(pays, corners):
    """Upper left, upper right, lower left, lower right."""
    env = pharos.make("corner_grid", size=3, pays=pays)
    found = "".join("+" if env.reward(corner, 4, corner) == 1 else "-" for corner in ((0, 0), (0, 2), (2, 0), (2, 2)))
    assert found == corners
    assert env.reward((0, 0), 1, (0, 1)) == env.reward((1, 1), 4, (1, 1)) == 0.5
