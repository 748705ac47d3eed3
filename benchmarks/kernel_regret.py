"""How long measures of representations take: kernels, kernel_regret, spectra. Processor time, of all threads.

python benchmarks/kernel_regret.py [--large] [NAME ...]

NAME is an environment, default: a Breakout of 1,658 states and, with --large, a Catch of 19,764. Prints a row of a
Markdown table for each.
"""

import argparse
import time

import pharos
from pharos import hardness
from pharos.observations import representation

SMALL = ("breakout", {"height": 7, "columns": 4, "brick_rows": 1})
LARGE = ("catch", {"rows": 28, "columns": 27})


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--horizon", type=int, default=100)
    given = parser.parse_args()
    chosen = [(name, {}) for name in given.names] or [SMALL, *([LARGE] if given.large else [])]
    measure(pharos.make("simple_grid", height=3, width=3), "simple_image", "cnn16", given.horizon)  # compiles
    print("| instance | network | states | kernel_regret (with table) | learning time | processor s | wall s |")
    print("|---|---|---|---|---|---|---|")
    for name, parameters in chosen:
        env = pharos.make(name, **parameters)
        for observation, network in (("vector", "mlp128x2"), ("simple_image", "cnn16")):
            print(measure(env, observation, network, given.horizon), flush=True)


def measure(env, observation, network, horizon):
    """A row."""
    space = pharos.build(env, progress=False)
    mdp, seen = space.mdp(gamma=1.0).with_horizon(horizon), representation(space, observation, network)
    found, seconds = [], []
    for function in (hardness.kernel_regret, hardness.kernel_learning_time):
        began, wall = time.process_time(), time.perf_counter()
        found.append(function(mdp, seen))
        seconds.append((time.process_time() - began, time.perf_counter() - wall))
    words = " + ".join(f"{each[0]:.1f}" for each in seconds), " + ".join(f"{each[1]:.1f}" for each in seconds)
    regret = f"{found[0]}" + (f" ({found[0].note})" if found[0].note else "")
    return f"| {env} | {network} | {space.num_states:,} | {regret} | {found[1]} | {words[0]} | {words[1]} |"


if __name__ == "__main__":
    main()
