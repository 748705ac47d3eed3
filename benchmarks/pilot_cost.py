"""Which is cheaper, a prediction or a pilot? Processor seconds of both, and how well a pilot of equal cost predicts.

    python benchmarks/pilot_cost.py [--out rows.csv] [--agent A ...] [--case CASE ...] [--limit SECONDS] [--read]

Each agent, world and observation is measured in a process of its own, on one thread, with the hyperparameters of the
published cells. The process predicts and trains once before it measures, so that compiling does not count. Then:

- the measure: `pharos.predict` of 30 and of 600 thousand steps, medians of up to REPEATS. Each has another length
  (30,000, 29,999, ...), as results are stored. The state space is stored already. Both solve the MDP for its values.
- the pilot: the batched engine, one seed, with few and with more steps and with few and with more evaluations. That
  gives seconds to begin, seconds of a thousand steps and seconds of an evaluation, of which a whole run has 30. A share
  s of a run costs begin + s (steps + 30 evaluations).

The share of a run that costs as much as the measure is looked up in how well pilots predict (R2 on the second sealed
set, `prediction_cells.py pilots`), linearly between the shares there. The measure wins if its own R2 is larger.
"""

import argparse
import csv
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import pharos
from pharos.agents import primary_predictors
from pharos.prediction.calibration import COMMON
from pharos.prediction.pilot import EVALUATIONS

CASES = {
    "frozen_lake/vector": ("frozen_lake", {}, "vector"),
    "frozen_lake/simple_image": ("frozen_lake", {}, "simple_image"),
    "frozen_lake-16/vector": ("frozen_lake", {"size": 16, "seed": 0}, "vector"),
    "taxi-4/vector": ("taxi", {"size": 4}, "vector"),
    "taxi-4/simple_image": ("taxi", {"size": 4}, "simple_image"),
    "taxi-6/vector": ("taxi", {"size": 6}, "vector"),
    "taxi-8/vector": ("taxi", {"size": 8}, "vector"),
    "taxi-10/vector": ("taxi", {"size": 10}, "vector"),
    "taxi-10/simple_image": ("taxi", {"size": 10}, "simple_image"),
    "taxi-32/vector": ("taxi", {"size": 32}, "vector"),
}
LENGTHS = (30_000, 600_000)
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
REPEATS, ENOUGH = 3, 6.0  # times, and seconds after which there is no other
FEW, MORE = 2_000, 6_000  # steps; a DQN learns from the thousandth on
COLUMNS = ("agent", "case", "states", "begin", "thousand_steps", "evaluation", *(f"measure_{n}" for n in LENGTHS))


def clock():
    """Processor seconds of this process and its children."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def median_seconds(function):
    """Median of processor seconds of function(0), function(1), ..., at most REPEATS or until ENOUGH of them."""
    seconds = []
    while len(seconds) < REPEATS and sum(seconds) < ENOUGH:
        began = clock()
        function(len(seconds))
        seconds.append(clock() - began)
    return statistics.median(seconds)


def measured(agent, case):
    """Print a row of COLUMNS after each length, as far as it is then."""
    world, parameters, observation = CASES[case]
    env = pharos.make(world, **parameters)

    def predict(steps):
        return pharos.predict(env, observation, agent=agent, common=True, steps=steps)

    def seconds_of_run(steps, evaluations):
        options = {"hyperparameters": COMMON[agent], "observation": observation}
        interval = steps // evaluations
        return median_seconds(
            lambda seed: pharos.train(
                agent, env, engine="batched", steps=steps, evaluation_interval=interval, seed=seed, **options
            )
        )

    pharos.predict("simple_grid", observation, agent=agent, height=3, width=3)
    pharos.train(agent, env, engine="batched", steps=FEW, hyperparameters=COMMON[agent], observation=observation)
    few, more, often = seconds_of_run(FEW, 1), seconds_of_run(MORE, 1), seconds_of_run(FEW, 8)
    step, evaluation = max(0.0, more - few) / (MORE - FEW), max(0.0, often - few) / 7
    row = {"agent": agent, "case": case, "states": pharos.build(env).num_states}
    row |= {"begin": max(0.0, few - FEW * step - evaluation), "thousand_steps": 1000 * step, "evaluation": evaluation}
    for length in LENGTHS:
        row[f"measure_{length}"] = median_seconds(lambda number, length=length: predict(length - number))
        print(
            ",".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()), flush=True
        )


def share_at_equal_cost(row, steps):
    """The share of a run of so many steps that costs as much as the measure; above 1 if the measure costs more."""
    whole = float(row["thousand_steps"]) * steps / 1000 + EVALUATIONS * float(row["evaluation"])
    return max(0.0, float(row[f"measure_{steps}"]) - float(row["begin"])) / whole


def r_squared_at(share, pilots):
    """R2 of a pilot of this share: linear between the shares of {share: R2}, ascending, and constant beyond them."""
    return float(np.interp(share, [*pilots], [*pilots.values()]))


def table(rows):
    """Print a line for each agent, world and observation, with both lengths."""
    from prediction_cells import CELLS_FILE, SHARES, r_squared_of_pilots

    stored = {(agent, words): values for agent, words, values in r_squared_of_pilots(CELLS_FILE)}
    heads = " | ".join(f"{steps:,} steps: share | R² of such a pilot | use" for steps in LENGTHS)
    print(f"| agent | world, observation | states | {heads} |")
    print("|" + "---|" * (3 + 3 * len(LENGTHS)))
    for row in rows:
        pilots = dict(zip(SHARES, stored[row["agent"], "a pilot"], strict=True))
        measure, entries = stored[row["agent"], "the measure alone"][0], []
        for steps in LENGTHS:
            if not row.get(f"measure_{steps}"):
                entries.append(" |  | ")
                continue
            share = share_at_equal_cost(row, steps)
            r_squared = r_squared_at(share, pilots)
            entries.append(f"{share:.2g} | {r_squared:.2f} | {'the measure' if measure > r_squared else 'the pilot'}")
        print(f"| {row['agent'].upper()} | {row['case']} | {int(row['states']):,} | {' | '.join(entries)} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", action="append", choices=[*primary_predictors()])
    parser.add_argument("--case", action="append", choices=[*CASES])
    parser.add_argument("--limit", type=float, default=1200, help="seconds after which a process is ended")
    parser.add_argument(
        "--out", type=Path, default=Path("pilot-cost.csv"), help="rows that are added to, or of which the table is made"
    )
    parser.add_argument("--read", action="store_true", help="measure nothing: the table of --out")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    agents, cases = arguments.agent or [*primary_predictors()], arguments.case or [*CASES]
    if arguments.one:
        return measured(agents[0], cases[0])
    with tempfile.TemporaryDirectory() as cache:
        for case in [] if arguments.read else cases:
            for agent in agents:
                measure_apart(agent, case, arguments.out, arguments.limit, cache)
    with arguments.out.open(newline="", encoding="utf-8") as file:
        table(list(csv.DictReader(file)))


def measure_apart(agent, case, out, limit, cache):
    """Append the row of a process of its own; what it has not measured by the limit stays empty."""
    environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PHAROS_CACHE_DIR": cache}
    command = [sys.executable, __file__, "--one", "--agent", agent, "--case", case]
    try:
        text = subprocess.run(command, env=environment, stdout=subprocess.PIPE, timeout=limit, check=True).stdout
    except subprocess.TimeoutExpired as ended:
        text = ended.stdout or b""
    lines, is_new = text.decode().splitlines(), not out.exists()
    if not lines:
        return print(f"{agent} {case}: nothing measured in {limit:g} s", file=sys.stderr)
    with out.open("a", encoding="utf-8") as file:
        missing = len(COLUMNS) - 1 - lines[-1].count(",")
        file.write((",".join(COLUMNS) + "\n" if is_new else "") + lines[-1] + "," * missing + "\n")


if __name__ == "__main__":
    main()
