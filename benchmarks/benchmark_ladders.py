"""Which ladders the suite v1 may have: every axis' quantity on every rung, from measures alone, before any run.

python benchmarks/benchmark_ladders.py                     print the table, and which ladders are admitted
python benchmarks/benchmark_ladders.py --suite FILE.yaml   the same of benchmark_ladders_left_out.yaml, or of v2

Quantities are those of benchmark_select.py: exploration in bits, noise in gaps, credit in steps, representation as
predicted regret of a network less that of a table, memory in steps, states as a logarithm. A quantity is placed among
the rungs of its own ladder: at 1.5 it lies in the middle between the second and the third rung (counted from 0). What
is easier than the first rung counts as the first; beyond the last one the last step goes on.

A ladder is admitted if its own quantity rises with every rung, and in rungs moves at least TIMES as far as any other
quantity does. "No other moves by more than one rung" would refuse seas and umbrellas for what no world avoids: a longer
way has more states and later rewards. Twice is what lesions are held to as well: on its own axis an agent must lose at
least twice as much as on any other.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmark_select import LEVELS
from pharos.benchmark import load_suite

TIMES = 2.0
LEFT_OUT = Path(__file__).with_name("benchmark_ladders_left_out.yaml")
AXES = {
    "exploration": "exploration_bits",
    "estimation": "noise_over_gap",
    "credit": "advantage_lag",
    "representation": "network_less_table",
    "memory": "memory_steps",
    "scale": "log10_states",
}
AXES_V2 = {  # of v2, whose pairs have no quantity, and whose axes that are named here share theirs with another one
    "exploration_free": "exploration_bits",
    "estimation": "noise_over_gap",
    "credit": "advantage_lag",
    "scale": "copies_bits",
    "large_rewards": "unit_decades",
    "memory": "memory_steps",
}
RELATED = {"exploration_costly": "exploration_free", "small_rewards": "large_rewards"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="v1")
    suite = load_suite(parser.parse_args().suite)
    axes = AXES_V2 if suite.name == "v2" else AXES
    places = [*load_suite("v1").ladders, *load_suite(LEFT_OUT).ladders] if axes is AXES else suite.ladders
    rungs = {ladder.axis: [task.level for task in ladder.tasks] for ladder in places}
    verdicts = []
    print(f"| task | {' | '.join(axes)} |\n|---|{'---|' * len(axes)}", flush=True)
    for ladder in suite.ladders:
        if ladder.pairs:
            continue
        rows = []
        for task in ladder.tasks:
            rows.append(quantities(task, suite.protocol, axes))
            print(f"| {task.name} | {' | '.join(shown(value) for value in rows[-1].values())} |", flush=True)
        verdicts.append(verdict(ladder, rows, rungs, axes))
    print(f"\n| ladder | {' | '.join(axes)} | admitted |\n|---|{'---|' * (len(axes) + 1)}")
    print("\n".join(verdicts))


def quantities(task, protocol, axes=AXES):
    """Axis -> its quantity for this task."""
    learnt = task.training_task(protocol)
    return {axis: float(LEVELS[measure](task, learnt)) for axis, measure in axes.items()}


def verdict(ladder, rows, rungs, axes=AXES):
    """A row of the second table: how far each quantity moves, in rungs of its own ladder, and what follows."""
    moves = {}
    for axis in axes:
        places = [place(row[axis], rungs[axis]) for row in rows if not np.isnan(row[axis])] if axis in rungs else []
        moves[axis] = np.ptp(places) if places else np.nan
    own_axis = RELATED.get(ladder.axis, ladder.axis)
    own = [row[own_axis] for row in rows]
    others = [move for axis, move in moves.items() if axis != own_axis and not np.isnan(move)]
    is_admitted = bool(np.all(np.diff(own) > 0)) and moves[own_axis] >= TIMES * max(others)
    cells = [shown(move) for move in moves.values()]
    return f"| {ladder.axis} | {' | '.join(cells)} | {'yes' if is_admitted else 'no'} |"


def place(value, levels):
    """Where a quantity lies among the rungs of its ladder, counted from 0."""
    if value <= levels[-1]:
        return float(np.interp(value, levels, range(len(levels))))
    return len(levels) - 1 + (value - levels[-1]) / (levels[-1] - levels[-2])


def shown(value):
    return "-" if np.isnan(value) else f"{value:.2f}".rstrip("0").rstrip(".")


if __name__ == "__main__":
    main()
