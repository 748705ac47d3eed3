"""Total and average rewards beside discounted values of the same tables: seconds of a solve.

    python benchmarks/goals.py

A solve at gamma 1 without a horizon should take at most three times as long as one at gamma 0.9999. Averages are of
worlds that never end.
"""

import time

import pharos

CASES = {
    "breakout/12x8x1 respawn=false": ({"height": 12, "columns": 8, "brick_rows": 1, "respawn": False}, 0.0),
    "frozen_lake size=1000 seed=0 --random 0.1": ({"size": 1000, "seed": 0}, 0.1),
}
ENDLESS = {"endless_sea size=100 p_rand=0.1": {"size": 100, "p_rand": 0.1}, "corner_grid size=40": {"size": 40}}


def main() -> None:
    for title, parameters in ENDLESS.items():
        mdp = pharos.build(pharos.make(title.partition(" ")[0], **parameters)).mdp(gamma=0.9999)
        for solve in 2 * (pharos.value_iteration, pharos.average_reward):  # the first two compile
            began = time.perf_counter()
            result = solve(mdp)
            print(f"{title}: {solve.__name__}: {time.perf_counter() - began:.2f} s, {result}")
    for title, (parameters, random) in CASES.items():
        mdp = pharos.build(pharos.make(title.partition(" ")[0].partition("/")[0], **parameters)).mdp(gamma=0.9999)
        mdp = pharos.random_actions(mdp, random)
        for gamma in (0.9999, 1.0, 0.9999, 1.0):  # the first two compile
            began = time.perf_counter()
            solution = pharos.value_iteration(mdp.with_gamma(gamma))
            print(f"{title}: gamma {gamma}: {time.perf_counter() - began:.2f} s, {solution}")


if __name__ == "__main__":
    main()
