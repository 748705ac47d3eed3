"""Lesions: whether an axis measures what its name says, by agents that are known to lack one thing.

python benchmarks/benchmark_lesions.py --out FOLDER            run what FOLDER lacks, then print the matrix
python benchmarks/benchmark_lesions.py --out FOLDER --print    print the matrix of what is there

Whole agents are shipped baselines. A lesion is one of them with one thing changed that an axis is about: an agent that
does not hope explores less, one that believes the last reward alone is misled by noise, one with a short horizon sees
no late consequence, one without recurrence remembers nothing. Its fall on an axis is the whole agent's score less its
own, with the interval of `pharos benchmark compare`. An axis holds if its lesion falls by at least FALL on it, and by
at least TIMES what it falls by on any other axis; one that does not is not in the suite. `--suite` takes the file of
ladders that were left out, too: whole agents are then run as well.

Agents that see the number of the state do not run where memory is asked for: what is seen means nothing to them.
"""

import argparse
from pathlib import Path

from pharos import benchmark

FALL, TIMES, SEEDS = 0.2, 2.0, 5
LESIONS = {  # name: (whole baseline, axis that must fall, agent, what is changed)
    "no hope: values begin at 0, not 1": ("q_learning", "exploration", "q_learning", {"initial_q": 0.0}),
    "last reward only: learning rate 1, no averages": (
        "q_learning",
        "estimation",
        "q_learning",
        {"learning_rate": 1.0, "visits_exponent": 0.0},
    ),
    "short horizon: discount 0.5, not 0.95": ("dqn", "credit", "dqn", {"gamma": 0.5}),
    "short horizon: discount 0.5, not 0.99": ("q_learning", "credit", "q_learning", {"gamma": 0.5}),
    "no recurrence: PPO, not recurrent PPO": ("recurrent_ppo", "memory", "ppo", {}),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--suite", default="v1")
    parser.add_argument("--print", action="store_true")
    options = parser.parse_args()
    suite = benchmark.load_suite(options.suite)
    axes = [ladder.axis for ladder in suite.ladders]
    print(f"| whole agent | lesion | {' | '.join(axes)} | verdict |\n|---|---|{'---|' * (len(axes) + 1)}")
    for name, (whole, target, agent, changed) in LESIONS.items():
        both = [results(suite, options, whole, whole, {}), results(suite, options, name, agent, changed)]
        print(row(name, target, axes, benchmark.compare(*both, suite=suite)), flush=True)


def results(suite, options, name, agent, changed):
    """Results of an agent: shipped, or of its folder, where what is missing is run first."""
    if not changed and agent in benchmark.baselines(suite.name):
        return benchmark.read_results(f"{suite.name}/{agent}")
    folder = options.out / suite.name / name.partition(":")[0].replace(" ", "_") / agent
    if not options.print:
        axes = [ladder.axis for ladder in suite.ladders if agent != "q_learning" or ladder.axis != "memory"]
        benchmark.run(
            agent, suite, out=folder, seeds=range(SEEDS), tasks=axes, name=f"{agent}, {name}", hyperparameters=changed
        )
    return benchmark.read_results(folder)


def row(name, target, axes, comparison):
    """A row of the matrix: falls on each axis, and whether the axis of the lesion holds."""
    falls = {axis: each.score.interval for axis, each in comparison.axes.items()}
    others = max(fall.value for axis, fall in falls.items() if axis != target)
    verdict = ""
    if target in falls:
        verdict = f"{target} {'holds' if falls[target].value >= max(FALL, TIMES * others) else 'fails'}"
    cells = [
        f"{falls[axis].value:.2f} ({falls[axis].low:.2f} to {falls[axis].high:.2f})" if axis in falls else "-"
        for axis in axes
    ]
    return f"| {comparison.ours.partition(',')[0]} | {name} | {' | '.join(cells)} | {verdict} |"


if __name__ == "__main__":
    main()
