"""How fast is a state space built? Beside the paper's own method, and a program written by hand in C, all in one run.

    python benchmarks/building.py [--quick] [--pairs] [INSTANCE ...]

Prints states/s (files written, medians after a first run), and ratios: to Algorithm 1 in plain Python with RocksDB (the
paper's method, once, on the same instance, of which it expands at most the first 3 million states, and with --quick the
first 60 thousand, where it is faster: its table grows), to C with the same rules (the counts must agree), and for rules
that are interpreted. Memory is the growth of the resident set of a process of its own.

C and pharos alternate, and each ratio is the median over such pairs: of the time by the clock, and of processor time,
which other work on the machine moves less. Three programs in C: with a table that doubles, as that of pharos does; the
same with its files on the disk at the end, as those of pharos are; and one with a table of its final size from the
start, which nobody knows beforehand. --pairs leaves the rest out.
"""

import importlib.util
import inspect
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections import deque
from pathlib import Path

import pharos

HERE = Path(__file__).parent
REPEATS = 3 if "--quick" in sys.argv else 5
PYTHON_STATES = 60_000 if "--quick" in sys.argv else 3_000_000
# instance -> options of the C program, and the logarithm of its table's size
GAMES = {
    "breakout/12x8x1": (["-DBREAKOUT", "-DHEIGHT=12", "-DCOLUMNS=8", "-DROWS=2", "-DEXTRA=0"], 23),
    "breakout/12x10x1": (["-DBREAKOUT", "-DHEIGHT=12", "-DCOLUMNS=10", "-DROWS=2", "-DEXTRA=0"], 26),
    "freeway/16x7-speed1": (["-DFREEWAY", "-DCARS=16", "-DLENGTH=7", "-DSPEED=1"], 21),
    "freeway/25x13-speed2": (["-DFREEWAY", "-DCARS=25", "-DLENGTH=13", "-DSPEED=2"], 23),
}


def paper(env, folder, limit):
    """Algorithm 1 with RocksDB for the visited set and flat files for the rest, on `limit` states; states/s."""
    import numpy as np
    from rocksdict import Options, Rdict

    options = Options(raw_mode=True)
    options.create_if_missing(True)
    visited = Rdict(str(folder / "visited"), options=options)
    successors = np.memmap(folder / "successors", np.int32, "w+", shape=(limit * 2, env.num_actions))
    began = time.perf_counter()
    start = tuple(env.initial_state())
    visited[bytes(start)] = (0).to_bytes(4, "little")
    queue, count, expanded = deque([(0, start)]), 1, 0
    while queue and expanded < limit:
        number, state = queue.popleft()
        expanded += 1
        ended = env.is_terminal(state)
        for action in range(env.num_actions):
            following = state if ended else env.next_state(state, action)
            key = bytes(following)
            found = visited.get(key)
            if found is None:
                visited[key] = count.to_bytes(4, "little")
                queue.append((count, following))
                successors[number, action] = count
                count += 1
            else:
                successors[number, action] = int.from_bytes(found, "little")
    seconds = time.perf_counter() - began
    visited.close()
    return expanded / seconds


PROGRAMS = {"table doubles": [], "and files synchronised": ["-DSYNC"], "table of final size": ["-DFINAL_SIZE"]}
WORKERS = {"one thread": 1, "all processors": None}


def processor_seconds() -> float:
    """Of this process, all its threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def built(env, workers):
    """(states, seconds by the clock, of processors) of pharos, files included."""
    with tempfile.TemporaryDirectory() as folder:
        used, began = processor_seconds(), time.perf_counter()
        space = pharos.build(env, Path(folder) / "space", workers=workers, progress=False)
        return space.num_states, time.perf_counter() - began, processor_seconds() - used


def built_by_hand(program, log2):
    """The same of the C program."""
    with tempfile.TemporaryDirectory() as folder:
        printed = subprocess.run([str(program), str(log2), folder], check=True, capture_output=True, text=True).stdout
        states, _, _, seconds, processor = printed.split()
        return int(states), float(seconds), float(processor)


def side_by_side(name):
    """(states, {way: (N, 2) seconds by the clock and of processors}), all ways in turn, N times after a first."""
    options, log2 = GAMES[name]
    env = pharos.make(name)
    with tempfile.TemporaryDirectory() as folder:
        source = HERE / "c" / "build.c"
        for i, flags in enumerate(PROGRAMS.values()):
            command = ["gcc", "-O3", "-march=native", *options, *flags, str(source), "-o", f"{folder}/{i}"]
            subprocess.run(command, check=True)
        seconds, counts = {}, set()
        for turn in range(REPEATS + 1):
            runs = {f"C, {way}": built_by_hand(Path(folder) / str(i), log2) for i, way in enumerate(PROGRAMS)}
            runs |= {f"pharos, {way}": built(env, workers) for way, workers in WORKERS.items()}
            counts |= {run[0] for run in runs.values()}
            if turn:
                for way, run in runs.items():
                    seconds.setdefault(way, []).append(run[1:])
    assert len(counts) == 1, f"{name}: pharos and C count {sorted(counts)} states"
    return counts.pop(), seconds


def print_pairs(seconds):
    """Medians of each way, and of the ratios of pharos to C."""
    for way, runs in seconds.items():
        clock, processor = (statistics.median(run[k] for run in runs) for k in range(2))
        print(f"  {way:30} {clock:7.3f} s by the clock, {processor:7.3f} s of processors", flush=True)
    for own in (way for way in seconds if way.startswith("pharos")):
        for other in (way for way in seconds if way.startswith("C")):
            pairs = list(zip(seconds[own], seconds[other], strict=True))
            clock, processor = (statistics.median(a[k] / b[k] for a, b in pairs) for k in range(2))
            print(f"  {own} / {other}: {clock:.2f} by the clock, {processor:.2f} of processors", flush=True)


MEMORY = """
import json, sys, tempfile, pharos
from pathlib import Path

def status(name):
    return int(next(line for line in open("/proc/self/status") if line.startswith(name)).split()[1]) * 1024

env = pharos.make(sys.argv[1])
with tempfile.TemporaryDirectory() as folder:
    kinds = {"breakout": {"height": 6, "columns": 3}, "freeway": {"num_cars": 2, "lane_length": 3}}
    pharos.build(pharos.make(env.name, **kinds[env.name]), Path(folder) / "warm")
    open("/proc/self/clear_refs", "w").write("5")  # the peak starts again from what is resident now
    before = status("VmRSS")
    states = pharos.build(env, Path(folder) / "space").num_states
print(json.dumps({"bytes": status("VmHWM") - before, "states": states}))
"""


def memory(name):
    """Bytes a state by which the peak resident set grows."""
    found = json.loads(
        subprocess.run([sys.executable, "-c", MEMORY, name], check=True, capture_output=True, text=True).stdout
    )
    return found["bytes"] / found["states"]


OPAQUE = "        id(self)  # Numba knows no id()\n"


def opaque_class(env):
    """The class with the same rules, of which one calls what Numba cannot compile."""
    cls = type(env)
    source = inspect.getsource(sys.modules[cls.__module__])
    head = "    def transition(self, state, action, out):\n"
    assert source.count(head) == 1
    source = source.replace(head, head + OPAQUE).replace(f'name = "{env.name}"', f'name = "opaque_{env.name}"')
    name = f"opaque_{env.name}"
    path = Path(tempfile.mkdtemp()) / f"{name}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return getattr(module, cls.__name__)


def interpreted(env):
    """(states, states/s of pharos, of the paper's method) with rules that Numba cannot compile; medians after a first
    run."""
    options = (
        {"height": 12, "columns": 6} if env.name == "breakout" else {"num_cars": 8, "car_speeds": (1, 2, 3, 4, 5, 7)}
    )
    slow, rates, references = opaque_class(env)(**options), [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that they are interpreted
        for _ in range(4):
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                space = pharos.build(slow, Path(folder) / "space")
                rates.append(space.num_states / (time.perf_counter() - began))
            with tempfile.TemporaryDirectory() as folder:
                references.append(paper(slow, Path(folder), min(PYTHON_STATES, space.num_states)))
    return space.num_states, statistics.median(rates[1:]), statistics.median(references[1:])


def main() -> None:
    """Measure and print."""
    for name in [name for name in sys.argv[1:] if name in GAMES] or GAMES:
        states, seconds = side_by_side(name)
        print(f"{name}: {states:,} states")
        print_pairs(seconds)
        if "--pairs" in sys.argv:
            continue
        rate = states / statistics.median(run[0] for run in seconds["pharos, all processors"])
        env = pharos.make(name)
        with tempfile.TemporaryDirectory() as folder:
            python_rate = paper(env, Path(folder), min(PYTHON_STATES, states))
        print(
            f"  pharos {rate / 1e6:.2f} M states/s, paper's method {python_rate / 1e3:.1f} k; ratio to the paper's "
            f"method {rate / python_rate:.0f}, {memory(name):.1f} bytes of memory a state",
            flush=True,
        )
    if "--pairs" in sys.argv:
        return
    for name in ("breakout", "freeway"):
        states, rate, reference = interpreted(pharos.make(name))
        print(
            f"{name}, interpreted rules: {states:,} states; {rate / 1e3:.0f} k states/s, paper's method on the same "
            f"instance "
            f"{reference / 1e3:.1f} k; ratio {rate / reference:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
