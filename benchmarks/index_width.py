"""What do indices of 40 bits cost? The same instance with indices of 32, 40 and 64 bits, in turn.

    python benchmarks/index_width.py [INSTANCE] [--turns 9] [--builds 3]

Prints bytes a state and ns a state of processor time (medians; one thread): a plain sweep, one under sticky actions, a
breadth-first search forward and one backward by its reversed graph, one pass of a search by sweeps; of 40 and 64 bits
the ratio of the medians to that of 32 bits. All three arrays are in memory. Then the seconds of processor time of
building with successors of 32 and of 40 bits from the first state on, and of opening and checking the files.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

import pharos
from pharos.hardness.diameter import LeanGraph
from pharos.hardness.sum_sweep import Graph
from pharos.mdp import BEST, BellmanEquation, Table, sticky_actions
from pharos.state_space import search
from pharos.system.arrays import PackedIndices


def sweeps(mdp, dynamics):
    """() -> one sweep of values, of 0 at first, in place."""
    equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, BEST)
    x = np.zeros((mdp.num_states + 1, mdp.width))
    return lambda: dynamics.sweep(equation, x)


def searches(mdp, table):
    """{name: () -> distances from the start, or to it}."""
    start = int(mdp.start_states[0])
    graph = Graph(table, mdp.terminal, start, start)
    lean = LeanGraph(graph, np.int16)
    distance, short = np.empty(graph.num_nodes, graph.dtype), np.empty(graph.num_nodes, np.int16)
    return {
        "search forward": lambda: graph.search_forward(start, distance),
        "search backward": lambda: graph.search_backward(start, distance),
        "search by sweeps, whole": lambda: lean.search_forward(start, short),
    }


def seconds_of(call) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def in_turn(calls, turns):
    """{name: median of the seconds}, after a first turn."""
    times = {name: [] for name in calls}
    for turn in range(turns + 1):
        for name, call in calls.items():
            seconds = seconds_of(call)
            times[name] += [seconds] * (turn > 0)
    return {name: statistics.median(each) for name, each in times.items()}


def built(env, folder, bits):
    search.INT32_STATES = 0 if bits == 40 else 2**31 - 1
    return pharos.build(env, folder, progress=False, workers=1)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("instance", nargs="?", default="breakout/12x8x1")
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--builds", type=int, default=3)
    options = parser.parse_args()
    env = pharos.make(options.instance)
    with tempfile.TemporaryDirectory(dir=".") as scratch:
        root = Path(scratch)
        space = built(env, root / "32", 32)
        mdp = space.mdp(0.99)
        sticky, size = sticky_actions(mdp, 0.25), space.num_states
        tables = {32: np.array(space.successors), 40: PackedIndices.of(space.successors)}
        tables[64] = tables[32].astype(np.int64)
        print(f"{options.instance}: {size} states; ns a state, and the ratio to 32 bits")
        print("bytes of successors a state:", {bits: table.nbytes // size for bits, table in tables.items()})
        kinds = {bits: searches(mdp, table) for bits, table in tables.items()}
        for bits, table in tables.items():
            kinds[bits] |= {"sweep": sweeps(mdp, Table(table)), "sticky sweep": sweeps(sticky, Table(table))}
        for kind in ("sweep", "sticky sweep", *list(kinds[32])[:3]):
            found = in_turn({bits: calls[kind] for bits, calls in kinds.items()}, options.turns)
            shown = (f"{bits}: {s / size * 1e9:.2f} ({s / found[32]:.2f})" for bits, s in found.items())
            print(f"{kind:24}", "  ".join(shown), flush=True)
        turns = iter(range(10**6))
        calls = {bits: lambda bits=bits: built(env, root / f"{bits}-{next(turns)}", bits) for bits in (32, 40)}
        found = in_turn(calls, options.builds)
        print("build, s:", {bits: round(s, 2) for bits, s in found.items()}, f"ratio {found[40] / found[32]:.2f}")
        wide = built(env, root / "40", 40)
        found = in_turn(
            {bits: lambda f=f: pharos.load(f).successors for bits, f in ((32, space.folder), (40, wide.folder))},
            options.turns,
        )
        print(
            "open and check, s:", {bits: round(s, 3) for bits, s in found.items()}, f"ratio {found[40] / found[32]:.2f}"
        )


if __name__ == "__main__":
    main()
