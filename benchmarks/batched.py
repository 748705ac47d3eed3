"""How fast is the batched engine beside Stable-Baselines3? Agent-steps per second of processor time of one thread.

    python benchmarks/batched.py [--instance NAME] [--rounds R] [--seconds S] [--agents dqn ppo] [--observations ...]
                                 [--frames 1 4] [--grey] [--lanes 8 4 2]

Both with the hyperparameters of pharos' table, after `learning_starts` and some updates. Rounds go through all
contestants in turn, so that a busy machine slows all alike; the ratio is the median over rounds. The last columns:
arithmetic of the networks in GFLOP/s (of images as if each were computed by itself), and its share of what a plain
product of matrices reached in the same round.
With several numbers of frames, of images, all of them are contestants of the same rounds; the ratio is each one's own.
With `--lanes` it compares these widths of lanes of small images instead, by milliseconds of a step of one run and the
ratio to the first width, and says whether parameters have the same bits in the end.
"""

import argparse
import math
import statistics
import time

import torch

from pharos.agents import hyperparameters, make_model
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.agents.batched import runs as batched_runs
from pharos.interaction import make_sb3_vec
from pharos.training import Task

RUNS = {"vector": 32, "simple_image": 8, "complex_image": 8}
STEPS = 1_000_000  # of the training that the schedules belong to


def peak() -> float:
    """FLOP/s of a product of matrices, the best of some."""
    size, best = 768, 0.0
    a, b = torch.randn(size, size), torch.randn(size, size)
    for _ in range(8):
        began = time.process_time()
        torch.mm(a, b)
        best = max(best, 2 * size**3 / (time.process_time() - began))
    return best


class Alone:
    """A model of Stable-Baselines3 as `pharos train` makes it."""

    runs = 1

    def __init__(self, agent: str, task: Task, options: dict, runs: int):
        self.model = make_model(
            agent, make_sb3_vec(task.env, options.get("n_envs", 1), seed=0, **task.interaction), options, seed=0
        )
        self.model.learn(1, reset_num_timesteps=False)

    def learn(self, steps: int) -> None:
        self.model.learn(steps, reset_num_timesteps=False)


class Together:
    """As many runs of the batched engine as one program trains."""

    def __init__(self, agent: str, task: Task, options: dict, runs: int):
        source = ObservationSource.of(task.space, task.observer.observe)
        made = [BatchRun(task.mdp, source, task.time_limit, options, STEPS, i, i) for i in range(runs)]
        self.batch, self.runs = make_batch(agent, made), runs

    def learn(self, steps: int) -> None:
        self.batch.learn([self.batch.steps + steps], lambda point: None)


def speed(contestant, seconds: float, unit: int) -> float:
    """Agent-steps per second of processor time."""
    done, began = 0, time.process_time()
    while time.process_time() - began < seconds:
        contestant.learn(unit)
        done += unit
    return done * contestant.runs / (time.process_time() - began)


def work(agent: str, options: dict, lane) -> float:
    """FLOP of an agent-step by the networks: 2 a weight and sample forwards, 4 backwards (2 in the first layer).

    Of small images, too, whose equal patches the engine computes once.
    """
    forward = first = 0.0
    for each in lane.networks.network.parameters.shapes:
        if each.name.endswith("weight"):
            pixels = math.prod(lane.inputs.table.shape[1:]) if "layers.0.0" in each.name else 1
            forward += 2 * each.size * pixels
            first = first or forward
    if agent == "ppo":
        return forward * (1 + 3 * options["n_epochs"]) - first * options["n_epochs"]
    updates = options["gradient_steps"] * options["batch_size"] / (options["train_freq"] * options.get("n_envs", 1))
    return forward + updates * ((3 if lane._remembers else 4) * forward - first)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--instance", default="frozen_lake/8x8")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--agents", nargs="+", default=["dqn", "ppo"])
    parser.add_argument("--observations", nargs="+", default=["vector", "simple_image"])
    parser.add_argument("--frames", type=int, nargs="+", default=[1], help="of images: how many are stacked")
    parser.add_argument("--grey", action="store_true", help="images of one plane for each frame")
    parser.add_argument("--lanes", type=int, nargs="+", help="widths of lanes of small images")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.lanes:
        for agent in arguments.agents:
            compare_lanes(agent, arguments.instance, arguments.lanes, arguments.rounds)
        return
    print(f"{arguments.instance}, torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, one thread")
    print(f"{'':22}{'runs':>5}{'sb3/s':>9}{'batched/s':>11}{'ratio':>7}{'lowest':>8}{'GFLOP/s':>9}{'of peak':>9}")
    for agent in arguments.agents:
        for observation in arguments.observations:
            many = arguments.frames if "image" in observation else [1]
            cases = [Case(agent, arguments.instance, observation, frames, arguments.grey) for frames in many]
            for _ in range(arguments.rounds):
                for case in cases:
                    case.rounds.append((*(speed(each, arguments.seconds, case.unit) for each in case.pair), peak()))
            for case in cases:
                print(case, flush=True)


def compare_lanes(agent: str, instance: str, widths: list[int], rounds: int) -> None:
    """Print what a step of one of eight runs takes in lanes of each width, in rounds in turn."""
    task = Task.of(instance, observation="simple_image")
    options = hyperparameters(agent, task.env.name, "simple_image")
    if agent == "dqn":
        options |= {"exploration_fraction": 1e-6, "learning_starts": 500}
    unit = options["n_envs"] * options["n_steps"] if agent == "ppo" else 160
    contestants, times = {}, {width: [] for width in widths}
    for width in widths:
        batched_runs.WIDTH_OF_SMALL_IMAGES = batched_runs.WIDTH_OF_WIDE_IMAGES = width
        contestants[width] = Together(agent, task, options, 8)
        contestants[width].learn(max(600, unit))
    for _ in range(rounds):
        for width, contestant in contestants.items():
            began = time.process_time()
            contestant.learn(unit)
            times[width].append((time.process_time() - began) / unit / contestant.runs)
    first = contestants[widths[0]].batch
    for width, contestant in contestants.items():
        ratio = statistics.median(a / b for a, b in zip(times[width], times[widths[0]], strict=True))
        same = all(
            (array == first.parameters(i)[name]).all()
            for i in range(contestant.runs)
            for name, array in contestant.batch.parameters(i).items()
        )
        milliseconds = 1e3 * statistics.median(times[width])
        print(f"{agent} {instance} lanes of {width}: {milliseconds:.3f} ms, {ratio:.2f}, same bits: {same}", flush=True)


class Case:
    """Both engines on one observation, warmed up; each of its rounds: (agent-steps/s, agent-steps/s, FLOP/s)."""

    def __init__(self, agent: str, instance: str, observation: str, frames: int, grey: bool):
        seen = {
            **({"frames": frames} if frames > 1 else {}),
            **({"grey": True} if grey and "image" in observation else {}),
        }
        task = Task.of(instance, observation=observation, observation_options=seen)
        options = hyperparameters(agent, task.env.name, observation)
        if agent == "dqn":  # both act by their networks from the first step that is timed
            options["exploration_fraction"] = 1e-6
        self.name, self.runs = f"{agent} {observation}{f' x{frames}' if frames > 1 else ''}", RUNS[observation]
        self.unit = options["n_envs"] * options["n_steps"] if agent == "ppo" else 200
        self.pair = [kind(agent, task, options, self.runs) for kind in (Alone, Together)]
        self.flop = work(agent, options, self.pair[1].batch.lanes[0])
        warm = max(2 * self.unit, options.get("learning_starts", 0) + 200)
        for contestant in self.pair:
            contestant.learn(-(-warm // self.unit) * self.unit)
        self.rounds: list[tuple[float, float, float]] = []

    def __str__(self) -> str:
        alone, together, _ = (statistics.median(part) for part in zip(*self.rounds, strict=True))
        ratios = [b / a for a, b, _ in self.rounds]
        share = statistics.median(b * self.flop / p for _, b, p in self.rounds)
        return (
            f"{self.name:22}{self.runs:5}{alone:9.0f}{together:11.0f}"
            f"{statistics.median(ratios):7.1f}{min(ratios):8.1f}{together * self.flop / 1e9:9.1f}{share:9.2f}"
        )


if __name__ == "__main__":
    main()
