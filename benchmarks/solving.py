"""How fast is a sweep, and how fast is a whole solution? Beside sweeps in C, compiled and measured in the same run.

    python benchmarks/solving.py [INSTANCE]

Prints ns for each state and action of one plain sweep and of one under sticky actions, of pharos and of C in turn, on
one and on two threads, by the clock and by processor time (where the machine has other work, compare the latter), with
the median of their ratios: to C for any number of actions, and to C for this one. Beside them the limit, measured in
the same way: reading the values that a sweep must read, and nothing else; and the memory's bandwidth by a triad. Then
the seconds to a proven error of 1e-6 at gamma 0.99: plain, random actions, sticky actions.
"""

import ctypes
import resource
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
THREADS, REPEATS = 2, 7


POINTER, DOUBLE, LONG = ctypes.c_void_p, ctypes.c_double, ctypes.c_int64


def library(name: str, num_actions: int, folder: Path):
    """The functions of c/NAME.c, compiled for this number of actions."""
    source, target = Path(__file__).with_name("c") / f"{name}.c", folder / f"{name}.so"
    flags = ["-O3", "-march=native", f"-DACTIONS={num_actions}", "-shared", "-fPIC"]
    subprocess.run(["gcc", *flags, str(source), "-o", str(target)], check=True)
    return ctypes.CDLL(str(target))


def function(found, name: str, *types, result=None):
    call = getattr(found, name)
    call.argtypes, call.restype = types, result
    return call


def processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def in_turn(calls: dict, threads: int, num_states: int) -> dict:
    """{name: N times (seconds by the clock, of processors)} of call(start, stop) on all states, after a first turn."""
    cuts = [num_states * i // threads for i in range(threads + 1)]
    times: dict = {name: [] for name in calls}
    with ThreadPoolExecutor(threads) as pool:
        for turn in range(REPEATS + 1):
            for name, call in calls.items():
                used, began = processor_seconds(), time.perf_counter()
                list(pool.map(call, cuts[:-1], cuts[1:]))
                if turn:
                    times[name].append((time.perf_counter() - began, processor_seconds() - used))
    return times


def print_sweeps(times: dict, pairs: int, own: str) -> None:
    """ns for each state and action, and ratios of our own to the others."""
    for name, runs in times.items():
        clock, processor = (statistics.median(run[k] for run in runs) / pairs * 1e9 for k in range(2))
        line = f"  {name:40} {clock:7.3f} ns by the clock, {processor:7.3f} ns of processors"
        if name != own:
            both = list(zip(times[own], runs, strict=True))
            clock, processor = (statistics.median(a[k] / b[k] for a, b in both) for k in range(2))
            line += f"; {own} takes {clock:.2f} and {processor:.2f} times that"
        print(line, flush=True)


def sweeps(mdp, folder: Path) -> None:
    """One sweep, plain and sticky, beside C and beside memory."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    next_states = np.array(mdp.next_states, np.int32)
    rewards = mdp.rewards.astype(np.float32)
    table, palette = mdp.reward_table.table, mdp.reward_table.palette
    v = np.random.default_rng(0).random(num_states + 1)
    v[-1] = 0
    out, actions = np.empty_like(v), (0,) * num_actions
    by_action, out_by_action = (np.repeat(each[:, None], num_actions, axis=1) for each in (v, out))
    code = library("sweep", num_actions, folder)
    memory = library("bandwidth", num_actions, folder)
    of_any = function(code, "sweep", POINTER, POINTER, DOUBLE, POINTER, POINTER, LONG, LONG, LONG)
    of_these = function(code, "sweep_unrolled", POINTER, POINTER, DOUBLE, POINTER, POINTER, LONG, LONG)
    sticky = function(code, "sticky_sweep", POINTER, POINTER, DOUBLE, DOUBLE, POINTER, POINTER, LONG, LONG)
    gather = function(memory, "gather", POINTER, POINTER, LONG, LONG, result=DOUBLE)
    triad = function(memory, "triad", POINTER, POINTER, POINTER, LONG, LONG)
    at = {name: array.ctypes.data for name, array in locals().items() if isinstance(array, np.ndarray)}
    given = (at["next_states"], at["rewards"], 0.99)
    ours = (next_states, table, palette, 0.99)
    plain = {
        "pharos": lambda *part: bellman.optimal_backup(*ours, 0.0, 1.0, v, out, actions, np.array([part])),
        "C, any number of actions": lambda *part: of_any(*given, at["v"], at["out"], *part, num_actions),
        "C, this number of actions": lambda *part: of_these(*given, at["v"], at["out"], *part),
        "reading the values alone": lambda start, stop: gather(
            at["next_states"], at["v"], start * num_actions, stop * num_actions
        ),
    }
    values, results = at["by_action"], at["out_by_action"]
    weights = (0.75, 0.25, 0.0)
    by_previous = {
        "pharos, sticky": lambda *part: bellman.sticky_backup(
            *ours, weights, 1.0, by_action, out_by_action, actions, np.empty(num_actions), np.array([part])
        ),
        "C, sticky": lambda *part: sticky(*given, 0.25, values, results, *part),
    }
    for threads in (1, THREADS):
        print(f"{threads} thread(s), for each state and action")
        found = in_turn(plain | by_previous, threads, num_states)
        print_sweeps({name: found[name] for name in plain}, num_states * num_actions, "pharos")
        print_sweeps({name: found[name] for name in by_previous}, num_states * num_actions, "pharos, sticky")
        moved = in_turn({"triad": lambda *part: triad(at["v"], at["v"], at["out"], *part)}, threads, num_states)[
            "triad"
        ]
        seconds = statistics.median(run[0] for run in moved)
        print(f"  triad: {24 * num_states / seconds / 1e9:.1f} GB/s by the clock (16 bytes read, 8 written an entry)")


def main() -> None:
    mdp = pharos.build(pharos.make(INSTANCE)).mdp(gamma=0.99)
    print(f"{INSTANCE}: {mdp.num_states:,} states x {mdp.num_actions} actions")
    with tempfile.TemporaryDirectory() as folder:
        sweeps(mdp, Path(folder))

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
