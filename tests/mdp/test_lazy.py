"""Lazy actions: implicit in solvers and measures, drawn in interaction, against chains that are written out."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import strategies as st

import command_line
import pharos
from naive import mdp as naive_mdp
from pharos import exporters, hardness, importers, study
from pharos.errors import ParameterError, UnknownName
from pharos.interaction import GymEnv, make_vec
from pharos.mdp import (
    Lazy,
    TabularMDP,
    lazy_actions,
    mdp_within,
    minimize,
    random_actions,
    states_within,
    sticky_actions,
)
from pharos.rules.stepping import InterpretedStepping
from pharos.solvers import evaluate_policy, value_iteration, worst_value
from pharos.training import ChanceSetting, Task
from refusals import refusal
from strategies import deterministic_mdps, examples, lazy_mdps

LAZINESS = st.sampled_from([0.1, 1 / 3, 0.9])
RING = TabularMDP.from_arrays([[1, 4], [2, 0], [3, 1], [4, 2], [0, 3]], np.eye(5)[:, :2], gamma=0.9)


@pytest.fixture(scope="module")
def lake():
    return pharos.build("frozen_lake/4x4", progress=False)


@pytest.fixture(scope="module")
def grid():
    return pharos.build(pharos.make("mini_grid_empty", size=4, n_starting_states=2), progress=False)


# Values ---------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@examples(60, lazy_mdps(), st.integers(1, 6), st.integers(0, 2**32))
def test_values_are_those_of_the_chain_that_is_written_out(mdp, horizon, seed):
    P, R, _ = naive_mdp.augmented(mdp)
    policy = np.random.default_rng(seed).dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    later = np.append(np.repeat(policy, mdp.num_actions + 1, axis=0), policy[:1], axis=0)
    for solution, expected in (
        (value_iteration(mdp), naive_mdp.optimal_values(P, R, mdp.gamma)),
        (worst_value(mdp), naive_mdp.optimal_values(P, R, mdp.gamma, -1)),
        (evaluate_policy(mdp, policy), naive_mdp.values_of(P, R, mdp.gamma, later)),
    ):
        pairs = expected[:-1].reshape(mdp.num_states, -1)
        wanted = pairs[:, :-1] if mdp.is_sticky else pairs[:, 0]
        np.testing.assert_allclose(solution.v, wanted, rtol=0, atol=solution.error_bound + 1e-9)
    x = np.zeros(len(P))
    for _ in range(horizon):
        x = (R + mdp.gamma * P @ x).max(axis=1)
    first = x[:-1].reshape(mdp.num_states, -1)[mdp.start_states, -1]
    solution = value_iteration(mdp, horizon=horizon)
    assert abs(solution.value_at_start - mdp.start_probabilities @ first) <= solution.error_bound + 1e-9


@pytest.mark.long
@examples(25, deterministic_mdps(), LAZINESS)
def test_waiting_without_pay_discounts_as_a_smaller_gamma_does(mdp, p):
    """v = (1 - p) (r + gamma v') + p gamma v is v = f r + g v', f = (1 - p) / (1 - p gamma), g = f gamma."""
    factor = (1 - p) / (1 - p * mdp.gamma)
    lazy = value_iteration(lazy_actions(mdp, p, staying=np.zeros_like(mdp.rewards)))
    other = value_iteration(mdp.with_gamma(factor * mdp.gamma))
    np.testing.assert_allclose(lazy.v, factor * other.v, rtol=0, atol=lazy.error_bound + other.error_bound + 1e-12)


@pytest.mark.long
def test_chance_of_all_kinds_composes_in_any_order_of_the_lazy_ones():
    orders = [
        random_actions(sticky_actions(lazy_actions(RING, 0.3), 0.2), 0.1),
        lazy_actions(random_actions(sticky_actions(RING, 0.2), 0.1), 0.3),
        ChanceSetting(sticky=0.2, random=0.1, lazy=0.3).of(RING),
    ]
    assert len({value_iteration(each).value_at_start for each in orders}) == 1
    twice = lazy_actions(lazy_actions(RING, 0.5), 0.2)
    assert twice.laziness == pytest.approx(0.6)
    assert isinstance(twice.dynamics.tables, type(RING.dynamics))  # nothing was written out


def test_a_lazy_mdp_copies_no_transitions(lake):
    mdp = lake.mdp()
    lazy = lazy_actions(mdp, 0.25)
    assert isinstance(lazy.dynamics, Lazy)
    assert lazy.dynamics.tables is mdp.dynamics
    assert lazy_actions(mdp, 0) is mdp


# What staying pays ----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_rules_say_what_staying_pays(grid):
    env, mdp = grid.environment, grid.mdp(gamma=0.9)
    states, p = [tuple(each) for each in grid.states().tolist()], 0.25
    stays = np.array([[env.reward(state, a, state) for a in range(env.num_actions)] for state in states])
    assert (stays != mdp.rewards).any()
    np.testing.assert_allclose(lazy_actions(mdp, p).rewards, (1 - p) * mdp.rewards + p * stays, rtol=0, atol=1e-15)
    near = mdp_within(mdp, 2)
    kept = np.flatnonzero(states_within(mdp, 2))
    np.testing.assert_array_equal(lazy_actions(near, p).rewards, lazy_actions(mdp, p).rewards[kept])
    doubled = grid.mdp(rewards=lambda self, state, action, next_state: 2.0 * (next_state[0] == state[0]))
    assert (lazy_actions(doubled, p).rewards == (1 - p) * doubled.rewards + p * 2.0).all()


def test_a_table_pays_for_state_and_action_whatever_happens():
    assert lazy_actions(RING, 0.3).reward_table is RING.reward_table
    paid = lazy_actions(RING, 0.5, staying=np.full((5, 2), 2.0))
    assert (paid.rewards == RING.rewards / 2 + 1.0).all()
    assert "expected" in refusal(ParameterError, lazy_actions, RING, 0.5, staying=np.zeros(5))


@pytest.mark.long
def test_states_that_are_one_may_differ_in_what_staying_pays(grid):
    mdp = grid.mdp(gamma=0.9)
    assert "add lazy actions before you minimize" in refusal(ParameterError, lazy_actions, minimize(mdp).mdp, 0.1)
    small = minimize(lazy_actions(mdp, 0.1)).mdp
    one, two = value_iteration(small), value_iteration(lazy_actions(mdp, 0.1))
    assert abs(one.value_at_start - two.value_at_start) <= one.error_bound + two.error_bound


@pytest.mark.parametrize("p", [-0.1, 1.0, 1.5, float("nan"), "0.1"])
def test_a_probability_is_at_least_0_and_below_1(p):
    assert "probability is" in refusal(ParameterError, lazy_actions, RING, p)


# Colosseum ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_lazy_and_random_actions_are_p_lazy_and_p_rand_of_colosseum():
    """The classes after Colosseum have its two parameters in their rules, which tests compare with its figures."""
    size = {"size": 5, "n_starting_states": 2}
    native, plain = (
        pharos.build(pharos.make("mini_grid_empty", **size, **chance), progress=False).mdp(gamma=0.95)
        for chance in ({"p_lazy": 0.2, "p_rand": 0.3}, {})
    )
    added = random_actions(lazy_actions(plain, 0.2), 0.3)
    for solve in (value_iteration, worst_value):
        one, two = solve(native), solve(added)
        assert abs(one.value_at_start - two.value_at_start) <= one.error_bound + two.error_bound


# Hardness -------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@examples(60, LAZINESS)
def test_times_grow_by_the_mean_of_a_geometric_variable(p):
    exact = hardness.diameter(RING).upper
    lazy = hardness.diameter(lazy_actions(RING, p))
    assert lazy.lower <= exact / (1 - p) * (1 + 1e-12)
    assert lazy.upper >= exact / (1 - p) * (1 - 1e-12)


@pytest.mark.long
def test_measures_are_those_of_the_chain_that_is_written_out(lake, grid):
    for space in (lake, grid):
        mdp = random_actions(lazy_actions(space.mdp(gamma=0.9), 0.3), 0.1)
        P = mdp.dynamics.matrix()[:, : mdp.num_states]
        other = TabularMDP.from_matrices(P, mdp.rewards, gamma=0.9, initial=mdp.initial, ends=True)
        other = random_actions(replace(other, terminal=mdp.terminal), 0.1)
        one, two = (hardness.report(each, horizon=20, keep=False) for each in (mdp, other))
        for name, mine in one.results.items():
            theirs = two[name]
            assert bool(mine.undefined) == bool(theirs.undefined), name
            for low, high in ((mine, theirs), (theirs, mine)):
                lower, upper = low.certificate.lower, high.certificate.upper
                if lower is None or upper is None:
                    assert low.text == high.text, name
                else:
                    assert lower <= upper * (1 + 1e-9), name


@pytest.mark.long
def test_results_on_disk_are_of_one_laziness(lake):
    mdp = lake.mdp(gamma=0.9)
    found = [hardness.report(lazy_actions(mdp, p), ["diameter"])["diameter"].certificate for p in (0.2, 0.4)]
    assert found[0].upper < found[1].lower


# Interaction ----------------------------------------------------------------------------------------------------------

ALL = {"sticky": 0.25, "random": 0.2, "lazy": 0.3}


@pytest.mark.long
@pytest.mark.parametrize("name", ["lake", "grid", "slippery"])
def test_every_engine_plays_the_same_lazy_game(name, lake, grid):
    space = {"lake": lake, "grid": grid}.get(name) or pharos.build(pharos.make("frozen_lake", slippery=True))
    env = space.environment
    options = {"autoreset_mode": AutoresetMode.NEXT_STEP, "time_limit": 30, "seed": 5, "observation": "vector", **ALL}
    compiled, twin = (make_vec(env, 4, **options) for _ in range(2))
    table = make_vec(env, 4, space=space, **options)
    twin._stepper._step_many = InterpretedStepping(env).step_many
    walks, stayed = (compiled, table, twin), 0
    observed = [walk.reset()[0] for walk in walks]
    rng = np.random.default_rng(1)
    for _ in range(150):
        before = compiled.states
        actions = rng.integers(env.num_actions, size=4)
        steps = [walk.step(actions) for walk in walks]
        for other in steps[1:]:
            for mine, theirs in zip(steps[0][:4], other[:4], strict=True):
                np.testing.assert_array_equal(mine, theirs)
            for key in {"executed_action", "prob"} & set(other[4]):
                np.testing.assert_array_equal(steps[0][4][key], other[4][key])
        for i, action in enumerate(steps[0][4]["executed_action"]):
            if action >= 0 and (before[i] == compiled.states[i]).all():
                stayed += 1
                state = tuple(before[i].tolist())
                assert steps[0][1][i] == env.reward(state, int(action), state)
                assert not steps[0][2][i]
    assert stayed > 100
    assert observed[0].shape == (4, len(env.components))


@pytest.mark.parametrize("observation", ["vector", "simple_image", "index"])
def test_one_environment_stays_as_often_as_it_is_told(observation, lake):
    single = GymEnv(lake.environment, observation=observation, space=lake, lazy=0.4, time_limit=None)
    interpreted = GymEnv(lake.environment, observation=observation, space=lake, lazy=0.4, time_limit=None)
    interpreted._step_one, interpreted._step_and_draw = InterpretedStepping(lake.environment).step_one, None
    interpreted._is_written = observation == "vector"
    if observation == "simple_image":
        interpreted._blank = np.zeros(0, np.float32)
    stayed = 0
    start = single.simulator.start_states[0]
    for seed in range(400):
        single.reset(seed=seed)
        seen, reward, terminated, _, info = single.step(2)  # right, which moves
        interpreted.reset(seed=seed)
        other = interpreted.step(2)
        np.testing.assert_array_equal(seen, other[0])
        assert (reward, terminated, info["index"]) == (*other[1:3], other[4]["index"])
        stayed += bool((info["state"] == start).all())
        assert info["index"] == lake.index(info["state"])
        np.testing.assert_array_equal(seen, single.simulator.context(info["state"][None], np.zeros(1), np.zeros(1))[0])
    assert abs(stayed - 160) < 4 * np.sqrt(400 * 0.4 * 0.6)


def test_without_laziness_no_draw_moves(lake):
    games = []
    for options in ({}, {"lazy": 0.0}):
        env = make_vec(lake.environment, 3, seed=2, sticky=0.25, **options)
        env.reset()
        games.append([env.step(np.array([1, 2, 3]))[0].tolist() for _ in range(20)])
    assert games[0] == games[1]


def test_interaction_refuses_a_laziness_of_1(lake):
    for p in (1.0, -0.1, True):
        assert "lazy=" in refusal(ParameterError, GymEnv, lake.environment, lazy=p)


# Runs -----------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_with_lazy_actions_has_exact_values_and_an_id_of_its_own(lake, tmp_path):
    run = pharos.train(
        "q_learning", lake.environment, steps=400, lazy=0.2, out=tmp_path / "run", evaluation_interval=200
    )
    assert run.config["chance"] == {"sticky": 0.0, "random": 0.0, "lazy": 0.2}
    task = Task(lake.environment, lazy=0.2)
    assert run.result["value_optimal"] == value_iteration(task.mdp).value_at_start
    assert run.result["exact"]
    assert str(task.chance) == "lazy 0.2"
    assert ChanceSetting.from_dict(task.chance.to_dict()) == task.chance


@pytest.mark.long
@pytest.mark.parametrize("slippery", [False, True])
def test_exported_tables_have_the_chance_of_staying_and_its_pay(grid, slippery):
    space = pharos.build(pharos.make("cliff_walking", height=2, width=3, slippery=True)) if slippery else grid
    mdp = lazy_actions(space.mdp(gamma=0.9), 0.25)
    table, states = exporters.gym_p(mdp), [tuple(state) for state in space.states().tolist()]
    s = int(np.flatnonzero(~space.terminal)[-1])
    assert (s, space.environment.reward_of(states[s], 1, states[s], -1)) in [entry[1:3] for entry in table[s][1]]
    P = np.zeros((mdp.num_states, mdp.num_actions, mdp.num_states))
    R = np.zeros((mdp.num_states, mdp.num_actions))
    for s, rows in table.items():
        for a, outcomes in rows.items():
            for p, t, r, _ in outcomes:
                P[s, a, t] += p
                R[s, a] += p * r
    np.testing.assert_allclose(
        P.reshape(-1, mdp.num_states), mdp.dynamics.matrix().toarray()[:, :-1], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(R, mdp.rewards, rtol=8 * 2.0**-53, atol=1e-15)
    assert "deterministic MDPs" in refusal(ParameterError, exporters.bridge, lazy_actions(RING, 0.1), "ring.npz")


@pytest.mark.long
def test_the_command_line_and_studies_take_the_knobs():
    knobs = ["--lazy", "0.25", "--reward-noise", "0.5", "--reward-delay", "2"]
    done = command_line.run("train", "frozen_lake/4x4", "--steps", "200", *knobs)
    assert "lazy actions 0.25, reward noise 0.5, rewards 2 steps late" in " ".join(done.stdout.split())
    solved = command_line.answer("solve", "frozen_lake/4x4", "--lazy", 0.25)
    task = lazy_actions(pharos.build("frozen_lake/4x4").mdp(gamma=0.99), 0.25)
    assert solved["lazy"] == 0.25
    assert abs(solved["value_at_start"] - value_iteration(task).value_at_start) <= 2e-6
    for verb in (["evaluate", "--policy", "uniform"], ["hardness", "--measures", "diameter"]):
        shown = command_line.run(verb[0], "frozen_lake/4x4", *verb[1:], "--lazy", "0.25")
        assert "lazy actions 0.25" in " ".join(shown.stdout.split())
    chances = ["plain", {"lazy": 0.1}, {"reward_delay": 3}, {"sticky": 0.25, "reward_noise": 0.5}]
    block = {"environments": ["frozen_lake/4x4"], "chance": chances, "agents": ["q_learning"], "seeds": 1}
    runs = study.specification({"name": "knobs", "blocks": [block]}).runs
    assert [run.chance for run in runs] == ["plain", "lazy 0.1", "reward_delay 3", "sticky 0.25, reward_noise 0.5"]
    assert runs[0].config["chance"] == {"sticky": 0.0, "random": 0.0}
    assert ChanceSetting.from_dict({"reward_delay": 3.0}) == ChanceSetting(reward_delay=3)
    for name, meant in (("p_rand", "random"), ("p_lazy", "lazy")):
        assert meant in refusal(UnknownName, ChanceSetting.from_dict, {name: 0.1})


def test_a_lazy_mdp_is_not_kept_and_no_environment(lake, tmp_path):
    lazy = lazy_actions(RING, 0.5)
    assert "without lazy ones" in refusal(ParameterError, importers.save, lazy, tmp_path / "mdp")
    assert "without lazy ones" in refusal(ParameterError, importers.environment, lazy)
