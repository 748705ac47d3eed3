"""What does a build cost whose table of states is on disk?

    python benchmarks/out_of_core.py [MEMORY ...] [--instance NAME_OR_PARAMETERS]

Builds an instance (breakout/12x10x1, 21 million states) with all memory, and with each MEMORY (in MiB; 1024, 128 and
32), each in a process of its own. Prints seconds, their ratio to those with all memory, the most memory of its own that
the process held, and whether the files are the same, byte for byte.
"""

import argparse
import filecmp
import subprocess
import sys
import tempfile
from pathlib import Path

CODE = """
import sys, threading, time
import pharos
name, *parameters = sys.argv[1].split()
env = pharos.make(name, **{key: int(value) for key, value in (each.split("=") for each in parameters)})
memory = int(sys.argv[3]) << 20 or None
pharos.build(pharos.make("breakout", height=7, columns=5), sys.argv[2] + "-small", memory=1 << 24)  # compile
fields, most, stop = ("RssAnon", "RssFile"), {}, threading.Event()

def watch():
    while not stop.wait(0.05):
        for line in open("/proc/self/status"):
            if line.startswith(fields):
                most[line[:7]] = max(most.get(line[:7], 0), int(line.split()[1]))

thread = threading.Thread(target=watch)
thread.start()
began = time.perf_counter()
space = pharos.build(env, sys.argv[2], memory=memory)
seconds = time.perf_counter() - began
stop.set()
thread.join()
print(space.num_states, seconds, most["RssAnon"] / 1024, most["RssFile"] / 1024)
"""


def measured(instance: str, folder: Path, memory: int) -> tuple[float, str]:
    """Seconds, and a line of text."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, instance, str(folder), str(memory)], check=True, stdout=subprocess.PIPE, text=True
    )
    states, seconds, anonymous, mapped = (float(each) for each in done.stdout.split())
    text = f"{seconds:.1f} s, {states / seconds / 1e6:.2f} M states/s, "
    text += f"{anonymous:.0f} MiB of its own, {mapped:.0f} MiB of files"
    return seconds, text


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("memory", nargs="*", type=int, default=[1024, 128, 32])
    parser.add_argument("--instance", default="breakout/12x10x1")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=".") as scratch:
        root = Path(scratch)
        usual, text = measured(options.instance, root / "all", 0)
        print(f"{options.instance}: all memory: {text}", flush=True)
        for memory in options.memory:
            folder = root / str(memory)
            seconds, text = measured(options.instance, folder, memory)
            names = [path.name for path in (root / "all").iterdir()]
            same = filecmp.cmpfiles(root / "all", folder, names, shallow=False)[0]
            print(
                f"{memory} MiB: {text}; {seconds / usual:.2f} times as long; same files: {len(same) == len(names)}",
                flush=True,
            )
            for path in folder.iterdir():
                path.unlink()


if __name__ == "__main__":
    main()
