"""Regret: never negative, a sum over episodes, and normalised so that the optimal policy is 0 and the reference policy
1."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import command_line
import pharos
from pharos import benchmark, hardness, study
from pharos.errors import FileFormatError, ParameterError, UndefinedMeasure
from pharos.hardness.representation import learning
from pharos.mdp import TabularMDP
from pharos.regret import regret_scale
from pharos.solvers import uniform_value, value_iteration, worst_value
from pharos.training import (
    ReferenceValues,
    RegretCurve,
    Task,
    cumulative_expected_regret,
    evaluate_agent,
    read_curve,
    read_record,
    regret,
    train,
    tune,
)
from refusals import refusal
from strategies import deterministic_mdps, examples
from worlds import Row, code_of

CHANCE = [{}, {"random": 0.2}, {"sticky": 0.25}]


def values_of(mdp):
    found = [solve(mdp) for solve in (value_iteration, uniform_value, worst_value)]
    errors = max(solution.error_bound for solution in found)
    return ReferenceValues(*(solution.value_at_start for solution in found), error_bound=errors)


@st.composite
def runs(draw):
    """(episodes finished before each evaluation, expected regret there)."""
    between = draw(st.lists(st.integers(0, 50), min_size=1, max_size=12))
    lost = draw(st.lists(st.floats(0, 10), min_size=len(between), max_size=len(between)))
    return np.cumsum(between) - between[0], np.array(lost)


@pytest.mark.long
@examples(80, deterministic_mdps(), st.integers(0, 2**31), st.booleans())
def test_no_policy_has_a_regret_below_zero_or_above_that_of_the_worst(mdp, seed, sharp):
    rng = np.random.default_rng(seed)
    shape = (mdp.num_states, mdp.num_actions)
    policy = rng.integers(mdp.num_actions, size=shape[0]) if sharp else rng.dirichlet(np.ones(shape[1]), shape[0])
    solution, values = pharos.evaluate_policy(mdp, policy), values_of(mdp)
    lost = regret(solution.value_at_start, values)
    error = solution.error_bound + values.error_bound
    assert -error <= lost <= values.optimal - values.worst + error


@examples(80, deterministic_mdps())
def test_the_references_are_at_zero_and_one_or_nowhere(mdp):
    values = values_of(mdp)
    for reference in ("uniform", "worst"):
        ends = regret([values.optimal, getattr(values, reference)], values, normalized_by=reference)
        if math.isnan(values.spread(reference)):
            assert values.optimal - getattr(values, reference) <= 2e-6
            assert np.isnan(ends).all()
        else:
            assert ends.tolist() == [0.0, 1.0]


@pytest.mark.long
@examples(80, deterministic_mdps(ends=False), st.sampled_from([0.5, 2.0, 30.0]), st.sampled_from([-3.0, 0.0, 7.0]))
def test_normalised_regret_does_not_change_with_the_unit_or_the_zero_of_rewards(mdp, unit, zero):
    never = np.zeros(mdp.num_states, bool)  # no state ends the episode, so that `zero` is paid on every step
    plain = TabularMDP.from_arrays(mdp.next_states, mdp.rewards, gamma=0.9, terminal=never)
    other = TabularMDP.from_arrays(mdp.next_states, unit * mdp.rewards + zero, gamma=0.9, terminal=never)
    policy = np.zeros(mdp.num_states, np.int64)
    answers = []
    for each in (plain, other):
        found = [solve(each, 1e-9).value_at_start for solve in (value_iteration, uniform_value, worst_value)]
        value = pharos.evaluate_policy(each, policy, 1e-9).value_at_start
        answers.append(regret(value, ReferenceValues(*found, error_bound=1e-7), normalized_by="worst"))
    assert answers[0] == pytest.approx(answers[1], abs=1e-4, nan_ok=True)


@given(runs(), st.data())
def test_the_regret_of_a_run_is_that_of_its_two_parts(run, data):
    episodes, lost = run
    cut = data.draw(st.integers(0, len(episodes) - 1))
    whole = cumulative_expected_regret(episodes, lost)
    head = cumulative_expected_regret(episodes[: cut + 1], lost[: cut + 1])
    tail = cumulative_expected_regret(episodes[cut:], lost[cut:])
    np.testing.assert_allclose(whole[: cut + 1], head, atol=1e-9)
    np.testing.assert_allclose(whole[cut:], head[-1] + tail, atol=1e-9)


@given(runs())
def test_every_episode_counts_with_the_policy_that_was_evaluated_before_it(run):
    episodes, lost = run
    expected = [lost[np.flatnonzero(episodes <= k)[-1]] for k in range(episodes[-1])]
    sums = np.concatenate([[0.0], np.cumsum(expected)])
    np.testing.assert_allclose(cumulative_expected_regret(episodes, lost), sums[episodes], atol=1e-9)


def test_more_evaluations_of_the_same_policies_change_nothing():
    coarse = cumulative_expected_regret([0, 10, 30], [1.0, 0.5, 0.0])
    fine = cumulative_expected_regret([0, 4, 10, 20, 30], [1.0, 1.0, 0.5, 0.5, 0.0])
    assert coarse.tolist() == [0.0, 10.0, 20.0]
    assert fine[[0, 2, 4]].tolist() == coarse.tolist()


@pytest.mark.parametrize("chance", CHANCE)
def test_the_uniform_policy_loses_one_an_episode_and_the_optimal_one_nothing(chance):
    task = Task.of("frozen_lake/4x4", **chance)
    values = ReferenceValues.of(task)
    uniform = evaluate_agent(np.full((task.mdp.num_states, 4), 0.25), task).value
    assert regret(uniform, values, normalized_by="uniform") == pytest.approx(1)
    assert regret(task.optimal.value_at_start, values) == 0
    curve = RegretCurve(np.array([0, 50, 100]), np.array([0, 5, 12]), np.full(3, uniform), np.zeros(3), values)
    np.testing.assert_allclose(curve.normalized(curve.cumulative_expected), [np.nan, 1, 1])
    still = RegretCurve(curve.steps, curve.episodes, np.full(3, values.optimal), curve.returns, values)
    np.testing.assert_allclose(still.normalized(still.cumulative_expected), [np.nan, 0, 0])


def test_regret_cannot_be_normalised_where_every_policy_is_optimal():
    mdp = TabularMDP.from_arrays([[1, 1], [-1, -1]], [[1.0, 1.0], [0.0, 0.0]])
    values = values_of(mdp)
    assert regret(values.uniform, values) == 0
    assert math.isnan(regret(values.uniform, values, normalized_by="uniform"))
    curve = RegretCurve(np.arange(2), np.arange(2), np.ones(2), np.zeros(2), values)
    assert np.isnan(curve.normalized(curve.cumulative_expected)).all()


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "0"
    return train("q_learning", "frozen_lake/4x4", steps=3000, evaluation_interval=250, random=0.1, out=out)


def test_the_curve_of_a_run_says_what_its_file_says(run_folder):
    curve, rows = RegretCurve.read(run_folder.folder), run_folder.curve
    for found, name in (
        (curve.expected, "expected_regret"),
        (curve.cumulative_expected, "cumulative_expected_regret"),
        (curve.cumulative_realised, "cumulative_realised_regret"),
        (regret(curve.policy_values, curve.values, normalized_by="uniform"), "normalized_regret"),
    ):
        np.testing.assert_allclose(found, [row[name] for row in rows], atol=1e-9)
    assert curve.normalized(curve.cumulative_expected)[-1] == pytest.approx(run_folder.result["normalized_regret"])
    realised = curve.normalized(curve.cumulative_realised)[-1]
    assert realised == pytest.approx(run_folder.result["normalized_realised_regret"])
    worst = curve.normalized(curve.cumulative_expected, "worst")[-1]
    lost = run_folder.result["value_optimal"] - run_folder.result["value_worst"]
    assert worst == pytest.approx(run_folder.result["cumulative_regret"] / (rows[-1]["episodes"] * lost))


@pytest.mark.parametrize("chance", CHANCE)
def test_in_expectation_an_episode_loses_what_its_policy_loses(chance):
    """Uniformly random episodes in the environment, counted one by one, against the exact value."""
    task = Task.of("frozen_lake/4x4", **chance)
    values, env = ReferenceValues.of(task), pharos.GymEnv(task.env, **task.interaction)
    rng, lost = np.random.default_rng(1), []
    env.reset(seed=1)
    for _ in range(3000):
        env.reset()
        over, gained = False, 0.0
        while not over:
            _, reward, terminated, truncated, _ = env.step(int(rng.integers(4)))
            gained, over = gained + reward, terminated or truncated
        lost.append(regret(gained, values))
    deviation = np.std(lost) / math.sqrt(len(lost))
    assert np.mean(lost) == pytest.approx(regret(values.uniform, values), abs=4 * deviation)


def test_mistakes_are_named(tmp_path):
    values = ReferenceValues(1.0, 0.0)
    assert "expected 'uniform' or 'worst'" in refusal(ParameterError, regret, 0.5, values, normalized_by="human")
    assert math.isnan(regret(0.5, values, normalized_by="worst"))  # its value is not known
    with pytest.raises(ParameterError, match="fall from 5 to 3 at evaluation 2"):
        cumulative_expected_regret([0, 5, 3], [1, 1, 1])
    assert "one of each" in refusal(ParameterError, cumulative_expected_regret, [0, 5], [1, 1, 1])
    assert "no such file" in refusal(FileFormatError, RegretCurve.read, tmp_path)


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6), st.floats(0, 1e3))
def test_regret_has_a_scale_where_the_values_can_tell_the_reference_from_the_optimum(optimal, lost, error):
    scale = regret_scale(optimal, optimal - lost, error)
    between = optimal - (optimal - lost)
    assert scale == between if between > max(1e-12, 2 * error) else math.isnan(scale)
    np.testing.assert_array_equal(regret_scale([optimal] * 2, [optimal - lost] * 2, error), [scale] * 2)


COIN = f"""
{code_of(Row)}

@dataclass(frozen=True, kw_only=True)
class Coin(Row):
    length: int = 5
    base: float = 0.0
    gain: float = 1.0

    name = "coin"
    actions = ("tails", "heads")
    max_steps = 4

    def transition(self, state, action, out):
        out[0] = state[0] + 1

    def is_terminal(self, state):
        return state[0] == 4

    def reward(self, state, action, next_state):
        return self.base + (self.gain if action == 1 else 0.0)
"""


def last_policy_by_place(run, world, words):
    """Normalised regret of a run's last policy, wherever the library says it; None where it has no scale."""
    record, curve, task = read_record(run), read_curve(run), Task.of(world)
    value, values = record["result"]["final_value"], RegretCurve.read(run).values
    entry = benchmark.submit(run, run / "entry.safetensors")
    try:
        alone = learning.Representation.of_matrix(np.eye(task.mdp.num_states))
        of_learner = learning.IdealisedLearner(task.mdp, alone, hardness.Schedule(steps=10), 4).regret(value)
    except UndefinedMeasure:
        of_learner = math.nan
    return {
        "curve": curve["normalized_regret"].iloc[-1],
        "curve read back": regret(value, values, normalized_by="uniform"),
        "reference of the task": regret(value, task.reference, normalized_by="uniform"),
        "pharos evaluate": command_line.answer("evaluate", *words, "--policy", run, "--trust")["normalized_regret"],
        "benchmark": benchmark.verify(entry, trust=True).normalized_regret,
        "learner of hardness": of_learner,
    }


def whole_run_by_place(run, spec, study_folder):
    """Normalised cumulative regret of a run, of learnt policies and as played, wherever the library says them."""
    result, curve, runs = read_record(run)["result"], RegretCurve.read(run), study.table(spec, study_folder)
    cell = study.outcomes(runs, study.curves(spec, study_folder)).iloc[0]
    learnt = {
        "record": result["normalized_regret"],
        "curve read back": curve.normalized(curve.cumulative_expected)[-1],
        "table of the study": runs["normalized_regret"].iloc[0],
        "cells of the study": study.cells(runs)["normalized_regret"].iloc[0],
    }
    played = {
        "record": result["normalized_realised_regret"],
        "curve read back": curve.normalized(curve.cumulative_realised)[-1],
        "outcome of validation": cell["played"],
    }
    return learnt, played


@pytest.mark.long
@pytest.mark.parametrize("values", [{}, {"base": 1e6, "gain": 1e-6}], ids=["apart", "within the errors"])
def test_normalised_regret_agrees_in_all_places_at_once(tmp_path, monkeypatch, values):
    """A world whose policies are apart, and one whose values differ by 2e-6, less than their errors of 8e-6."""
    monkeypatch.chdir(tmp_path)
    Path("coin.py").write_text(COIN)
    world = pharos.make("coin.py:Coin", **values)
    block = {"environments": [{"name": "coin.py:Coin", "parameters": values}], "agents": ["q_learning"]}
    spec = {"name": "coins", "steps": 24, "seeds": 1, "blocks": [{**block, "observations": ["vector"]}]}
    study.run(spec, "coins", workers=1)
    (run,) = (tmp_path / "coins" / "runs").iterdir()
    words = ["coin.py:Coin", *(f"{name}={value}" for name, value in values.items())]
    last = last_policy_by_place(run, world, words)
    learnt, played = whole_run_by_place(run, spec, tmp_path / "coins")
    for places in (last, learnt, played):
        numbers = np.array([math.nan if each is None else each for each in places.values()])
        assert np.isnan(numbers).all() if values else np.ptp(numbers) <= 1e-9, places
    undefined = bool(values)
    assert (learnt["record"] is None) is undefined
    assert study.has_regret(read_record(run)["config"]) is not undefined
    if undefined:
        assert "uniform play is optimal" in refusal(UndefinedMeasure, pharos.predict, world, "vector", steps=2000)
        with pytest.raises(ParameterError, match="regret cannot be normalised"):
            tune("q_learning", world, trials=1, steps=20, out=tmp_path / "tuned")
