"""The suite v2: tasks that are written here, with levels, values and digests that are measured before any run.

python benchmarks/benchmark_v2.py    # writes src/pharos/benchmark/suites/v2.yaml; a minute

The core is no ranking: four worlds of one to three steps, which a sound agent learns in some hundred steps.
Ladders hold all but their own quantity still. Those of estimation and memory are v1's. Pairs are one world in two ways.
"""

from dataclasses import replace

from benchmark_select import LEVELS, significant
from pharos.benchmark import BenchmarkTask, Ladder, Protocol, Suite, frozen, load_suite, write_suite
from pharos.benchmark.suite import FOLDER, PAIRS

PROTOCOL = Protocol(steps=10_000, evaluations=10)
CHOICE, FOUR = "delayed_choice", {"num_actions": 4, "cues": 4}
WAIT = {"delays": [1, 2, 3, 4, 5], "mapping_seed": 1, "bonus": 3.0}  # the second of five is worth four of any other
BASIC = {
    "basic-bandit": {"length": 1, "num_actions": 4, "cues": 1},
    "basic-sight": {"length": 1, **FOUR},
    "basic-two-steps": {"length": 2, "lag": 1, "num_actions": 4, "cues": 1},
    "basic-three-steps": {"length": 3, "lag": 2, **FOUR},
}
WORLDS = {  # seen as one_hot, and as hash
    "catch-6": ("catch", {"rows": 6, "columns": 5}),
    "grid-6": ("simple_grid", {"height": 6, "width": 6}),
    "lake-5": ("frozen_lake", {"size": 5, "seed": 1}),
    "taxi-3": ("taxi", {"size": 3}),
}
NOISY = {"length": 9, "cue_error": 0.25}
MOVING = {"length": 4, "num_actions": 3, "moving": True}
HIDDEN = {  # all is seen, and not all
    "memory": ("memory_chain", {"memory_length": 4}, ("one_hot", {}), ("one_hot", {"seen_first": ["bits"]})),
    "noise": (CHOICE, NOISY, ("vector", {}), ("vector", {"hide": ["right"]})),
    "aliasing": ("frozen_lake", {"size": 4, "seed": 2}, ("vector", {}), ("vector", {"hide": ["row"]})),
    "velocity": (CHOICE, MOVING, ("vector", {}), ("vector", {"hide": ["right"]})),
}


def main() -> None:
    v1 = load_suite("v1")
    dqn = {**v1.hyperparameters["dqn"], "learning_starts": 200, "buffer_size": 10_000}
    settings = {"dqn": dqn, "ppo": dict(v1.hyperparameters["ppo"])}
    core = tuple(frozen(BenchmarkTask(name, CHOICE, world, "one_hot"), PROTOCOL) for name, world in BASIC.items())
    names = ("axis", "unit", "quantity", "tasks", "measure")
    ladders = tuple(
        Ladder(**dict(zip(names, (axis, unit, quantity, tuple(rungs(axis, measure, tasks)), measure), strict=True)))
        for axis, unit, quantity, measure, tasks in ladders_of(v1)
    )
    write_suite(Suite("v2", PROTOCOL, core, ladders, "", settings), FOLDER / "v2.yaml")


def ladders_of(v1):
    """Yield axis, unit, quantity, measure and tasks of each ladder."""
    episodes = "log2 of the episodes that random play needs"
    for axis, cost, words in (("free", 0.0, "nothing"), ("costly", 0.2, "a fifth of the treasure")):
        sizes = [
            BenchmarkTask(
                f"sea-{axis}-{size}", "deep_sea", {"size": size, "mapping_seed": 1, "move_cost": cost}, "one_hot"
            )
            for size in (4, 6, 8, 10, 12, 16)
        ]
        yield f"exploration_{axis}", "bits", f"{episodes}; the way costs {words}", "exploration_bits", sizes
    yield of_v1(v1, "estimation")
    lags = [BenchmarkTask(f"lag-{lag}", CHOICE, {"length": 64, "lag": lag}, "one_hot") for lag in (0, 3, 7, 15, 31, 63)]
    delay = "longest delay between an action that loses something and what it loses, in episodes of 64 steps"
    yield "credit", "steps", delay, "advantage_lag", lags
    copies = [
        BenchmarkTask(f"copies-{bits}", CHOICE, {"length": 1, **FOUR, "irrelevant_bits": bits}, "one_hot")
        for bits in (0, 3, 6, 9, 12)
    ]
    yield "scale", "bits", "log2 of the copies of each state", "copies_bits", copies
    for axis, base in (("large_rewards", 10.0), ("small_rewards", 0.1)):
        units = [
            BenchmarkTask(
                f"{axis.replace('_', '-')}-{power}",
                "discounting_chain",
                WAIT,
                "one_hot",
                chance={"scale_rewards": base**-power},
            )
            for power in range(4)
        ]
        yield (
            axis,
            "decades",
            f"rewards of the same world, {axis.partition('_')[0]}r by powers of 10",
            "unit_decades",
            units,
        )
    yield of_v1(v1, "memory")
    twice = [
        BenchmarkTask(f"{name}-{view}", world, parameters, view, {"bits": 64} if view == "hash" else {})
        for name, (world, parameters) in WORLDS.items()
        for view in ("one_hot", "hash")
    ]
    yield "representation", "hash", "one world seen as one_hot, and as random words", PAIRS, twice
    partly = [
        BenchmarkTask(f"{name}-{word}", world, parameters, *view)
        for name, (world, parameters, *views) in HIDDEN.items()
        for word, view in zip(("seen", "hidden"), views, strict=True)
    ]
    yield "hidden", "hidden", "one world seen in full, and in part", PAIRS, partly


def of_v1(v1, axis):
    """A ladder of v1, without what was predicted and measured for its number of steps."""
    ladder = next(each for each in v1.ladders if each.axis == axis)
    tasks = [replace(task, predicted={}, seconds={}) for task in ladder.tasks]
    return axis, ladder.unit, ladder.quantity, ladder.measure, tasks


def rungs(axis, measure, tasks):
    """Tasks with levels, values and digests."""
    for place, task in enumerate(tasks):
        named = replace(task, axis=axis)
        level = place % 2 if measure == PAIRS else significant(LEVELS[measure](named, named.training_task(PROTOCOL)))
        print(f"{named.name}: {level:g} {named.training_task(PROTOCOL).space.num_states:,} states", flush=True)
        yield frozen(replace(named, level=float(level)), PROTOCOL)


if __name__ == "__main__":
    main()
