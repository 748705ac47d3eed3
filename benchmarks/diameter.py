"""How long does a diameter take? Beside one breadth-first search, or value iteration for every target, in the same run.

    python benchmarks/diameter.py [small | large]

Deterministic rows: seconds, and the ratio to one search from the start. Rows with chance: random actions on a lake;
seconds, and the ratio to plain value iteration for each target to the same relative accuracy, timed on 8 targets spread
over all and scaled to their number. `large` adds the spaces of millions of states.
"""

import sys
import time

import numpy as np

import pharos
from pharos.hardness.sum_sweep import Graph
from pharos.mdp import ExpandedMDP

SMALL = {
    "frozen_lake 100": ("frozen_lake", {"size": 100, "seed": 0}),
}
LARGE = {
    "breakout 24x8x3": ("breakout", {"height": 24, "columns": 8, "brick_rows": 3}),
    "frozen_lake 1000": ("frozen_lake", {"size": 1000, "seed": 0, "frozen_probability": 0.9}),
    "freeway/16x7-speed1": ("freeway/16x7-speed1", {}),
    "breakout 14x8x3": ("breakout", {"height": 14, "columns": 8, "brick_rows": 3}),
}
SAMPLE = 8


def mdp_of(name, parameters):
    return pharos.build(pharos.make(name, **parameters)).mdp()


def deterministic(label, mdp):
    graph = Graph.of(mdp, True)
    distance = np.empty(graph.num_nodes, np.int32)
    graph.search_forward(graph.pivot, distance)  # compile, and touch the memory
    began = time.perf_counter()
    graph.search_forward(graph.pivot, distance)
    search = time.perf_counter() - began
    del graph
    began = time.perf_counter()
    found = pharos.hardness.diameter(mdp)
    seconds = time.perf_counter() - began
    print(
        f"{label}, {mdp.num_states} states: {found} in {seconds:.3f} s, {found.searches} searches; one search "
        f"{search:.4f} s, "
        f"ratio {seconds / search:.1f}; {found.method}{'; ' + found.note if found.note else ''}",
        flush=True,
    )


def iterated(choices, target, tolerance=1e-6):
    """Plain value iteration for one target, until a sweep changes nothing by more than `tolerance` / 100 of a value."""
    goal = choices.underlying == target
    j = np.zeros(len(goal))
    while True:
        new = np.where(goal, 0.0, 1 + (choices.matrix @ j).reshape(len(goal), -1).min(axis=1))
        if (np.abs(new - j) <= 0.01 * tolerance * np.maximum(new, 1)).all():
            return
        j = new


def chancy(size, seed):
    lake = mdp_of("frozen_lake", {"size": size, "seed": seed})
    mdp = pharos.random_actions(lake, 0.2)
    choices = ExpandedMDP.of(mdp, True)
    targets = np.linspace(0, choices.num_targets - 1, SAMPLE).astype(int)
    began = time.perf_counter()
    for target in targets:
        iterated(choices, target)
    plain = (time.perf_counter() - began) / SAMPLE * choices.num_targets
    began = time.perf_counter()
    found = pharos.hardness.diameter(mdp)
    seconds = time.perf_counter() - began
    print(
        f"frozen_lake {size}, random actions 0.2, {mdp.num_states} states: {found} in {seconds:.3f} s, "
        f"{found.searches} targets; "
        f"value iteration for each {plain:.2f} s (from {SAMPLE} targets), {plain / seconds:.1f} times as long",
        flush=True,
    )


def main():
    cases = SMALL | (LARGE if "large" in sys.argv[1:] else {})
    tiny = pharos.TabularMDP.from_arrays(((np.arange(90) + 1) % 90)[:, None], np.zeros((90, 1)))
    pharos.hardness.diameter(tiny)  # compile
    pharos.hardness.diameter(pharos.random_actions(mdp_of("frozen_lake", {"size": 4, "seed": 0}), 0.1))
    for label, (name, parameters) in cases.items():
        deterministic(label, mdp_of(name, parameters))
    for size in (10, 20) + ((50,) if "large" in sys.argv[1:] else ()):
        chancy(size, 0)


if __name__ == "__main__":
    main()
