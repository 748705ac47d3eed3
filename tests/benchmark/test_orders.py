"""The order of agents from suite to suite: as the page of evidence has it, and counted by hand."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import pharos
from benchmark_modules import benchmark
from pharos.benchmark import load_suite, read_results

EVIDENCE = (Path(__file__).parents[2] / "docs" / "evidence" / "benchmark.md").read_text()


@pytest.fixture(scope="module")
def orders():
    return benchmark("benchmark_orders")


def test_the_tables_of_the_evidence_are_those_of_shipped_baselines(orders, capsys):
    orders.print_orders()
    printed = capsys.readouterr().out
    assert printed.count("\n| ") > 20
    assert all(table in EVIDENCE for table in printed.strip().split("\n\n"))


def test_scores_are_means_over_the_tasks_that_all_agents_have_run(orders):
    """From the curves alone: 1 less the mean regret of each run, which is clipped as a whole."""
    curves = {name: read_results(f"large/{name}").curves for name in orders.AGENTS}
    common = set.intersection(*map(set, curves.values()))
    assert len(common) == 80 == len(orders.shipped("large"))
    own = orders.mean_of(orders.shipped("large").values())
    for name, each in curves.items():
        scores = [1 - min(max(np.mean(run), 0.0), 1.0) for task in sorted(common) for run in each[task]]
        assert own[name] == pytest.approx(np.mean(scores), abs=1e-12)


@pytest.mark.parametrize(
    ("scores", "text"),
    [
        ((0.3, 0.5, 0.4), "DQN > PPO > Q-learning"),
        ((0.5, 0.489, 0.2), "Q-learning = DQN > PPO"),
        ((0.1, 0.115, 0.13), "PPO = DQN = Q-learning"),
    ],
)
def test_the_order_says_which_scores_are_alike(orders, scores, text):
    assert orders.order(dict(zip(orders.AGENTS, scores, strict=True))) == text


def test_a_line_has_the_rank_correlation_counted_by_pairs(orders):
    first, second = (dict(zip(orders.AGENTS, each, strict=True)) for each in ((0.9, 0.5, 0.1), (0.2, 0.6, 0.1)))
    signs = [np.sign((first[a] - first[b]) * (second[a] - second[b])) for a, b in combinations(first, 2)]
    cells = orders.row("lake", 3, second, first).strip("| ").split(" | ")
    assert cells[:2] == ["lake", "3"] and cells[-2] == f"{np.mean(signs):.2f}"
    ranks = [[sorted(each.values()).index(value) for value in each.values()] for each in (first, second)]
    distance = sum((a - b) ** 2 for a, b in zip(*ranks, strict=True))
    assert cells[-1] == f"{1 - 6 * distance / (3 * 8):.2f}"


def test_better_counts_tasks_with_a_gap_that_matters(orders):
    scores = [{"dqn": a, "ppo": b, "q_learning": 0.0} for a, b in ((0.5, 0.4), (0.5, 0.49), (0.1, 0.9), (0.3, 0.7))]
    assert orders.better(scores, "dqn", "ppo") == "1 or 2 of 4"


@pytest.mark.long
@pytest.mark.parametrize("index", range(5))
def test_larger_worlds_have_ten_times_the_states(orders, index):
    name, sizes = list(orders.LARGER.items())[index]
    task = load_suite().task(name)
    small, larger = (
        pharos.build(pharos.make(task.environment, **{**task.parameters, **more}), progress=False).num_states
        for more in ({}, sizes)
    )
    assert 9.5 < larger / small < 10.5
