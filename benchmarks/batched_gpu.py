"""How fast is the batched engine on a GPU? Agent-steps a second, and the share of the GPU's peak.

    python benchmarks/batched_gpu.py [--instances NAME ...] [--runs 256 1024 4096] [--seconds S] [--agents dqn ppo]

With the hyperparameters of pharos' table, after `learning_starts` and some updates. First it is checked, on the
device, that runs learn what they learn on the processor, that the same batch has the same bits twice, and whether a
run's bits depend on how many others are there. The peak is that of a product of matrices in single precision (no TF32),
which the engine computes in.
"""

import argparse
import time

import numpy as np
import torch

from batched import work
from pharos.agents import hyperparameters
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.training import Task

STEPS = 1_000_000  # of the training that the schedules belong to


def peak() -> float:
    """FLOP/s of a product of matrices on the device, the best of some."""
    size, best = 8192, 0.0
    a, b = (torch.randn(size, size, device="cuda") for _ in range(2))
    for _ in range(5):
        torch.cuda.synchronize()
        began = time.perf_counter()
        torch.mm(a, b)
        torch.cuda.synchronize()
        best = max(best, 2 * size**3 / (time.perf_counter() - began))
    return best


def runs_of(tasks: list[Task], options: dict, number: int, steps: int = STEPS) -> list[BatchRun]:
    """`number` runs, dealt out over the tasks in turn."""
    sources = [ObservationSource.of(task.space, task.observer.observe) for task in tasks]
    pairs = [(tasks[i % len(tasks)], sources[i % len(tasks)]) for i in range(number)]
    return [BatchRun(task.mdp, source, task.time_limit, options, steps, i, i) for i, (task, source) in enumerate(pairs)]


def options_of(agent: str, task: Task, observation: str) -> dict:
    options = hyperparameters(agent, task.env.name, observation)
    if agent == "dqn":  # acts by its network from the first step that is timed
        options["exploration_fraction"] = 1e-6
    return options


def outcome(batch, i: int) -> list[np.ndarray]:
    return [*batch.parameters(i).values(), batch.returns[i]]


def check(agent: str, tasks: list[Task], options: dict) -> None:
    """The device beside the processor, itself, and other numbers of runs."""
    unit = options["n_envs"] * options["n_steps"] if agent == "ppo" else 4
    few = options | ({"learning_starts": 40} if agent == "dqn" else {})
    steps = 5 * unit if agent == "ppo" else 200
    batches = {}
    for name, number, device in (("cpu", 8, "cpu"), ("8", 8, "cuda"), ("again", 8, "cuda"), ("40", 40, "cuda"),
                                 ("100", 100, "cuda"), ("200", 200, "cuda")):  # fmt: skip
        batches[name] = make_batch(agent, runs_of(tasks, few, number, steps), device=device)
        batches[name].learn([steps], lambda point: None)
    for name in ("cpu", "again", "40", "100", "200"):
        pairs = [
            (a, b) for i in range(8) for a, b in zip(outcome(batches["8"], i), outcome(batches[name], i), strict=True)
        ]
        furthest = max(float(np.abs(a - b).max()) for a, b in pairs)
        equal = all(np.array_equal(a, b) for a, b in pairs)
        print(f"  {agent}: 8 runs there and {name}: equal {equal}, furthest apart {furthest:.1e}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--instances", nargs="+", default=["frozen_lake/8x8"], help="with as many actions each")
    parser.add_argument("--runs", type=int, nargs="+", default=[256, 1024, 4096])
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--agents", nargs="+", default=["dqn", "ppo"])
    parser.add_argument("--observations", nargs="+", default=["vector", "simple_image"])
    parser.add_argument("--check", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--profile", action="store_true", help="what the processor and the device do in some steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    most = peak()
    device = f"torch {torch.__version__}, {torch.cuda.get_device_name()}"
    print(f"{', '.join(arguments.instances)}, {device}, a product: {most / 1e12:.1f} TFLOP/s", flush=True)
    for agent in arguments.agents:
        for observation in arguments.observations:
            tasks = [Task.of(name, observation=observation) for name in arguments.instances]
            options = options_of(agent, tasks[0], observation)
            if arguments.check:
                check(agent, tasks, options)
            unit = options["n_envs"] * options["n_steps"] if agent == "ppo" else 100
            for number in arguments.runs:
                began = time.perf_counter()
                batch = make_batch(agent, runs_of(tasks, options, number), device="cuda")
                made = time.perf_counter() - began
                flop = work(agent, options, batch.lanes[0])
                began = time.perf_counter()
                warm = max(3 * unit, options.get("learning_starts", 0) + 200)
                batch.learn([warm], lambda point: None)
                warmed = time.perf_counter() - began
                done, began = 0, time.perf_counter()
                while time.perf_counter() - began < arguments.seconds:
                    batch.learn([batch.steps + unit], lambda point: None)
                    torch.cuda.synchronize()
                    done += unit
                speed = done * number / (time.perf_counter() - began)
                print(
                    f"{agent} {observation:14}{number:6} runs: {speed:12,.0f} agent-steps/s, "
                    f"{speed * flop / 1e12:6.2f} TFLOP/s, {speed * flop / most:5.1%} of peak (batch {made:.1f} s, "
                    f"warm-up {warmed:.1f} s, {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB)",
                    flush=True,
                )
                if arguments.profile:
                    show(batch, unit)
                del batch
                torch.cuda.empty_cache()


def show(batch, unit: int) -> None:
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as record:
        batch.learn([batch.steps + unit], lambda point: None)
    print(record.key_averages().table(sort_by="cuda_time_total", row_limit=18, max_name_column_width=60))
    import cProfile
    import pstats

    profiler = cProfile.Profile()
    profiler.runcall(batch.learn, [batch.steps + unit], lambda point: None)
    pstats.Stats(profiler).sort_stats("tottime").print_stats(14)


if __name__ == "__main__":
    main()
