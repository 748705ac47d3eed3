"""Stepping worlds whose rules have chance: one environment, many, on a table and interpreted draw the same outcomes, as
often as the MDP says.
"""

import copy

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.stats import chisquare

import pharos
from pharos.interaction import GymEnv, make_sb3_vec, make_vec
from pharos.rules import InterpretedStepping
from worlds import ChanceWorld

pytestmark = pytest.mark.long  # with each class compiled

WORLDS = {
    "blackjack": pharos.make("blackjack"),
    "taxi": pharos.make("taxi", size=3, rainy=True, fickle=True),
    "ragged": ChanceWorld(num_positions=40, seed=5, vectors=0, possible_share=0.3, num_starts=3),
}
BOTH = {"sticky": 0.3, "random": 0.2}


@pytest.fixture(scope="module")
def spaces(tmp_path_factory):
    folder = tmp_path_factory.mktemp("spaces")
    return {name: pharos.build(env, folder / name, progress=False) for name, env in WORLDS.items()}


def played(env, actions) -> list[tuple]:
    """What a single environment gives, an episode after the other."""
    steps = [env.reset(seed=7)]
    for action in actions:
        step = env.step(action)
        steps.append(step)
        if step[2] or step[3]:
            steps.append(env.reset())
    return steps


def played_by_one_of_many(vec, actions) -> list[tuple]:
    """The same of a vector environment of one in the mode NEXT_STEP, whose step after an end is the reset."""
    first = vec.reset(seed=7)
    steps, ended = [(first[0][0], {name: each[0] for name, each in first[1].items()})], False
    actions = iter(actions)
    while True:
        action = 0 if ended else next(actions, None)
        if action is None:
            return steps
        seen, *rest, info = vec.step(np.array([action]))
        info = {name: each[0] for name, each in info.items()}
        steps.append((seen[0], info) if ended else (seen[0], *(each[0] for each in rest), info))
        ended = bool(rest[1][0] or rest[2][0])


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("chance", [{}, BOTH])
def test_one_seed_gives_one_game_in_every_engine(name, chance, spaces):
    env, space = WORLDS[name], spaces[name]
    options = {"time_limit": 6, **chance}
    single, interpreted = GymEnv(env, space=space, **options), GymEnv(env, **options)
    interpreted._compiled.step_one = InterpretedStepping(env).step_one
    interpreted._chance.outcome_one = InterpretedStepping(env).outcome_one
    many, table, twin = (make_vec(env, 1, space=each, **options) for each in (None, space, None))
    twin._stepper._step_many = InterpretedStepping(env).step_many
    actions = np.random.default_rng(1).integers(env.num_actions, size=300).tolist()
    games = [played(each, actions) for each in (single, interpreted)]
    games += [played_by_one_of_many(each, actions) for each in (many, table, twin)]
    for other in games[1:]:
        assert len(other) == len(games[0])
        for mine, theirs in zip(games[0], other, strict=True):
            np.testing.assert_array_equal(mine[0], theirs[0])
            assert mine[1:-1] == tuple(theirs[1:-1])
            for key in {"state", "index", "executed_action", "prob"} & set(theirs[-1]):
                np.testing.assert_array_equal(mine[-1][key], theirs[-1][key])
    assert {step[-1]["prob"] for step in games[0] if len(step) == 2} == {1.0}
    assert len({step[-1]["prob"] for step in games[0]}) > 1


@pytest.mark.parametrize("name", WORLDS)
def test_what_is_paid_and_said_is_of_the_outcome_that_was_drawn(name):
    env = WORLDS[name]
    vec = make_vec(env, 50, seed=3, time_limit=8, autoreset_mode=AutoresetMode.DISABLED, **BOTH)
    _, info = vec.reset()
    rng = np.random.default_rng(0)
    for _ in range(30):
        before = vec.states.tolist()
        _, rewards, terminated, truncated, info = vec.step(rng.integers(env.num_actions, size=50))
        for i, state in enumerate(map(tuple, before)):
            action, after = int(info["executed_action"][i]), tuple(info["state"][i].tolist())
            possible = ((env.probability(state, action, k), k) for k in range(env.outcomes))
            likely = {p for p, k in possible if p > 0 and env.next_state(state, action, k) == after}
            assert info["prob"][i] in likely
            assert rewards[i] == env.reward(state, action, after)
            assert terminated[i] == env.is_terminal(after)
        vec.reset(options={"reset_mask": terminated | truncated})


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("tabulated", [False, True])
def test_steps_are_as_frequent_as_the_mdp_says_with_sticky_and_random_actions_on_top(name, tabulated, spaces):
    space, n = spaces[name], 20_000
    env, mdp = space.environment, space.mdp()
    vec = make_vec(env, n, seed=11, space=space if tabulated else None, autoreset_mode="DISABLED", **BOTH)
    chance = pharos.random_actions(pharos.sticky_actions(mdp, BOTH["sticky"]), BOTH["random"]).chance
    even = np.full(env.num_actions, 1 / env.num_actions)
    dynamics = mdp.dynamics.matrix().toarray().reshape(mdp.num_states, env.num_actions, -1)[..., :-1]
    tested = 0
    for first in np.flatnonzero(~space.terminal)[:: max(1, space.num_states // 12)][:12]:
        vec.reset(options={"state": space.state(first)})
        one, other = env.num_actions - 1, 0
        info = vec.step(np.full(n, one))[-1]
        middle, previous = space.indices(vec.states), info["executed_action"]
        weights = (1 - chance.first_chosen) * even
        weights[one] += chance.first_chosen
        assert_follows(middle, weights @ dynamics[first])
        going = ~space.terminal[middle]
        pair = np.unique(np.stack([middle, previous], 1)[going], axis=0, return_counts=True)
        vec.reset(options={"reset_mask": ~going}) if not going.all() else None
        vec.step(np.full(n, other))
        after = space.indices(vec.states)
        for (s, b), count in zip(*pair, strict=True):
            if count < 300:
                continue
            weights = chance.uniform * even
            weights[other] += chance.chosen
            weights[b] += chance.previous
            assert_follows(after[going & (middle == s) & (previous == b)], weights @ dynamics[s])
            tested += 1
    assert tested > 5


def assert_follows(drawn: np.ndarray, expected: np.ndarray) -> None:
    """A chi-square test at the level 1e-5; what is expected less than 5 times is one class."""
    counts = np.bincount(drawn, minlength=len(expected))
    assert not counts[expected == 0].any()
    often = expected * len(drawn) >= 5
    seen, mean = np.append(counts[often], counts[~often].sum()), np.append(expected[often], expected[~often].sum())
    if mean[-1] * len(drawn) < 1e-6:
        seen, mean = seen[:-1], mean[:-1]
    assert chisquare(seen, mean / mean.sum() * len(drawn)).pvalue > 1e-5


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_gymnasiums_own_vector_environment_does_the_same(mode):
    env = WORLDS["blackjack"]
    own = SyncVectorEnv([lambda: GymEnv(env, sticky=0.2)] * 3, autoreset_mode=mode)
    vec = make_vec(env, 3, sticky=0.2, autoreset_mode=mode)
    assert own.reset(seed=0)[1]["prob"].tolist() == vec.reset(seed=0)[1]["prob"].tolist() == [1.0] * 3
    rng = np.random.default_rng(2)
    for _ in range(60):
        actions = rng.integers(2, size=3)
        mine, theirs = vec.step(actions), own.step(actions)
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        for key in ("prob", "_prob", "state", "executed_action"):
            np.testing.assert_array_equal(mine[4][key], theirs[4][key])
        done = mine[2] | mine[3]
        if "final_info" in theirs[4]:
            for key in ("prob", "_prob"):
                np.testing.assert_array_equal(mine[4]["final_info"][key], theirs[4]["final_info"][key])
        if mode == AutoresetMode.DISABLED and done.any():
            options = {"reset_mask": done}
            np.testing.assert_array_equal(vec.reset(options=options)[0], own.reset(options=options)[0])


@pytest.mark.parametrize("name", ["blackjack", "taxi"])
def test_gymnasiums_checker_finds_nothing_to_say(name):
    check_env(GymEnv(WORLDS[name], sticky=0.25), skip_render_check=True)


def test_a_copy_goes_on_alike_and_without_a_seed_games_differ():
    env = GymEnv(WORLDS["blackjack"], observation="simple_image")
    env.reset(seed=1)
    twin = copy.deepcopy(env)
    for _ in range(20):
        steps = [each.step(1) for each in (env, twin)]
        np.testing.assert_array_equal(steps[0][0], steps[1][0])
        if steps[0][2]:
            np.testing.assert_array_equal(*(each.reset()[0] for each in (env, twin)))
    starts = {tuple(GymEnv(WORLDS["blackjack"]).reset()[1]["state"].tolist()) for _ in range(20)}
    assert len(starts) > 1


def test_without_chance_in_the_rules_nothing_is_said_of_it():
    env = GymEnv("cliff_walking")
    assert "prob" not in env.reset()[1] and "prob" not in env.step(0)[-1]
    vec = make_vec("cliff_walking", 2)
    assert "prob" not in vec.reset()[1] and "prob" not in vec.step(np.zeros(2, int))[-1]


def test_registered_environments_have_chance_too():
    env = gymnasium.make("pharos/CliffWalking-4x12-slippery-v0", observation="index")
    env.reset(seed=0, options={"state": (0, 3)})
    seen, reward, terminated, _, info = env.step(0)
    assert info["prob"] == 1 / 3 and seen == info["index"] and reward == -1 and not terminated


def test_stable_baselines_gets_episodes_with_drawn_outcomes(spaces):
    vec = make_sb3_vec(WORLDS["blackjack"], 4, observation="index", space=spaces["blackjack"], seed=0)
    vec.reset()
    paid = set()
    for _ in range(60):
        _, rewards, done, infos = vec.step(np.zeros(4, int))
        paid |= set(rewards[done].tolist())
        assert all(("episode" in info) == bool(ended) for info, ended in zip(infos, done, strict=True))
    assert paid == {-1.0, 0.0, 1.0}
