"""Values near gamma = 1: policy iteration where it pays, beside sweeps alone, in one run.

    python benchmarks/near_gamma_1.py [--limit SECONDS]

Processor time to the tolerance; sweeps alone stop at the limit (120 s), with the bound that they have proven by then.
"""

import argparse
import time

import pharos
from pharos.errors import PrecisionError
from pharos.solvers.policy_iteration import PolicyIteration

CASES = [  # instance, parameters, tolerance at gamma 0.9999 and at 0.999999
    ("breakout/12x8x1", {}, (1e-6, 1e-3)),
    ("frozen_lake", {"size": 300, "seed": 0, "slippery": True}, (1e-6, 1e-6)),
]


class TimeIsUp(Exception):
    """Sweeps alone took longer than the limit."""


def line(mdp, tolerance: float, limit: float) -> str:
    bounds: list[tuple[int, float]] = [(0, float("inf"))]
    began = time.process_time()

    def progress(sweeps: int, bound: float) -> None:
        bounds.append((sweeps, bound))
        if time.process_time() - began > limit:
            raise TimeIsUp

    try:
        pharos.value_iteration(mdp, tolerance, progress=progress)
        end = "proven"
    except TimeIsUp:
        end = "stopped"
    except PrecisionError as error:
        end = str(error)
    sweeps, bound = bounds[-1]
    return f"{time.process_time() - began:8.2f} s, {sweeps:6} sweeps, bound {bound:.1e}, {end}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--limit", type=float, default=120.0)
    limit = parser.parse_args().limit
    worth = PolicyIteration.is_worth_it
    for name, parameters, tolerances in CASES:
        space = pharos.build(pharos.make(name, **parameters))
        for policy_iteration in (True, False):  # compile
            PolicyIteration.is_worth_it = worth if policy_iteration else lambda *_: False
            line(space.mdp(gamma=0.9999), 1.0, limit)
        for gamma, tolerance in zip((0.9999, 0.999999), tolerances, strict=True):
            mdp = space.mdp(gamma=gamma)
            print(f"{name} {parameters}: {mdp.num_states:,} states, gamma {gamma}, tolerance {tolerance}")
            for ways in ("policy iteration", "sweeps alone"):
                PolicyIteration.is_worth_it = worth if ways == "policy iteration" else lambda *_: False
                print(f"  {ways:16} {line(mdp, tolerance, limit)}", flush=True)
    PolicyIteration.is_worth_it = worth


if __name__ == "__main__":
    main()
