"""Lesions: whether an axis measures what its name says, by agents that are known to lack one thing.

python benchmarks/benchmark_lesions.py --out FOLDER            run what FOLDER lacks, then print the matrix
python benchmarks/benchmark_lesions.py --out FOLDER --print    print the matrix of what is there

Whole agents are shipped baselines. A lesion is one of them with one thing changed that an axis is about: an agent that
does not hope explores less, one that believes the last reward alone is misled by noise, one with a short horizon sees
no late consequence, one without recurrence remembers nothing. Its fall on an axis is the whole agent's score less its
own, with the interval of `pharos benchmark compare`. An axis holds if its lesion falls by at least FALL on it, and by
at least TIMES what it falls by on any other axis; one that does not is not in the suite. `--suite` takes the file of
ladders that were left out, too: whole agents are then run as well.

Agents that see the number of the state do not run where memory is asked for: what is seen means nothing to them.

Of v2 an agent runs all rungs of the axes of its lesion, and of the others one or two in SAMPLE; `--seeds 3` is less.
Two axes ask for one ability twice (RELATED), so a lesion may fall on both.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from pharos import benchmark

FALL, TIMES, SEEDS = 0.2, 2.0, 5
LESIONS = {  # name: (whole baseline, axis that must fall, agent, what is changed)
    "no hope: values begin at 0, not 1": ("q_learning", "exploration", "q_learning", {"initial_q": 0.0}),
    "last reward only: learning rate 1, no averages": (
        "q_learning",
        "estimation",
        "q_learning",
        {"learning_rate": 1.0, "visits_exponent": 0.0},
    ),
    "short horizon: discount 0.5, not 0.95": ("dqn", "credit", "dqn", {"gamma": 0.5}),
    "short horizon: discount 0.5, not 0.99": ("q_learning", "credit", "q_learning", {"gamma": 0.5}),
    "no recurrence: PPO, not recurrent PPO": ("recurrent_ppo", "memory", "ppo", {}),
}
FAULTY, WINDOW = "pharos.benchmark.faults:dqn", f"{__file__}:window"
TABLE_FAILS = ("memory", "representation", "hidden")  # what is seen means nothing to a table of states
LESIONS_V2 = {  # the same, of v2
    "no hope: values begin at 0, not 1": ("q_learning", "exploration_free", "q_learning", {"initial_q": 0.0}),
    "never explores: epsilon 0": (
        "dqn",
        "exploration_costly",
        "dqn",
        {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0},
    ),
    "short horizon: discount 0.5, not 0.95": ("dqn", "credit", "dqn", {"gamma": 0.5}),
    "a table: Q-learning, not DQN": ("dqn", "scale", "q_learning", {}),
    "layers of 2 units, not 32": (FAULTY, "representation", FAULTY, {"width": 2}),
    "rewards clipped to their signs": (FAULTY, "large_rewards", FAULTY, {"fault": "rewards_clipped"}),
    "sees the last observation, not five": (WINDOW, "hidden", WINDOW, {"length": 1}),
}
RELATED = ({"exploration_free", "exploration_costly"}, {"large_rewards", "small_rewards"})
SAMPLE = {
    *("sea-free-6", "sea-costly-4", "catch-noise-0.5", "lag-7", "lag-31", "copies-6", "large-rewards-1"),
    *("small-rewards-1", "catch-6-one_hot", "catch-6-hash", "noise-seen", "noise-hidden"),
}


def window(env, steps, seed, *, length=5):
    """Q-learning on a table of the last `length` observations; its policy has them as memory."""
    rng = np.random.default_rng(seed)
    num_actions = int(env.action_space.n)
    q = defaultdict(lambda: np.zeros(num_actions))
    multipliers = np.random.default_rng(0).integers(1, 2**40, int(np.prod(env.observation_space.shape)))

    def moved(memory, observations, starts):
        rows = np.asarray(observations, np.float64).reshape(len(memory), -1)
        codes = (np.round(rows * 1000).astype(np.int64) * multipliers).sum(axis=1)
        kept = np.where(np.asarray(starts, bool)[:, None], 0, memory)
        return np.column_stack([kept[:, 1:], codes])

    class Policy:
        def __init__(self):
            self.best = {key: int(values.argmax()) for key, values in q.items()}

        def initial_state(self, n):
            return np.zeros((n, length), np.int64)

        def __call__(self, observations, state, starts):
            after = moved(state, observations, starts)
            return np.array([self.best.get(row.tobytes(), 0) for row in after]), after

    memory = moved(np.zeros((1, length), np.int64), env.reset(seed=seed)[0][None], [True])
    for step in range(steps):
        key = memory[0].tobytes()
        explores = rng.random() < max(0.1, 1 - 2 * step / steps)
        action = int(rng.integers(num_actions)) if explores else int(q[key].argmax())
        observation, reward, terminated, truncated, _ = env.step(action)
        memory = moved(memory, observation[None], [False])
        target = reward + (0.0 if terminated else 0.99 * q[memory[0].tobytes()].max())
        q[key][action] += 0.1 * (target - q[key][action])
        if terminated or truncated:
            memory = moved(memory, env.reset()[0][None], [True])
        if (step + 1) % (steps // 10) == 0:
            yield Policy()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--suite", default="v1")
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--only", help="the beginning of the name of a lesion")
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    suite = benchmark.load_suite(options.suite)
    axes = [ladder.axis for ladder in suite.ladders]
    print(f"| whole agent | lesion | {' | '.join(axes)} | verdict |\n|---|---|{'---|' * (len(axes) + 1)}")
    for name, (whole, target, agent, changed) in (LESIONS_V2 if suite.name == "v2" else LESIONS).items():
        if not name.startswith(options.only or ""):
            continue
        both = [
            results(suite, options, Path(whole).stem, whole, {}, target),
            results(suite, options, name, agent, changed, target),
        ]
        print(row(name, target, axes, benchmark.compare(*both, suite=suite)), flush=True)


def results(suite, options, name, agent, changed, target):
    """Results of an agent: shipped, or of its folder, where what is missing is run first."""
    if not changed and agent in benchmark.baselines(suite.name):
        return benchmark.read_results(f"{suite.name}/{agent}")
    folder = options.out / suite.name / name.partition(":")[0].replace(" ", "_") / Path(agent).stem
    if not options.print:
        left_out = TABLE_FAILS if agent == "q_learning" else ()
        axes = [ladder.axis for ladder in suite.ladders if ladder.axis not in left_out]
        if suite.name == "v2" and agent != "q_learning":
            axes = [*related(target), *SAMPLE]
        benchmark.run(
            agent,
            suite,
            out=folder,
            seeds=range(options.seeds),
            tasks=axes,
            name=f"{Path(agent).stem}, {name}",
            hyperparameters=changed,
            workers=options.workers,
        )
    return benchmark.read_results(folder)


def row(name, target, axes, comparison):
    """A row of the matrix: falls on each axis, and whether the axis of the lesion holds."""
    falls = {axis: each.score.interval for axis, each in comparison.axes.items()}
    others = max(fall.value for axis, fall in falls.items() if axis not in related(target))
    holds = [axis for axis in related(target) if axis in falls and falls[axis].value >= max(FALL, TIMES * others)]
    verdict = f"{', '.join(holds)} holds" if holds else f"{target} fails" if target in falls else ""
    cells = [
        f"{falls[axis].value:.2f} ({falls[axis].low:.2f} to {falls[axis].high:.2f})" if axis in falls else "-"
        for axis in axes
    ]
    return f"| {comparison.ours.partition(',')[0]} | {name} | {' | '.join(cells)} | {verdict} |"


def related(axis):
    """The axis, and the one that asks for the same ability."""
    return sorted(next((axes for axes in RELATED if axis in axes), {axis}))


if __name__ == "__main__":
    main()
