"""Do intervals of the benchmark cover the truth, and does an agent differ from itself? docs/evidence/benchmark.md.

python benchmarks/benchmark_statistics.py simulated [--repetitions 2000]
python benchmarks/benchmark_statistics.py runs RESULTS... [--suite FILE] [--repetitions 2000]

Seeds are drawn with replacement from many: from shapes of runs (simulated), or from results with some 200 seeds (runs).
The mean over all of them is the truth. Prints, for 3, 5 and 10 seeds, how often the interval of each score and of
the difference of an agent and itself holds it, beside the percentile bootstrap's (500 resamples), and the
share of p < 0.05.
"""

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from pharos.benchmark import AgentResults, compare, load_suite, score
from pharos.benchmark.scores import run_scores
from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite
from pharos.statistics import bootstrap_interval, mean_of_means

STUDY = Path(__file__).parents[1] / "docs/studies/hardness-dev/runs.parquet"
MANY = 20_000
SEEDS = (3, 5, 10)


def simulated():
    """Runs of 24 core tasks, shaped as a study's cells, and of ladders on which runs fail as they do in deep_sea."""
    rng = np.random.default_rng(0)
    cells = [cell for cell in _cells() if 0.05 < cell.mean() < 0.95]
    core = {f"core-{index}": _like(cells[cell], rng) for index, cell in enumerate(rng.choice(len(cells), 24, False))}
    ladders = {
        "sea": [_failing(share, rng) for share in (0.0, 0.02, 0.2, 0.5, 0.8, 1.0)],
        "cliff": [_failing(share, rng) for share in (0.0, 0.0, 0.05, 0.95, 1.0, 1.0)],
        "noise": [
            rng.normal(*shape, MANY)
            for shape in ((0.04, 0.03), (0.08, 0.04), (0.15, 0.07), (0.36, 0.12), (0.79, 0.15), (0.85, 0.1))
        ],
        "one-rung": [_failing(share, rng) for share in (0.0, 0.0, 0.0, 0.3, 1.0, 1.0)],
    }
    rungs = {axis: {f"{axis}-{level}": runs for level, runs in enumerate(own)} for axis, own in ladders.items()}
    suite = Suite(
        "simulated",
        Protocol(),
        tuple(BenchmarkTask(name, "") for name in core),
        tuple(
            Ladder(
                axis,
                "rungs",
                "",
                tuple(BenchmarkTask(name, "", axis=axis, level=float(level)) for level, name in enumerate(own)),
            )
            for axis, own in rungs.items()
        ),
        "0" * 64,
    )
    curves = {name: runs[:, None] for own in (core, *rungs.values()) for name, runs in own.items()}
    return suite, AgentResults("simulated", suite.name, suite.digest, tuple(range(MANY)), curves)


def _cells():
    """Mean normalised regret of the five runs of each cell of a study."""
    import json

    cells = defaultdict(list)
    columns = pq.read_table(STUDY, columns=["record", "normalized_regret"]).to_pydict()
    for record, curve in zip(columns["record"], columns["normalized_regret"], strict=True):
        config = json.loads(record)["config"]
        cells[json.dumps({name: value for name, value in config.items() if name != "seed"})].append(np.mean(curve))
    return [np.array(runs) for runs in cells.values()]


def _like(runs, rng):
    """Many runs as skewed as these few: one of them and a little noise."""
    return np.clip(rng.choice(runs, MANY) + rng.normal(0.0, 0.4 * runs.std(ddof=1) + 1e-3, MANY), 0.0, 1.0)


def _failing(share, rng):
    """Many runs of which a share fails from the first step to the last."""
    return np.where(rng.random(MANY) < share, 1.0, rng.beta(2.0, 10.0, MANY))


def judge(suite, many, repetitions):
    """Print coverage and error of the first kind, by number of seeds."""
    truth, rng = score(many, suite), np.random.default_rng(1)
    spread = [name for name, runs in run_scores(many).items() if runs.std() > 0]
    print(f"{many.agent}: {len(spread)} of {len(many.curves)} tasks vary with the seed; {len(many.seeds)} runs of each")
    print("| score | seeds | covers | percentile covers | difference covers 0 | p < 0.05 |\n|---|---|---|---|---|---|")
    for seeds in SEEDS:
        hits, percentile = defaultdict(list), defaultdict(list)
        for repetition in range(repetitions):
            one, other = _drawn(many, seeds, rng), _drawn(many, seeds, rng)
            found, compared = score(one, suite), compare(one, other, suite=suite)
            pairs = {
                "core": (found.core, truth.core),
                "final": (found.final, truth.final),
                "IQM": (found.iqm, truth.iqm),
            }
            pairs["optimality gap"] = (found.optimality_gap, truth.optimality_gap)
            for axis, each in found.axes.items():
                pairs[axis] = (each.score, truth.axes[axis].score)
                pairs[f"{axis}, frontier"] = (each.frontier, truth.axes[axis].frontier)
            for name, (interval, true) in pairs.items():
                hits[name, "covers"].append(_holds(interval, true.value))
            differences = {"core": compared.core, **{axis: each.score for axis, each in compared.axes.items()}}
            for name, each in differences.items():
                hits[name, "zero"].append(_holds(each.interval, 0.0))
                hits[name, "p"].append(each.p_value < 0.05)
            for axis, each in compared.axes.items():
                hits[f"{axis}, frontier", "zero"].append(_holds(each.frontier, 0.0))
            hits["P(improvement)", "covers"].append(_holds(compared.core.improvement, 0.5))
            if repetition < repetitions // 4:
                _add_percentiles(percentile, suite, one, pairs)
        for name in dict.fromkeys(name for name, _ in hits):
            shares = [np.mean(hits[name, kind]) if (name, kind) in hits else None for kind in ("covers", "zero", "p")]
            shares.insert(1, np.mean(percentile[name]) if name in percentile else None)
            print(
                f"| {name} | {seeds} | "
                + " | ".join("" if share is None else f"{share:.3f}" for share in shares)
                + " |"
            )


def _drawn(many, seeds, rng):
    """Results of new seeds: those of each task are drawn for themselves."""
    curves = {name: own[rng.integers(0, len(own), seeds)] for name, own in many.curves.items()}
    return replace(many, seeds=tuple(range(seeds)), curves=curves)


def _holds(interval, value):
    return bool(not interval.low > value + 1e-9 and not interval.high < value - 1e-9)


def _add_percentiles(percentile, suite, results, pairs):
    """Percentile intervals of core and axes, from resamples of seeds within tasks."""
    runs = run_scores(results)
    families = {"core": suite.core, **{ladder.axis: ladder.tasks for ladder in suite.ladders}}
    for name, tasks in families.items():
        own = [runs[task.name] for task in tasks if task.name in runs]
        if own:
            low, high = bootstrap_interval(own, mean_of_means, resamples=500)
            percentile[name].append(low - 1e-9 <= pairs[name][1].value <= high + 1e-9)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulated", "runs"))
    parser.add_argument("results", nargs="*")
    parser.add_argument("--suite")
    parser.add_argument("--repetitions", type=int, default=2000)
    given = parser.parse_args()
    if given.what == "simulated":
        judge(*simulated(), given.repetitions)
    for name in given.results:
        results = AgentResults.read(name)
        judge(load_suite(given.suite or results.suite), results, given.repetitions)


if __name__ == "__main__":
    main()
