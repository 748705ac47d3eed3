"""Does the order of agents on v1 hold elsewhere: on other suites, and on its own worlds with ten times the states?

python benchmarks/benchmark_orders.py                   order of shipped baselines in each suite; nothing is run
python benchmarks/benchmark_orders.py --larger DIR      runs five worlds of v1 made larger, with two seeds of each agent

A score is the mean over the tasks that all three agents have run. Each suite's order is held against that of v1's core.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from scipy.stats import kendalltau

from pharos import benchmark
from pharos.benchmark.comparison import LEAST_DIFFERENCE
from pharos.benchmark.scores import run_scores
from pharos.benchmark.suite import digest_of_suite
from pharos.statistics import spearman

AGENTS = {"q_learning": "Q-learning", "dqn": "DQN", "ppo": "PPO"}
"""Whom v1, v2 and large all have baselines of."""
SUITES = "v1", "v2", "large"
SEEDS = range(2)
LARGER = {
    "deep_sea-8-one_hot": {"size": 27},
    "frozen_lake-5-0-vector-random-0.1": {"size": 16},
    "breakout-5-4-1-one_hot-random-0.1": {"height": 6, "columns": 6},
    "freeway-6-3-hash-random-0.1": {"lane_length": 18},
    "simple_grid-32-32-vector-random-0.1": {"height": 101, "width": 101},
}
"""Tasks of v1's core -> sizes at which they have some ten times the states; named before any run."""
Scores = Mapping[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--larger", type=Path, metavar="DIR", help="folder for runs of larger worlds; they continue")
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    if options.larger is None:
        print_orders()
    else:
        print_larger(options.larger, options.workers)


def shipped(suite: str, *, last: bool = False) -> dict[str, dict[str, float]]:
    """Task -> mean score of each agent's shipped baseline, of the tasks that all agents have run, in their order.

    Args:
        last: of the last evaluation alone, in place of the mean over the run.
    """
    runs = {name: run_scores(benchmark.read_results(f"{suite}/{name}"), last=last) for name in AGENTS}
    return {
        task.name: {name: float(own[task.name].mean()) for name, own in runs.items()}
        for task in benchmark.load_suite(suite).tasks
        if all(task.name in own for own in runs.values())
    }


def groups(suite: benchmark.Suite) -> dict[str, list[str]]:
    """Names of tasks by part of the suite: its core and axes, or by world, observation and chance if it is one list."""
    parts: dict[str, list[str]] = {}
    for task in suite.tasks:
        world = f"{task.environment.partition('/')[0]}, {task.observation}{', random' * bool(task.chance)}"
        parts.setdefault(task.axis if suite.ladders else world, []).append(task.name)
    return parts


def mean_of(scores: Iterable[Scores]) -> dict[str, float]:
    """Mean score of each agent over tasks."""
    rows = list(scores)
    return {name: float(np.mean([row[name] for row in rows])) for name in AGENTS}


def order(scores: Scores) -> str:
    """Agents from the best on; a difference below 0.02 from the one before is written `=`."""
    ranked = sorted(scores, key=lambda name: -scores[name])
    text = AGENTS[ranked[0]]
    for before, name in pairwise(ranked):
        text += f" {'=' if scores[before] - scores[name] < LEAST_DIFFERENCE else '>'} {AGENTS[name]}"
    return text


def row(title: str, count: int, scores: Scores, beside: Scores | None = None) -> str:
    """One line of a table: scores, their order, and rank correlations with the scores `beside`.

    Args:
        count: of tasks or states; 0 is left out.
    """
    values = [f"{scores[name]:.2f}" for name in AGENTS]
    cells = [title, f"{count:,}" if count else "", *values, order(scores)]
    if beside is not None:
        own, other = ([each[name] for name in AGENTS] for each in (scores, beside))
        cells += [f"{kendalltau(own, other).statistic:.2f}", f"{spearman(np.array(own), np.array(other)):.2f}"]
    return f"| {' | '.join(cells)} |"


def header(titles: Sequence[str]) -> str:
    return f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}"


def print_orders() -> None:
    """Three tables: order by suite and by part of it, on how many tasks each agent is better than each other one, and
    order by the last evaluations alone."""
    tables = {suite: shipped(suite) for suite in SUITES}
    core = groups(benchmark.load_suite(SUITES[0]))[benchmark.suite.CORE]
    first = mean_of(tables[SUITES[0]][name] for name in core)
    print(header(["tasks of", "tasks", *AGENTS.values(), "order", "Kendall", "Spearman"]))
    for suite, scores in tables.items():
        print(row(f"{suite}, all", len(scores), mean_of(scores.values()), first))
        for part, names in groups(benchmark.load_suite(suite)).items():
            if run := [scores[name] for name in names if name in scores]:
                print(row(f"{suite}, {part}", len(run), mean_of(run), first))
    print("\n" + header(["by 0.02 or more", *SUITES]))
    for one, other in combinations(AGENTS, 2):
        cells = [better(scores.values(), one, other) for scores in tables.values()]
        print(f"| {AGENTS[one]} or {AGENTS[other]} | {' | '.join(cells)} |")
    print("\n" + header(["last evaluation of", "tasks", *AGENTS.values(), "order"]))
    for title, names in (("v1, core", core), ("large, all", list(tables["large"]))):
        ends = shipped(title.partition(",")[0], last=True)
        print(row(title, len(names), mean_of(ends[name] for name in names)))


def better(scores: Iterable[Scores], one: str, other: str) -> str:
    """On how many tasks the first agent is better, and on how many the second."""
    gaps = np.array([each[one] - each[other] for each in scores])
    return f"{(gaps >= LEAST_DIFFERENCE).sum()} or {(gaps <= -LEAST_DIFFERENCE).sum()} of {len(gaps)}"


def larger_suite() -> benchmark.Suite:
    """The tasks of LARGER with the protocol and settings of v1."""
    v1 = benchmark.load_suite(SUITES[0])
    tasks = []
    for name, sizes in LARGER.items():
        task = v1.task(name)
        own = replace(task, parameters={**task.parameters, **sizes}, predicted={}, seconds={}, name=f"larger-{name}")
        tasks.append(benchmark.frozen(own, v1.protocol))
    suite = benchmark.Suite("larger", v1.protocol, tuple(tasks), (), "", v1.hyperparameters)
    return replace(suite, digest=digest_of_suite(suite))


def print_larger(folder: Path, workers: int | None) -> None:
    """Run all agents on the larger worlds, and print each world beside the small one."""
    suite, v1, small = larger_suite(), benchmark.load_suite(SUITES[0]), shipped(SUITES[0])
    runs = {}
    for name in AGENTS:
        outcome = benchmark.run(name, suite, out=folder / name, seeds=SEEDS, workers=workers)
        runs[name] = run_scores(outcome.results)
    scores = {task.name: {name: float(own[task.name].mean()) for name, own in runs.items()} for task in suite.tasks}
    print(header(["world", "states", *AGENTS.values(), "order"]))
    for (name, sizes), task in zip(LARGER.items(), suite.tasks, strict=True):
        larger = ", ".join(f"{key} {size}" for key, size in sizes.items())
        for title, each, values in ((name, v1.task(name), small[name]), (larger, task, scores[task.name])):
            print(row(title, each.training_task(v1.protocol).space.num_states, values))
    for title, rows in (("mean", [small[name] for name in LARGER]), ("mean, larger", scores.values())):
        print(row(title, 0, mean_of(rows)))


if __name__ == "__main__":
    main()
