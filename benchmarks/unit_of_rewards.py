"""Which part of a DQN reacts to the unit of rewards: runs with its loss and its optimizer exchanged.

    python benchmarks/unit_of_rewards.py [--predict [--measure huber_regret]]

Prints for worlds of docs/studies/sealed-2, agents and numbers that rewards are divided by the regret of three seeds and
the deviation of a seed: the table of docs/evidence/sealed-2.md. Ten minutes of a processor. With --predict it trains
nothing and prints what `pharos predict` says of the agent in each unit, or another measure of the idealised learner:
the table of docs/evidence/network-regret.md.
"""

import argparse
from pathlib import Path

import numpy as np
from numba import njit

from pharos import study, train_many
from pharos.kernels import batched as kernels
from pharos.prediction.learners import primary_regret
from pharos.training import RunConfig

STUDY = Path(__file__).parents[1] / "docs" / "studies" / "sealed-2" / "report.yaml"
WORLDS = {
    ("Network(nodes=24", "hash"): (1, 1 / 0.03, 1 / 0.003),
    ("Workshop(jobs=9", "vector"): (1, 10, 100),
    ("Machines(machines=3", "hash"): (1, 1 / 0.03, 1 / 0.003),
    ("Dosing(drug=5", "hash"): (1 / 30, 1, 30),
    ("Errands(doors=5", "vector"): (1, 10, 100),
}
RATE = 0.1


@njit
def squared(q, q_next, q_choice, minibatch, dq, loss):
    """The gradient of the squared loss, halved; see `kernels.huber`."""
    actions, rewards, discounts = minibatch
    dq[:] = 0.0
    for i in range(q.shape[0]):
        for b in range(q.shape[1]):
            a = actions[i, b]
            target = rewards[i, b] + discounts[i, b] * q_next[i, b, np.argmax(q_choice[i, b])]
            dq[i, b, a] = (q[i, b, a] - target) / q.shape[1]


@njit
def descent(state, counts, is_active, rates, max_norms, eps):
    """A step of plain gradient descent with the same clipping; see `kernels.adam`."""
    parameters, gradients, _, _ = state
    for i in range(len(parameters)):
        if is_active[i]:
            counts[i] += 1
            norm = np.sqrt((gradients[i].astype(np.float64) ** 2).sum())
            parameters[i] -= RATE * min(1.0, max_norms[i] / (norm + 1e-6)) * gradients[i]


AGENTS = {
    "Huber loss, Adam": (kernels.huber, kernels.adam),
    "squared loss, Adam": (squared, kernels.adam),
    "Huber loss, descent": (kernels.huber, descent),
    "squared loss, descent": (squared, descent),
}


def predicted(config, unit, measure):
    """What is predicted of a run if rewards are divided by `unit`. measure: None for the predictor."""
    config = {**config, "chance": {**config["chance"], "scale_rewards": float(unit)}}
    return primary_regret(config, RunConfig.from_dict(config).task(trust=True), measure=measure).value


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--predict", action="store_true")
    parser.add_argument("--measure", help="in the place of the predictor")
    arguments = parser.parse_args()
    runs = [run for run in study.specification(STUDY, trust=True).runs if run.config["agent"] == "dqn"]
    for (world, observation), units in WORLDS.items():
        cells = (run for run in runs if world in run.cell["instance"] and run.cell["observation"] == observation)
        config = next(cells).config
        task = RunConfig.from_dict(config).task(trust=True)
        if arguments.predict:
            said = ", ".join(f"{predicted(config, unit, arguments.measure):.2f}" for unit in units)
            print(
                f"{world}), {observation}: divided by {', '.join(f'{unit:.3g}' for unit in units)}: {said}", flush=True
            )
            continue
        for agent, (loss, optimizer) in AGENTS.items():
            kernels.huber, kernels.adam = loss, optimizer
            for unit in units if agent == "Huber loss, Adam" else units[:2]:
                results = train_many(
                    "dqn",
                    task.env,
                    seeds=range(3),
                    steps=config["steps"],
                    evaluation_interval=1000,
                    hyperparameters=config["hyperparameters"],
                    observation=observation,
                    observation_options=dict(task.observation_options),
                    horizon=task.horizon_steps,
                    scale_rewards=float(unit),
                )
                regret = [np.mean([row["normalized_regret"] for row in result.curve]) for result in results]
                line = f"{np.mean(regret):.2f}, deviation {np.std(regret, ddof=1):.2f}"
                print(f"{world}), {observation}: {agent}, divided by {unit:.3g}: {line}", flush=True)


if __name__ == "__main__":
    main()
