"""What pharos does, in a few commands: `make quickstart` runs this. Each command is printed before it runs."""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path("quickstart")
INSTANCE = "breakout height=12 columns=10"
STEPS = (
    ("Enumerate the reachable states of a Breakout of 12 x 10 cells, as a tabular MDP on disk.", f"build {INSTANCE}"),
    ("Measure how hard it is; all values are exact, or proven intervals.", f"hardness {INSTANCE}"),
    (
        "Solve it, and draw 200 steps of the optimal policy.",
        f"render {INSTANCE} --steps 200 --out {FOLDER}/breakout.gif",
    ),
    (
        "Draw what an agent sees when it is given an Atari-like image.",
        f"render {INSTANCE} --observation complex_image --steps 60 --out {FOLDER}/breakout-complex.png",
    ),
)


def main() -> None:
    """Run the steps; stop at the first that fails."""
    FOLDER.mkdir(exist_ok=True)
    began = time.perf_counter()
    for what, command in STEPS:
        print(f"\n# {what}\n$ pharos {command}", flush=True)
        subprocess.run([sys.executable, "-m", "pharos", *shlex.split(command)], check=True, env=os.environ)
    print(
        f"\nDone in {time.perf_counter() - began:.0f} s; pictures are in {FOLDER}/. Ask for another instance by its parameters,\n"
        f"`.venv/bin/pharos hardness breakout height=14 columns=8 brick_rows=3`, or by its name in `.venv/bin/pharos list`."
    )


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(f"quickstart: `{shlex.join(error.cmd[2:])}` failed with exit code {error.returncode}; see above")
