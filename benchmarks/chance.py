"""What chance costs: a sweep over several outcomes against the deterministic one; one pass against sweeps.

    python benchmarks/chance.py [--states 1000000]

Processor time of one thread, the least of several runs, all in one process. Successors lie near their states, as those
of games do.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from pharos.mdp import BEST, Table, TabularMDP, random_actions, sticky_actions
from pharos.solvers import value_iteration
from pharos.solvers.fixed_point import Backup

ACTIONS, NEAR, RUNS = 4, 2000, 15
VECTORS = {2: [[0.8, 0.2], [0.5, 0.5], [2 / 3, 1 / 3]], 3: [[0.8, 0.1, 0.1], [0.5, 0.25, 0.25], [1 / 3] * 3]}


def least_seconds(run: Callable[[], object], runs: int = RUNS) -> float:
    """Processor seconds of the quickest of some runs, after one to compile."""
    run()
    seconds = []
    for _ in range(runs):
        began = time.process_time()
        run()
        seconds.append(time.process_time() - began)
    return min(seconds)


def nanoseconds(mdp: TabularMDP, rng: np.random.Generator) -> float:
    """Of a sweep of optimal values, for each state and action."""
    backup = Backup(mdp, BEST)
    x = backup.zeros()
    x[:-1] = rng.normal(size=x[:-1].shape)
    return 1e9 * least_seconds(lambda: backup.sweep(x)) / (mdp.num_states * mdp.num_actions)


def sweeps(num_states: int) -> None:
    """A line for each way of holding outcomes, with ratios to the table."""
    rng = np.random.default_rng(0)
    shape = (num_states, ACTIONS, 3)
    successors = np.clip(np.arange(num_states)[:, None, None] + rng.integers(-NEAR, NEAR, shape), 0, num_states - 1)
    rewards = rng.choice([0.0, 1.0, -1.0], shape[:2])
    codes = rng.integers(3, size=shape[:2])
    few = np.array(VECTORS[3])[codes]
    few[rng.random(shape[:2]) < 0.6] = [1.0, 0.0, 0.0]
    mdps = {
        "one outcome, a table": TabularMDP.from_arrays(successors[..., 0], rewards),
        "2 outcomes": TabularMDP.from_outcomes(successors[..., :2], np.array(VECTORS[2])[codes], rewards),
        "3 outcomes": TabularMDP.from_outcomes(successors, np.array(VECTORS[3])[codes], rewards),
        "1 or 3 outcomes, row after row": TabularMDP.from_outcomes(successors, few, rewards),
    }
    print(f"{num_states:,} states, {ACTIONS} actions; ns for each state and action (ratio to the table)")
    first: list[float] = []
    for name, mdp in mdps.items():
        line = [nanoseconds(each, rng) for each in (mdp, random_actions(mdp, 0.1), sticky_actions(mdp, 0.25))]
        first = first or line
        size = sum(array.nbytes for array in mdp.dynamics.arrays().values()) / num_states
        assert isinstance(mdp.dynamics, Table) == (name == "one outcome, a table")
        times = "  ".join(
            f"{kind} {ns:5.2f} ({ns / one:.1f})"
            for kind, ns, one in zip(("plain", "random", "sticky"), line, first, strict=True)
        )
        print(f"  {name:32} {times}  {size:.0f} bytes/state", flush=True)


def ages(num_states: int) -> None:
    """Values of a game of 1,000 steps: one pass by age, and sweeps; states in an order that sweeps do not like."""
    rng = np.random.default_rng(0)
    layer = num_states // 1000
    shape = (num_states, ACTIONS, 2)
    age = np.arange(num_states) // layer
    near = rng.integers(-layer // 2, layer // 2, shape)
    successors = (age[:, None, None] + 1) * layer + (np.arange(num_states)[:, None, None] + near) % layer
    successors[age == age.max()] = -1
    number = np.concatenate([rng.permutation(part) for part in np.array_split(np.arange(num_states), 10)])
    place = np.append(np.argsort(number), -1)
    rewards = rng.choice([0.0, 0.0, 0.0, 1.0], shape[:2])
    mdp = TabularMDP.from_outcomes(
        place[successors][number], np.broadcast_to([0.7, 0.3], shape), rewards[number], gamma=0.999
    )
    for name, each in (("one pass by age", mdp.with_age(age[number])), ("sweeps", mdp)):
        seconds = least_seconds(lambda each=each: value_iteration(each), 1)
        solution = value_iteration(each)
        print(f"  {name:32} {seconds:6.2f} s, {solution.sweeps} sweeps, error at most {solution.error_bound:.1e}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=1_000_000)
    arguments = parser.parse_args()
    sweeps(arguments.states)
    print(f"{arguments.states:,} states, {ACTIONS} actions, 2 outcomes, gamma 0.999, 1,000 ages")
    ages(arguments.states)
