"""How long do the effective horizon and its relatives take, and in how much memory?

    python benchmarks/horizon.py [small | large]

`small`: BRIDGE's KeyCorridor (168 states, T = 100) with all that is published of it, and its tight bound, each beside
its limit in seconds as the ratio of the time taken; the compiled analysis beside the vectorized one on Freeway.
`large`: a Freeway of 1.0 million states with T = 500 in a process of its own, with its peak memory, and the stationary
variant on a Breakout of 2.4 million states.
"""

import resource
import subprocess
import sys
import time
from pathlib import Path

import pharos
from pharos import hardness, importers
from pharos.hardness.effective_horizon import OPTIMAL_TIE, LargeHorizon, NodeHorizon, horizon_fields
from pharos.mdp import sticky_actions

CORRIDOR = Path(__file__).parents[1] / "tests" / "data" / "bridge" / "key-corridor-s3r1.npz"


def timed(label, function, limit=None):
    function()  # compile, and touch the memory
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    median = sorted(seconds)[1]
    print(f"{label}: {median:.3f} s" + (f", {median / limit:.3f} of {limit} s" if limit else ""), flush=True)
    return median, result


def small():
    mdp = importers.bridge(CORRIDOR, horizon=100)
    sticky = sticky_actions(mdp, 0.25)
    timed(
        "KeyCorridor, all of it but the tight bound",
        lambda: (hardness.effective_horizon(mdp), hardness.covering(mdp), hardness.effective_horizon(sticky)),
        10,
    )
    for methods in (hardness.gorp_bound.__kwdefaults__["methods"], ("exact", "bernstein")):
        _, found = timed(
            f"KeyCorridor, tight bound by {', '.join(methods)}",
            lambda methods=methods: hardness.gorp_bound(mdp, methods=methods),
            60,
        )
        print(f"  {found}")
    lake = pharos.build(pharos.make("frozen_lake", size=40, seed=0)).mdp(gamma=1.0)
    slow, _ = timed(
        f"lake of {lake.num_states} states, T = 200, vectorized",
        lambda: horizon_fields(NodeHorizon.of_steps(lake, 200)),
    )
    fast, _ = timed(
        f"lake of {lake.num_states} states, T = 200, compiled",
        lambda: horizon_fields(LargeHorizon(lake, 200, OPTIMAL_TIE)),
    )
    print(f"  compiled {slow / fast:.1f} times as fast")


def large():
    for name, gamma, steps in (("freeway/16x7-speed1", 1.0, 500), ("breakout/12x8x1", 0.99, None)):
        code = (
            "import resource, time, pharos\n"
            f"mdp = pharos.build(pharos.make({name!r})).mdp(gamma={gamma})\n"
            "before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()\n"
            + (
                f"found = pharos.hardness.effective_horizon(mdp, horizon={steps})\n"
                if steps
                else "found = pharos.hardness.stationary_effective_horizon(mdp)\n"
            )
            + "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
            "print(f'{mdp.num_states} states: {found} in {time.perf_counter() - began:.1f} s, peak {peak / 2**20:.2f} "
            "GiB')"
        )
        print(f"{name}, " + (f"T = {steps}" if steps else "stationary"), end=", ", flush=True)
        subprocess.run([sys.executable, "-c", code], check=True)


if __name__ == "__main__":
    {"small": small, "large": large}[sys.argv[1] if len(sys.argv) > 1 else "small"]()
    print(f"peak memory of this process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
