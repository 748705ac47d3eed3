"""Runs whose policies are measured by total rewards, and by what a step earns in the long run."""

import csv
import importlib
import math
from fractions import Fraction

import numpy as np
import pytest
from test_train import Killed, kill_at

import pharos
from command_line import answer
from pharos.errors import DivergenceError, FileFormatError, ParameterError, UnknownName
from pharos.training import (
    RegretCurve,
    RunConfig,
    Task,
    evaluate_agent,
    load_agent,
    read_curve,
    read_record,
    train,
    train_many,
)
from pharos.training.results import AVERAGE_COLUMNS, CURVE_COLUMNS
from refusals import refusal

_results = importlib.import_module("pharos.training.results")
SEA = {"size": 4, "steps": 600, "evaluation_interval": 100}


def gain_by_walking(mdp, actions):
    """The mean reward of the cycle in which a deterministic walk from the start ends up."""
    state, seen, rewards = int(mdp.start_states[0]), {}, []
    while state not in seen:
        seen[state] = len(rewards)
        rewards.append(Fraction(float(mdp.rewards[state, actions[state]])))
        state = int(mdp.next_states[state, actions[state]])
    cycle = rewards[seen[state] :]
    return sum(cycle) / len(cycle)


def constants(actions):
    """A function that yields a policy of one action every 100 steps."""

    def learn(env, steps, seed):
        env.reset(seed=seed)
        for step in range(steps):
            if step % 100 == 0:
                yield lambda seen, action=actions[step // 100]: np.full(len(seen), action)
            _, _, terminated, truncated, _ = env.step(0)
            if terminated or truncated:
                env.reset()

    return learn


# Average reward -------------------------------------------------------------------------------------------------------


def test_each_snapshot_has_the_gain_that_walking_finds():
    actions = [1, 0, 1, 1, 0, 0]
    run = train(constants(actions), "endless_sea", objective="average", **SEA)
    mdp = pharos.build(pharos.make("endless_sea", size=4)).mdp()
    best, uniform = (pharos.average_reward(mdp, name).gain_at_start for name in ("optimal", "uniform"))
    states, cumulative = mdp.num_states, [0.0, 0.0]
    for i, row in enumerate(run.curve[1:]):
        gain = gain_by_walking(mdp, np.full(states, actions[min(i + 1, 5)]))
        assert row["gain_lower"] <= gain <= row["gain_upper"]
        lost = Fraction(1, 4) - gain  # a dive of four steps to the right finds 1
        assert row["average_regret_lower"] <= lost <= row["average_regret_upper"]
        assert row["average_regret_upper"] - row["average_regret_lower"] < 1e-5
    for before, row in zip(run.curve, run.curve[1:], strict=False):
        for side, name in enumerate(("average_regret_lower", "average_regret_upper")):
            cumulative[side] += (row["step"] - before["step"]) * before[name]
    result = run.result
    assert list(result["cumulative_average_regret"].values()) == pytest.approx(cumulative)
    assert result["optimal_gain_at_start"] == best._asdict()
    assert result["uniform_gain_at_start"] == uniform._asdict()
    assert result["normalized_average_regret"] == pytest.approx(
        sum(cumulative) / 2 / 600 / (best[0] - uniform[0]), rel=1e-4
    )
    assert result["gain_at_start"]["lower"] == run.curve[-1]["gain_lower"]


@pytest.mark.long
def test_other_columns_are_those_of_a_run_without_the_option(tmp_path):
    for name, options in (("plain", {}), ("average", {"objective": "average"})):
        train("q_learning", "endless_sea", out=tmp_path / name, p_rand=0.2, **SEA, **options)
    texts = [(tmp_path / name / "curve.csv").read_text() for name in ("plain", "average")]
    plain, average = (list(csv.reader(text.splitlines())) for text in texts)
    assert [row[: len(CURVE_COLUMNS)] for row in average] == plain
    assert average[0] == [*CURVE_COLUMNS, *AVERAGE_COLUMNS]
    assert "objective" not in read_record(tmp_path / "plain")["config"]
    config = read_record(tmp_path / "average")["config"]
    assert config["objective"] == "average"
    assert RunConfig.from_dict(config).to_dict() == config
    assert list(read_curve(tmp_path / "average").columns) == [*CURVE_COLUMNS, *AVERAGE_COLUMNS]


def test_a_run_that_was_killed_ends_with_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(_results, "RUN_CHECKPOINT_SECONDS", 0.0)
    options = {"objective": "average", "random": 0.1, **SEA}
    with pytest.raises(Killed):
        train("q_learning", "endless_sea", out=tmp_path / "run", progress=kill_at(300), **options)
    steps = []
    train("q_learning", "endless_sea", out=tmp_path / "run", progress=lambda done, *_: steps.append(done), **options)
    assert steps == [300, 400, 500, 600]
    train("q_learning", "endless_sea", out=tmp_path / "whole", **options)
    assert (tmp_path / "run" / "curve.csv").read_bytes() == (tmp_path / "whole" / "curve.csv").read_bytes()
    assert load_agent(tmp_path / "run")[0].objective == "average"


@pytest.mark.long
@pytest.mark.parametrize(("agent", "engine"), [("dqn", "sb3"), ("ppo", "batched"), ("dqn", "batched")])
def test_networks_have_averages_of_what_they_are_asked(agent, engine):
    small = {"learning_starts": 50, "buffer_size": 1000} if agent == "dqn" else {"n_steps": 16}
    options = {"objective": "average", "hyperparameters": small, "engine": engine, **SEA}
    for run in train_many(agent, "endless_sea", seeds=[0, 1], **options):
        task = Task.of("endless_sea", {"size": 4}, objective="average")
        gain = evaluate_agent(run.agent, task).gain
        row = run.curve[-1]
        assert gain == pytest.approx((row["gain_lower"], row["gain_upper"]), abs=2e-6)
        assert gain.lower <= 0.25 + 1e-9


@pytest.mark.long
def test_an_agent_that_sees_frames_is_between_the_worst_and_the_best_where_histories_are_too_many():
    task = Task.of("endless_sea", {"size": 4}, observation="simple_image", observation_options={"frames": 2})
    average = Task.of(task.env, observation="simple_image", observation_options={"frames": 2}, objective="average")

    def policy(seen):
        return np.full((len(seen), 2), 0.5)

    assert evaluate_agent(policy, task).gain is None
    exact = evaluate_agent(policy, average).gain
    uniform = average.gains["uniform"]
    assert exact == pytest.approx(uniform, abs=2e-6)
    wide = evaluate_agent(policy, average, max_states=3)
    assert not wide.exact
    assert wide.gain == (average.gains["worst"].lower, average.gains["optimal"].upper)


def test_a_loop_of_ones_own_measures_averages(tmp_path):
    with pharos.Run("endless_sea", size=4, objective="average", steps=100, out=tmp_path / "run") as run:
        row = run.evaluate(50, lambda seen: np.ones(len(seen), int))
    assert row["gain_lower"] <= 0.25 <= row["gain_upper"]
    assert read_record(tmp_path / "run")["result"]["average_regret"]["upper"] < 1e-5


def test_the_curve_is_drawn_by_steps(tmp_path):
    train("q_learning", "endless_sea", out=tmp_path / "run", objective="average", **SEA)
    left, right = pharos.plots.regret([tmp_path / "run"]).axes[:2]
    assert (left.get_ylabel(), right.get_ylabel()) == ("normalised average regret", "cumulative average regret")
    result = read_record(tmp_path / "run")["result"]
    assert right.lines[0].get_ydata()[-1] == pytest.approx(sum(result["cumulative_average_regret"].values()) / 2)
    spread = result["optimal_gain_at_start"]["lower"] - result["uniform_gain_at_start"]["lower"]
    assert right.lines[1].get_ydata()[-1] == pytest.approx(600 * spread, rel=1e-4)


# Total reward ---------------------------------------------------------------------------------------------------------


def test_the_total_reward_of_a_walk_is_its_length(tmp_path):
    task = Task.of("cliff_walking", {"slippery": False}, objective="total")
    assert (task.gamma, task.horizon, task.objective) == (1.0, None, None)
    assert task.reference.optimal == -13
    assert task.reference.worst == -math.inf
    optimal = pharos.value_iteration(task.mdp).policy
    assert evaluate_agent(optimal, task).value == -13
    # elsewhere it may go on for ever
    astray, on_path = optimal.copy(), {int(task.mdp.start_states[0])}
    state = int(task.mdp.start_states[0])
    while not task.mdp.terminal[state]:
        on_path.add(state)
        state = int(task.mdp.next_states[state, optimal[state]])
    up = task.env.actions.index("up")
    astray[[s for s in range(task.mdp.num_states) if s not in on_path]] = up
    assert evaluate_agent(astray, task).value == -13
    ever = evaluate_agent(np.full(task.mdp.num_states, up), task)
    assert (ever.value, ever.exact) == (-math.inf, True)
    # the same on the command line
    np.save(tmp_path / "astray.npy", astray)
    np.save(tmp_path / "ever.npy", np.full(task.mdp.num_states, up))
    told, never = (
        answer("evaluate", "cliff_walking", "--policy", tmp_path / f"{name}.npy", "--objective", "total")
        for name in ("astray", "ever")
    )
    assert (told["value_at_start"], told["regret"], told["worst_value_at_start"]) == (-13, 0, None)
    assert (never["value_at_start"], never["regret"], never["horizon"]) == (None, None, None)


@pytest.mark.long
def test_a_run_of_total_rewards_is_evaluated_as_it_was_trained(tmp_path):
    run = answer(
        "train", "frozen_lake/4x4", "--random", "0.5", "--objective", "total", "--steps", 300, "--out", tmp_path
    )
    again = answer("evaluate", "frozen_lake/4x4", "--policy", tmp_path)
    assert run["conventions"] == {"gamma": 1.0, "horizon": None, "time_limit": 100}
    assert again["value_at_start"] == pytest.approx(run["final_value"], abs=1e-9)
    assert again["horizon"] is None


def test_regret_of_policies_without_end_is_infinite(tmp_path):
    run = train(
        "q_learning", "cliff_walking", objective="total", steps=600, evaluation_interval=50, out=tmp_path / "run"
    )
    first, last = run.curve[0], run.curve[-1]
    assert (first["value"], first["expected_regret"], first["cumulative_expected_regret"]) == (-math.inf, math.inf, 0.0)
    assert last["cumulative_expected_regret"] == (math.inf if last["episodes"] else 0.0)
    assert last["cumulative_realised_regret"] == pytest.approx(-13 * last["episodes"] - _sum_of_returns(run))
    curve = RegretCurve.read(tmp_path / "run")
    assert curve.expected[0] == math.inf
    assert curve.cumulative_expected[0] == 0.0
    left = pharos.plots.regret([tmp_path / "run"]).axes[0]
    assert "infinite" in left.get_title(loc="left")


def _sum_of_returns(run):
    counts = np.diff([row["episodes"] for row in run.curve])
    return sum(n * row["mean_return"] for n, row in zip(counts, run.curve[1:], strict=True) if n)


@pytest.mark.long
def test_a_policy_whose_sum_has_no_limit_has_no_value():
    """Going round two states pays +1 and -1, leaving pays nothing."""
    ring = pharos.TabularMDP.from_arrays([[1, -1], [0, -1]], [[1.0, 0.0], [-1.0, 0.0]], gamma=1.0)
    task = Task(pharos.importers.environment(ring), gamma=1.0, horizon=None)
    assert task.reference.optimal == 1.0
    assert math.isnan(evaluate_agent(np.zeros(3, int), task).value)
    assert evaluate_agent(np.array([0, 1, 0]), task).value == 1.0


def test_where_uniform_play_never_ends_there_is_no_unit_of_regret():
    costly = pharos.TabularMDP.from_arrays([[0, 0], [1, 1]], [[-1.0, 0.0], [0.0, 0.0]], gamma=1.0)
    task = Task(pharos.importers.environment(costly), gamma=1.0, horizon=None)
    reference = task.reference
    assert (reference.optimal, reference.uniform) == (0.0, -math.inf)
    assert math.isnan(reference.spread())


def test_an_optimum_without_limit_names_the_cycle():
    message = refusal(DivergenceError, train, "q_learning", "endless_sea", size=4, objective="total", steps=100)
    assert "no policy has a finite total reward" in message


def test_a_total_reward_is_not_estimated():
    task = Task.of("frozen_lake/8x8", random=0.3, objective="total")
    message = refusal(ParameterError, evaluate_agent, lambda seen: np.full((len(seen), 4), 0.25), task, max_states=3)
    assert "a total reward is not estimated" in message


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"objective": "total", "gamma": 0.9}, ParameterError, "has gamma 1 and no horizon; found gamma 0.9"),
        ({"objective": "total", "horizon": 5}, ParameterError, "horizon 5"),
        ({"objective": "totals"}, UnknownName, "totals"),
    ],
)
def test_objectives_that_contradict_other_options_are_refused(options, error, text):
    assert text in refusal(error, train, "q_learning", "frozen_lake/4x4", steps=10, **options)


def test_a_run_of_another_objective_is_no_configuration():
    config = train("q_learning", "endless_sea", size=3, steps=10).config
    assert "objective" in refusal(FileFormatError, RunConfig.from_dict, {**config, "objective": "total"})
