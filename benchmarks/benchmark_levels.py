"""The suite `levels`: four generators, 8, 64 and 512 training levels, evaluated on 100 held-out ones.

python benchmarks/benchmark_levels.py                      writes suites/levels.yaml, and prints overlaps
python benchmarks/benchmark_baselines.py --suite levels --only dqn --out DIR        trains one of its baselines

The core has the levels that an agent learns on, the ladders those that are held out; an agent learns the same in both.
A rung is harder if there are fewer training levels: log2(512 / levels).
"""

import math
from dataclasses import replace

from pharos.benchmark import BenchmarkTask, Ladder, Protocol, Suite, frozen, load_suite, write_suite
from pharos.benchmark.levels import ENVIRONMENT_NAME, levels_of, overlap
from pharos.benchmark.suite import FOLDER

PROTOCOL = Protocol(steps=150_000, evaluations=10, seeds=5)
WORLDS: dict[str, tuple[str, dict[str, object]]] = {
    "lake": ("frozen_lake", {"size": 6}),
    "door_key": ("mini_grid", {"kind": "door_key", "size": 6}),
    "rooms": ("mini_grid", {"kind": "multi_room", "size": 4, "rooms": 2}),
    "sokoban": ("sokoban", {"height": 6, "width": 6, "boxes": 1}),
}
NUMBERS = 512, 64, 8
HELD_OUT_LEVELS = 100
UNIT, QUANTITY = "halvings", "training levels, as halvings of 512"


def main() -> None:
    core, ladders = [], []
    for name, (world, options) in WORLDS.items():
        rungs = []
        for number in NUMBERS:
            parameters = {"world": world, "options": options, "train": number, "held_out": 0}
            task = BenchmarkTask(f"{name}-{number}-seen", ENVIRONMENT_NAME, parameters, "recorded")
            core.append(frozen(task, PROTOCOL))
            parameters = {**parameters, "held_out": HELD_OUT_LEVELS}
            task = replace(task, name=f"{name}-{number}-held-out", parameters=parameters, axis=name)
            rungs.append(frozen(replace(task, level=math.log2(NUMBERS[0] / number)), PROTOCOL))
            states = task.training_task(PROTOCOL).space.num_states
            shared = overlap(levels_of(**parameters))
            print(f"{task.name}: {states:,} states, overlap {shared:.3f}, V* {rungs[-1].value_optimal:.3f}", flush=True)
        ladders.append(Ladder(name, UNIT, QUANTITY, tuple(rungs)))
    quick = [f"{name}-{NUMBERS[1]}-{half}" for name in WORLDS for half in ("seen", "held-out")]
    settings = load_suite("v1").hyperparameters
    suite = Suite("levels", PROTOCOL, tuple(core), tuple(ladders), "", settings, {"tasks": quick, "seeds": 2})
    write_suite(suite, FOLDER / "levels.yaml")


if __name__ == "__main__":
    main()
