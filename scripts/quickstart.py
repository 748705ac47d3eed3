"""What pharos does, in a few commands: `make quickstart` runs this. Each command is printed before it runs."""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path("quickstart")
STUDY = "scripts/quickstart.yaml"
INSTANCE = "breakout height=12 columns=8"
STEPS = (
    ("Enumerate the reachable states of a Breakout of 12 x 8 cells, as a tabular MDP on disk.", f"build {INSTANCE}"),
    ("Measure how hard it is; all values are exact, or proven intervals.", f"hardness {INSTANCE}"),
    (
        "Solve it, and draw 200 steps of the optimal policy.",
        f"render {INSTANCE} --steps 200 --out {FOLDER}/breakout.gif",
    ),
    (
        "Draw what an agent sees when it is given an Atari-like image.",
        f"render {INSTANCE} --observation complex_image --steps 60 --out {FOLDER}/breakout-complex.png",
    ),
    (
        "Train tabular Q-learning on a lake with random actions, and measure the exact regret of what it has learnt.",
        f"train frozen_lake/8x8 --agent q_learning --random 0.1 --steps 300000 --out {FOLDER}/q-learning",
    ),
    (
        "Run a small study: DQN and Q-learning on three instances, two kinds of chance, two observations, two seeds.",
        f"study run {STUDY} --out {FOLDER}/study",
    ),
    (
        "Read it: hardness joined to regret, linear models, each number beside the paper's.",
        f"study report {STUDY} --out {FOLDER}/study",
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
        f"\nDone in {time.perf_counter() - began:.0f} s; pictures, {FOLDER}/q-learning/regret.png and the study's "
        f"report are in {FOLDER}/.\n"
        f"Ask for another instance by its parameters, `.venv/bin/pharos hardness breakout height=12 columns=10`, or "
        f"by its name in\n"
        f"`.venv/bin/pharos list`; for a larger study, `.venv/bin/pharos study run quick`."
    )


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(f"quickstart: `{shlex.join(error.cmd[2:])}` failed with exit code {error.returncode}; see above")
