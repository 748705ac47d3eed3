"""How fast are the same calls in two checkouts? Each in fresh processes in turn, with everything compiled on disk.

    python benchmarks/checkouts.py OTHER [--rounds 4] [--only startup build solve evaluate train batched]

OTHER is the folder of another checkout, such as `git worktree add ../before 55ae4af`. Prints for each call the seconds
of the processor here, and the ratio to those of OTHER, as medians of pairs; the first round compiles and is left out.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]


def timed(results, name, call):
    """Note the processor time of a call."""
    began = time.process_time()
    call()
    results[name] = time.process_time() - began


def startup(results):
    """What a fresh process has taken so far, with the import of pharos."""
    import pharos  # noqa: F401

    results["import pharos"] = time.process_time()


def build(results):
    """The first build of a process, and the median of later ones."""
    import pharos

    for name in ("frozen_lake/8x8", "breakout/12x8x3", "freeway/16x7-speed1"):
        env, again = pharos.make(name), []
        for k in range(4):
            with tempfile.TemporaryDirectory() as folder:
                one = {}
                timed(one, name, lambda env=env, folder=folder: pharos.build(env, Path(folder) / "space"))
            if k:
                again.append(one[name])
            else:
                results[f"build {name}, first of its class"] = one[name]
        results[f"build {name}, again"] = statistics.median(again)


def solve(results):
    """Optimal values, plain and under sticky actions."""
    import pharos

    pharos.value_iteration(pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.99))
    for name in ("breakout/12x8x3", "freeway/16x7-speed1"):
        mdp = pharos.build(pharos.make(name)).mdp(gamma=0.99)
        sticky = pharos.sticky_actions(mdp, 0.25)
        timed(results, f"solve {name}", lambda mdp=mdp: pharos.value_iteration(mdp))
        timed(results, f"solve {name}, sticky", lambda mdp=sticky: pharos.value_iteration(mdp))


def evaluate(results):
    """Values of drawn networks that see vectors, exact on Freeway, estimated on Breakout: ten of one task; there
    also of the table of discounted optimal actions, ten times."""
    import numpy as np

    import pharos
    from pharos.training import Task, evaluate_agent

    def network(seed, size, actions, is_greedy):
        rng = np.random.default_rng(seed)
        first, last = rng.normal(size=(size, 64)) / size**0.5, rng.normal(size=(64, actions))

        def policy(observations):
            scores = np.tanh(np.asarray(observations, float) @ first) @ last
            if is_greedy:
                return scores.argmax(axis=1)
            grown = np.exp(scores - scores.max(axis=1, keepdims=True))
            return grown / grown.sum(axis=1, keepdims=True)

        return policy

    for name, chance in (
        ("freeway/20x5-speed1", {"random": 0.1}),
        ("freeway/16x7-speed1", {"sticky": 0.25}),
        ("breakout/12x8x3", {"random": 0.1}),
    ):
        task = Task.of(name, observation="vector", **chance)
        size, actions = task.observer.observe.space.shape[0], task.mdp.num_actions
        for kind, is_greedy in (("greedy", True), ("random", False)):
            policies = [network(seed, size, actions, is_greedy) for seed in range(11)]
            evaluate_agent(policies.pop(), task, again=True)
            timed(
                results,
                f"values of {kind} policies, {name}, {chance}",
                lambda policies=policies, task=task: [evaluate_agent(policy, task, again=True) for policy in policies],
            )
    table = pharos.value_iteration(task.space.mdp(gamma=0.99)).policy
    evaluate_agent(table, task, again=True)
    timed(
        results,
        f"values of a table, {name}, {chance}",
        lambda: [evaluate_agent(table, task, again=True) for _ in range(10)],
    )


def train(results):
    """Two million steps of Q-learning."""
    import pharos

    setting = {"agent": "q_learning", "environment": "frozen_lake/8x8"}
    pharos.train(**setting, steps=1000, evaluation_interval=1000)
    timed(
        results,
        "Q-learning, 2 million steps",
        lambda: pharos.train(**setting, steps=2_000_000, evaluation_interval=200_000),
    )


def batched(results):
    """Runs of the batched engine."""
    import pharos

    for agent, observation, runs, steps in (
        ("dqn", "vector", 32, 2500),
        ("ppo", "vector", 32, 10_000),
        ("dqn", "simple_image", 8, 1500),
        ("ppo", "simple_image", 8, 5000),
    ):
        setting = {"observation": observation, "steps": steps, "evaluation_interval": steps, "seeds": range(runs)}
        given = {"learning_starts": 200} if agent == "dqn" else {}
        timed(
            results,
            f"batched {agent}, {observation}",
            lambda agent=agent, setting=setting, given=given: pharos.train_many(
                agent, "frozen_lake/8x8", hyperparameters=given, **setting
            ),
        )
    name, each = "freeway/16x7-speed1", 6_000
    seen = {"observation": "simple_image", "steps": 3_000, "evaluation_interval": 3_000, "seeds": range(8)}
    given = {"learning_starts": 200}
    timed(
        results,
        f"batched dqn, simple_image, {name}",
        lambda: pharos.train_many("dqn", name, hyperparameters=given, **seen),
    )
    setting = {"sticky": 0.25, "steps": 2 * each, "evaluation_interval": each, "seeds": range(8)}
    pharos.train_many("dqn", name, **setting | {"steps": 500, "evaluation_interval": 500, "seeds": range(2)})
    timed(
        results,
        f"batched dqn, vector, {name}, sticky, evaluated every {each} steps",
        lambda: pharos.train_many("dqn", name, **setting),
    )


KINDS = {each.__name__: each for each in (startup, build, solve, evaluate, train, batched)}


def measured(checkout, kind, caches):
    """Seconds of each call of a kind, in a process of its own."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    paths = {"PYTHONPATH": str(checkout / "src"), "PHAROS_CACHE_DIR": str(caches[checkout])}
    command = [sys.executable, __file__, "--measure", kind, str(checkout)]
    end = subprocess.run(command, env=os.environ | threads | paths, stdout=subprocess.PIPE, check=True)
    return json.loads(end.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--measure", choices=KINDS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        results = {}
        KINDS[arguments.measure](results)
        print(json.dumps(results))
        return
    both = HERE, arguments.other.resolve()
    seconds = {checkout: defaultdict(list) for checkout in both}
    with tempfile.TemporaryDirectory() as here, tempfile.TemporaryDirectory() as there:
        caches = dict(zip(both, (here, there), strict=True))
        for number in range(arguments.rounds):
            for kind in arguments.only:
                for checkout in both[:: 1 if number % 2 else -1]:
                    for name, value in measured(checkout, kind, caches).items():
                        if number:
                            seconds[checkout][name].append(value)
    print("| call | seconds | ratio | least and most |\n|---|---|---|---|")
    for name, ours in seconds[HERE].items():
        ratios = [a / b for a, b in zip(ours, seconds[both[1]][name], strict=True)]
        ends = f"{min(ratios):.2f} to {max(ratios):.2f}"
        print(f"| {name} | {statistics.median(ours):.3f} | {statistics.median(ratios):.2f} | {ends} |")


if __name__ == "__main__":
    main()
