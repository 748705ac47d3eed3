"""Which part of a DQN reacts to the unit of rewards: runs with its loss and its optimizer exchanged.

    python benchmarks/unit_of_rewards.py [--predict [--measure huber_regret] | --networks]

Prints for worlds of docs/studies/sealed-2, agents and numbers that rewards are divided by the regret of three seeds and
the deviation of a seed: the table of docs/evidence/sealed-2.md. Ten minutes of a processor. With --predict it trains
nothing and prints what `pharos predict` says of the agent in each unit, or another measure of the idealised learner:
the table of docs/evidence/network-regret.md. With --networks it prints for one DQN and one idealised network in each
unit of workshop what becomes of the last hidden units and of Adam's mean squared gradient: the table after that.
"""

import argparse
import functools
from pathlib import Path

import numpy as np
from numba import njit

from pharos import hardness, study, train_many
from pharos.agents.batched.dqn import DQNLane
from pharos.hardness.representation.network_regret import IdealisedNetwork
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
SHARES = 0.1, 0.25, 0.5, 1.0


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


def predicted(config, unit, measure=None):
    """What is predicted of a run if rewards are divided by `unit`. measure: None for the predictor."""
    config = {**config, "chance": {**config["chance"], "scale_rewards": float(unit)}}
    return primary_regret(config, RunConfig.from_dict(config).task(trust=True), measure=measure).value


def print_networks(config, task, units):
    """Steps, mean of |h|^2, share of hidden units that no state wakes, and root of the sum of Adam's mean squares."""
    looks, copy, settle, report = [], DQNLane.copy_to_targets, IdealisedNetwork.settle, hardness.report

    def copy_and_look(lane, runs):
        copy(lane, runs)
        lane._all_target_scores(task.mdp.num_states)
        hidden, squares = lane.networks.network.stack._inputs[-1][0].numpy(), lane.networks.squares[0].numpy()
        looks.append((np.square(hidden).sum(1).mean(), (hidden.max(0) == 0).mean(), np.sqrt(squares.sum())))

    def settle_and_look(network):
        settle(network)
        looks.append((np.diag(network.net.last).mean() - 1, np.nan, np.sqrt(network.net.squares[:2].sum())))

    DQNLane.copy_to_targets, IdealisedNetwork.settle = copy_and_look, settle_and_look
    hardness.report = functools.partial(report, keep=False)
    hardness.NETWORK_WALKS = 1
    for unit in units:
        for name, learn in (("a DQN", trained), ("idealised", predicted)):
            looks.clear()
            learn(config, unit)
            for share in SHARES:
                words = ", ".join(f"{number:.2g}" for number in looks[int(share * (len(looks) - 1))])
                print(f"divided by {unit:.3g}: {name} after {share:.0%} of the copies: {words}", flush=True)


def trained(config, unit, seeds=range(1)):
    """Runs with rewards divided by `unit`."""
    task = RunConfig.from_dict(config).task(trust=True)
    return train_many(
        "dqn",
        task.env,
        seeds=seeds,
        steps=config["steps"],
        evaluation_interval=1000,
        hyperparameters=config["hyperparameters"],
        observation=config["observation"],
        observation_options=dict(task.observation_options),
        horizon=task.horizon_steps,
        scale_rewards=float(unit),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--predict", action="store_true")
    parser.add_argument("--measure", help="in the place of the predictor")
    parser.add_argument("--networks", action="store_true")
    arguments = parser.parse_args()
    runs = [run for run in study.specification(STUDY, trust=True).runs if run.config["agent"] == "dqn"]
    for (world, observation), units in WORLDS.items():
        cells = (run for run in runs if world in run.cell["instance"] and run.cell["observation"] == observation)
        config = next(cells).config
        task = RunConfig.from_dict(config).task(trust=True)
        if arguments.networks:
            if "Workshop" in world:
                print_networks(config, task, units)
            continue
        if arguments.predict:
            said = ", ".join(f"{predicted(config, unit, arguments.measure):.2f}" for unit in units)
            print(
                f"{world}), {observation}: divided by {', '.join(f'{unit:.3g}' for unit in units)}: {said}", flush=True
            )
            continue
        for agent, (loss, optimizer) in AGENTS.items():
            kernels.huber, kernels.adam = loss, optimizer
            for unit in units if agent == "Huber loss, Adam" else units[:2]:
                results = trained(config, unit, range(3))
                regret = [np.mean([row["normalized_regret"] for row in result.curve]) for result in results]
                line = f"{np.mean(regret):.2f}, deviation {np.std(regret, ddof=1):.2f}"
                print(f"{world}), {observation}: {agent}, divided by {unit:.3g}: {line}", flush=True)


if __name__ == "__main__":
    main()
