"""How fast is a sweep, and how fast is a whole solution? Beside a sweep in C, compiled and measured in the same run.

    python benchmarks/solving.py [INSTANCE]

Prints ns for each state and action of one plain sweep (pharos on one and two threads, C on the same), and the seconds
to a proven error of 1e-6 at gamma 0.99: plain, random actions, sticky actions.
"""

import ctypes
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import pharos
from pharos.kernels import bellman

INSTANCE = sys.argv[1] if len(sys.argv) > 1 else "breakout/12x10x1"
THREADS = 2


def c_sweep():
    folder = Path(tempfile.mkdtemp())
    source = Path(__file__).with_name("c") / "sweep.c"
    command = ["gcc", "-O3", "-march=native", "-shared", "-fPIC", str(source), "-o", str(folder / "sweep.so")]
    subprocess.run(command, check=True)
    function = ctypes.CDLL(str(folder / "sweep.so")).sweep
    pointer, double, long = ctypes.c_void_p, ctypes.c_double, ctypes.c_int64
    function.argtypes = [pointer, pointer, double, pointer, pointer, long, long, long]
    function.restype = None
    return function


def seconds(call, repeats: int = 7) -> float:
    """Median of the runs after the first."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def shared(call, num_states: int, threads: int):
    """call(start, stop) on `threads` threads."""
    cuts = [num_states * i // threads for i in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        yield lambda: list(pool.map(call, cuts[:-1], cuts[1:]))


def main() -> None:
    mdp = pharos.build(pharos.make(INSTANCE)).mdp(gamma=0.99)
    pairs = mdp.num_states * mdp.num_actions
    print(f"{INSTANCE}: {mdp.num_states:,} states x {mdp.num_actions} actions")

    next_states = np.array(mdp.next_states)
    rewards = mdp.rewards.astype(np.float32)
    table, palette = mdp.reward_table.table, mdp.reward_table.palette
    v = np.random.default_rng(0).random(mdp.num_states + 1)
    v[-1] = 0
    out = np.empty_like(v)
    function = c_sweep()

    def in_c(start, stop):
        function(
            next_states.ctypes.data,
            rewards.ctypes.data,
            0.99,
            v.ctypes.data,
            out.ctypes.data,
            start,
            stop,
            mdp.num_actions,
        )

    def in_pharos(start, stop):
        bellman.optimal_block(next_states, table, palette, 0.99, 0.0, 1.0, v, out, (0,) * mdp.num_actions, start, stop)

    for threads in (1, THREADS):
        found = {}
        for name, call in (("C", in_c), ("pharos", in_pharos)):
            for run in shared(call, mdp.num_states, threads):
                found[name] = seconds(run) / pairs * 1e9
        ratio = found["pharos"] / found["C"]
        print(
            f"plain sweep, {threads} thread(s): pharos {found['pharos']:.3f} ns, C {found['C']:.3f} ns for each state "
            f"and action; "
            f"ratio {ratio:.2f}"
        )

    pharos.value_iteration(mdp, 1.0)  # compile
    pharos.value_iteration(pharos.sticky_actions(mdp, 0.25), 1.0)
    plain = None
    for name, variant in (
        ("plain", mdp),
        ("random 0.1", pharos.random_actions(mdp, 0.1)),
        ("sticky 0.25", pharos.sticky_actions(mdp, 0.25)),
    ):
        solution = pharos.value_iteration(variant, 1e-6)
        plain = plain or solution.seconds
        print(
            f"{name}: {solution.seconds:.2f} s ({solution.seconds / plain:.2f} x plain), {solution.sweeps} sweeps, "
            f"proven error {solution.error_bound:.1e}, value at the start {solution.value_at_start:.6f}"
        )


if __name__ == "__main__":
    main()
