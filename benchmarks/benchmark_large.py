"""The suite `large` and its baselines, from the stored runs of the paper's grid; nothing is trained.

python benchmarks/benchmark_large.py                       writes suites/large.yaml and baselines/large/*.safetensors
python benchmarks/benchmark_large.py --check 1000000       solves tasks of at most so many states again

V*, U and the value of the worst policy are those that all runs of a task name; the range of returns is that of the
instance without chance, whatever is executed. Curves are each fifth row of the stored ones. Q-learning's table has a
row for each state, whatever is seen, so its runs are those of both observations.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark import AgentResults, BenchmarkTask, Protocol, Suite, frozen, load_suite, write_suite
from pharos.benchmark.results import BASELINES
from pharos.benchmark.suite import FOLDER, digest_of_suite
from pharos.environments import make
from pharos.training import Task

STUDY = Path(__file__).parent.parent / "docs/studies/paper"
RUNS = STUDY / "runs.parquet"
LATER = STUDY / "later-runs.parquet"
"""Runs made after the suite was frozen: they are of baselines alone, and its tasks' seconds know nothing of them."""
PROTOCOL = Protocol(steps=600_000, evaluations=20, seeds=5)
OBSERVATIONS = "vector", "simple_image"
CHANCES: tuple[dict[str, float], ...] = ({}, {"random": 0.1})
FREEWAYS = ("20x5", "16x7", "20x11", "25x9", "25x13")
BREAKOUTS = ("12x8x3", "16x8x3", "20x8x3", "24x8x3", "12x8x1", "16x8x1", "20x8x1", "24x8x1", "12x10x3", "12x10x1")
INSTANCES = (
    *(f"freeway/{size}-speed{speed}" for size in FREEWAYS for speed in (1, 2)),
    *(f"breakout/{size}" for size in BREAKOUTS),
)
QUICK = ("20x5-speed1", "16x7-speed2", "25x9-speed1", "12x8x3", "12x8x1", "16x8x3")
ERROR = 1e-9
"""Relative to the largest value: solvers of finite horizons differ by rounding alone."""
Runs = Mapping[tuple[str, str, float, str], list[tuple[dict[str, Any], np.ndarray]]]
"""(instance, observation, probability of random actions, agent) -> records and curves, by seed."""


def stored_runs(*files: Path) -> Runs:
    """Packed runs of the grid on large instances, without chance and with random actions."""
    import pandas as pd

    names = {}
    for name in INSTANCES:
        env = make(name)
        names[env.name, json.dumps(json.loads(json.dumps(env.parameters)), sort_keys=True)] = name
    runs = defaultdict(list)
    frame = pd.concat([pd.read_parquet(file) for file in files])
    for text, steps, regrets in zip(frame["record"], frame["step"], frame["normalized_regret"], strict=True):
        record = json.loads(text)
        config = record["config"]
        key = config["environment"], json.dumps(config["parameters"], sort_keys=True)
        if key not in names or config["chance"]["sticky"] or record["status"] != "finished":
            continue
        rows = np.isin(steps, np.arange(1, PROTOCOL.evaluations + 1) * PROTOCOL.evaluation_interval)
        assert rows.sum() == PROTOCOL.evaluations and config["steps"] == PROTOCOL.steps
        place = names[key], config["observation"], config["chance"]["random"], config["agent"]
        runs[place].append((record, np.asarray(regrets)[rows]))
    for each in runs.values():
        each.sort(key=lambda run: run[0]["config"]["seed"])
        assert [record["config"]["seed"] for record, _ in each] == list(range(PROTOCOL.seeds))
    return runs


def values_of(runs: Runs, instance: str, random: float) -> tuple[float, float, float]:
    """Optimal, uniform and worst value of a task, on which all runs agree."""
    results = [
        record["result"]
        for (name, _, chance, _), each in runs.items()
        for record, _ in each
        if (name, chance) == (instance, random)
    ]
    first, *others = ([each[f"value_{name}"] for name in ("optimal", "uniform", "worst")] for each in results)
    assert np.allclose(first, others, rtol=1e-9, atol=1e-9), (instance, random)
    return first[0], first[1], first[2]


def seconds_of(runs: Runs, instance: str, observation: str, random: float) -> dict[str, float]:
    """Mean seconds of one processor that a run of each baseline took.

    Where there are none, or those of a GPU alone: of all runs on the same class with the same observation.
    """
    seconds = {}
    for agent in ("dqn", "ppo", "q_learning"):
        seen = "index" if agent == "q_learning" else observation
        times: dict[bool, list[float]] = {False: [], True: []}  # of the class; of the task
        for place, own in runs.items():
            if (place[0].partition("/")[0], place[1], place[3]) == (instance.partition("/")[0], seen, agent):
                cpu = [record["seconds"] for record, _ in own if record.get("batch", {}).get("device") != "cuda"]
                times[False] += cpu
                times[True] += cpu * (place[::2] == (instance, random))
        seconds[agent] = round(float(np.mean(times[True] or times[False])), 1)
    return seconds


def tasks(runs: Runs) -> Iterator[BenchmarkTask]:
    """The tasks, frozen: those without chance first."""
    from pharos.state_space import build

    for chance in CHANCES:
        for instance in INSTANCES:
            random = chance.get("random", 0.0)
            optimal, uniform, worst = values_of(runs, instance, random)
            highest, _, lowest = values_of(runs, instance, 0.0)
            error = ERROR * max(abs(optimal), abs(worst))
            stored = {"states": build(make(instance)).num_states, "worst": worst, "lowest": lowest, "highest": highest}
            for observation in OBSERVATIONS:
                name = "-".join([instance.replace("/", "-"), observation, *(["random-0.1"] if chance else [])])
                yield frozen(
                    BenchmarkTask(
                        name,
                        instance,
                        observation=observation,
                        chance=chance,
                        value_optimal=optimal,
                        value_uniform=uniform,
                        seconds=seconds_of(runs, instance, observation, random),
                        stored={**stored, "error_bound": error},
                    ),
                    PROTOCOL,
                )


def baseline(runs: Runs, suite: Suite, agent: str) -> AgentResults:
    """The results of an agent, on the tasks that it has runs of."""
    curves, exact, versions, settings = {}, {}, [], []
    for task in suite.tasks:
        observation = "index" if agent == "q_learning" else task.observation
        own = runs.get((task.environment, observation, task.chance.get("random", 0.0), agent), [])
        if not own:
            continue
        curves[task.name] = np.array([curve for _, curve in own])
        exact[task.name] = all(record["result"]["exact"] for record, _ in own)
        for record, _ in own:
            setting = {"tasks": f"{task.environment.partition('/')[0]}, {observation}", **record["hyperparameters"]}
            settings += [setting] * (setting not in settings)
            versions += [record["versions"]] * (record["versions"] not in versions)
    different = {json.dumps({**each, "tasks": ""}, sort_keys=True) for each in settings}
    if len(different) == 1:
        setting = {name: value for name, value in settings[0].items() if name != "tasks"}
        more: dict[str, Any] = {"hyperparameters": setting}
    else:
        division = f"tuned: {len(different)} settings, see hyperparameters"
        more = {"division": division, "hyperparameters": {each.pop("tasks"): each for each in settings}}
    steps = PROTOCOL.steps * sum(map(len, curves.values()))
    record = {"agent": agent, "form": "engine", "source": None, **more, "versions": versions[-1]}
    record |= {"exact": exact, "steps_used": steps}
    return AgentResults(agent, suite.name, suite.digest, tuple(range(PROTOCOL.seeds)), curves, record)


def check(suite: Suite, largest: int) -> None:
    """Solve instances of at most `largest` states again, and say how far the stored values are apart."""
    for task in suite.tasks:
        if task.stored["states"] > largest or task.observation != "vector":
            continue
        solved = Task.of(task.environment, chance=task.training_task(PROTOCOL).chance, horizon="limit")
        reference, stored = solved.reference, task.stored_values
        assert stored is not None
        pairs = [
            (getattr(reference, name), getattr(stored.reference, name)) for name in ("optimal", "uniform", "worst")
        ]
        pairs += list(zip(solved.return_range, stored.return_range, strict=True))
        difference = max(abs(own - other) for own, other in pairs)
        within = stored.reference.error_bound + reference.error_bound
        print(
            f"{task.name}: V* {reference.optimal:.9g}, at most {difference:.2g} apart, {within:.2g} allowed", flush=True
        )
        assert difference <= within, task.name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", type=int, metavar="STATES", help="only solve instances of at most so many states")
    options = parser.parse_args()
    if options.check is not None:
        check(load_suite("large"), options.check)
        return
    runs = stored_runs(RUNS)
    (dqn, _), *_ = runs["freeway/20x5-speed1", "simple_image", 0.0, "dqn"]
    (ppo, _), *_ = runs["freeway/20x5-speed1", "vector", 0.0, "ppo"]
    (table, _), *_ = runs["freeway/20x5-speed1", "index", 0.0, "q_learning"]
    settings = {"dqn": dqn, "ppo": ppo, "q_learning": table}
    core = tuple(tasks(runs))
    quick = [each.name for each in core if not each.chance and each.environment.partition("/")[2] in QUICK]
    suite = Suite(
        "large",
        PROTOCOL,
        core,
        (),
        hyperparameters={name: record["hyperparameters"] for name, record in settings.items()},
        quick={"tasks": quick, "seeds": 2},
    )
    suite = replace(suite, digest=digest_of_suite(suite))
    write_suite(suite, FOLDER / "large.yaml")
    runs = stored_runs(RUNS, LATER)
    for agent in settings:
        results = baseline(runs, suite, agent)
        file = BASELINES / suite.name / f"{agent}.safetensors"
        file.parent.mkdir(parents=True, exist_ok=True)
        results.write(file)
        print(f"{agent}: {len(results.curves)} tasks, mean regret {results.mean():.3f}, {file.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
