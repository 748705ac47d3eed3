"""Levels of ladders: what benchmarks/benchmark_select.py measures, and the rule of benchmarks/benchmark_ladders.py."""

import importlib
import math
from pathlib import Path

import numpy as np
import pytest

from pharos.benchmark import load_suite
from pharos.benchmark.suite import BenchmarkTask, Protocol


@pytest.fixture(scope="module")
def scripts():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        yield importlib.import_module("benchmark_select"), importlib.import_module("benchmark_ladders")


def task(environment, observation="one_hot", options=None, **parameters):
    made = BenchmarkTask("a", environment, parameters, observation, options or {})
    return made, made.training_task(Protocol())


@pytest.mark.parametrize(
    ("environment", "parameters"), [("catch", {"rows": 5, "columns": 3}), ("deep_sea", {"size": 4})]
)
def test_the_lag_of_an_advantage_is_that_of_rewards_along_two_walks(scripts, environment, parameters):
    made, learnt = task(environment, **parameters)
    q, successors, rewards = learnt.optimal.q, np.asarray(learnt.space.successors), learnt.mdp.rewards

    def walk(state, action):
        paid = []
        while state < len(q) and not learnt.mdp.terminal[state] and len(paid) < learnt.time_limit:
            paid.append(rewards[state, action])
            state = successors[state, action]
            action = q[state].argmax() if state < len(q) else 0
        return np.append(paid, np.zeros(learnt.time_limit - len(paid)))

    lags = []
    for state in np.flatnonzero(~np.asarray(learnt.mdp.terminal)):
        for action in range(q.shape[1]):
            lost = walk(state, q[state].argmax()) - walk(state, action)
            if lost.sum() > 1e-6:
                lags.append((lost * np.arange(len(lost))).sum() / lost.sum())
    assert scripts[0].advantage_lag(made, learnt) == pytest.approx(max(lags))


@pytest.mark.long
def test_an_umbrella_waits_for_the_end_and_a_memory_does_not(scripts):
    assert scripts[0].advantage_lag(*task("umbrella_chain", chain_length=9)) == pytest.approx(8)
    assert scripts[0].advantage_lag(*task("memory_chain", memory_length=9)) == 0


@pytest.mark.long
@pytest.mark.parametrize("length", [1, 4])
def test_memory_goes_back_to_what_was_seen_first(scripts, length):
    chain = {"memory_length": length, "num_bits": 2}
    assert scripts[0].memory_steps(*task("memory_chain", options={"seen_first": "bits"}, **chain)) == length
    assert scripts[0].memory_steps(*task("memory_chain", **chain)) == 0
    assert scripts[0].memory_steps(*task("memory_chain", "vector", {"hide": "bits"}, **chain)) == math.inf


def test_levels_lie_among_rungs_and_beyond_the_last(scripts):
    place = scripts[1].place
    assert [place(value, [1, 2, 4]) for value in (0, 1, 3, 4, 8)] == [0, 0, 1.5, 2, 4]


def test_a_ladder_is_admitted_if_it_rises_and_nothing_else_moves_half_as_far(scripts):
    suite = load_suite()
    ladder = next(each for each in suite.ladders if each.axis == "credit")
    rungs = {each.axis: [task.level for task in each.tasks] for each in suite.ladders}
    still = {axis: 0.0 for axis in scripts[1].AXES}
    rows = [{**still, "credit": task.level} for task in ladder.tasks]
    assert scripts[1].verdict(ladder, rows, rungs).endswith("| yes |")
    noise = np.interp(np.linspace(0, 3.1, len(rows)), range(len(rungs["estimation"])), rungs["estimation"])
    moved = [{**row, "estimation": value} for row, value in zip(rows, noise, strict=True)]
    assert scripts[1].verdict(ladder, moved, rungs).endswith("| no |")
    assert scripts[1].verdict(ladder, rows[::-1], rungs).endswith("| no |")
