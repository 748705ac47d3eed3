"""Forms of an agent's kernel beside each other: which of them tells the better observation of an MDP?

python benchmarks/kernel_forms.py RUNS.parquet [...] --out FORMS.csv [--class NAME ...] [--form NAME ...] [--most N]

RUNS.parquet are packed studies (`pharos study pack`). Writes a row for each cell (instance, chance, agent and
observation): its regrets, and what the idealised learner says with each form of its kernel, or with some of them. What
is in FORMS.csv is not computed again, but regrets are those of the runs. `benchmarks/kernel_forms_table.py` makes the
tables.

With K the kernel in closed form, W the diagonal of the standard occupancy, J the Jacobian of NETWORKS random networks:

    plain        K
    deflated     K without the constant direction under W, which then has the largest eigenvalue that is left
    adam         W^-1/2 (W^1/2 K W^1/2)^1/2 W^-1/2: full-matrix Adam
    diagonal     the mean of J diag(v)^-1/2 J', v the second moments of gradients under W for errors of one size
    paced        the same, with Adam's own step: rate min(1 / largest eigenvalue, learning rate sqrt(batch) / rms error)
    rescaled     K of inputs that are divided by the root of their root mean square: Adam on the first layer alone
    layers       the kernels of the layers, each of trace 1 under W, added
    last         the kernel of the output layer alone: features of random networks
    trained      the mean of J J' after UPDATES of Adam towards the values of uniform play
    trained_diagonal    the same with diag(v)^-1/2

For PPO `policy_NAME` is the regret of policy gradients in expectation, the logits in a kernel, with one step for each
rollout, `clipped_NAME` with 16 of the clipped objective; see PolicyGradient. `time_NAME` is the logarithm of
`kernel_learning_time`.
"""

import argparse
import csv
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from pharos import study
from pharos.errors import PharosError
from pharos.hardness.representation import kernel_spectrum
from pharos.hardness.representation.kernel_operator import Exact
from pharos.hardness.representation.kernel_regret import RAREST
from pharos.hardness.representation.mean_field import WORST_GREEDY, Learner, Memory
from pharos.hardness.representation.representation import Grouped
from pharos.hardness.visitation.standard_occupancy import standard_occupancy
from pharos.observations import Network, network_inputs, observe, representation, tangent_kernel
from pharos.study.predictions import _network, _schedule
from pharos.study.values import task_of

NETWORKS, UPDATES, BATCH = 3, 300, 32
MOST = 1_000  # observations; cells of more are left out
ROLLOUT, CLIP, CLIPPED_UPDATES = 512, 0.2, 16
CELL = ("environment", "instance", "chance", "agent", "observation")
LEARNERS = {
    "dqn": (
        *("plain", "deflated", "adam", "diagonal", "paced"),
        *("rescaled", "layers", "last", "trained", "trained_diagonal"),
    ),
    "ppo": ("plain", "adam", "deflated"),
}
POLICIES = ("plain", "deflated", "adam", "diagonal", "layers", "last")
TIMES = ("plain", "deflated", "adam", "diagonal", "layers", "last", "trained")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--out", required=True)
    parser.add_argument("--class", dest="classes", action="append")
    parser.add_argument("--form", dest="forms", action="append", help="of regret_FORM alone; all forms when not given")
    parser.add_argument("--most", type=int, default=MOST, help="observations; cells of more are left out")
    given = parser.parse_args()
    torch.set_num_threads(1)
    names = [f"regret_{form}" for form in LEARNERS["dqn"]] + [f"time_{form}" for form in TIMES]
    names += [f"{kind}_{form}" for kind in ("policy", "clipped") for form in POLICIES]
    columns = ["study", *CELL, "greedy", "states", *names, "seconds"]
    out = Path(given.out)
    done = set()
    if out.exists():
        with out.open(newline="") as file:
            done = {tuple(row[name] for name in ("study", *CELL)) for row in csv.DictReader(file)}
    else:
        out.write_text(",".join(columns) + "\n")
    for file in given.runs:
        with tempfile.TemporaryDirectory() as folder:
            place, _ = study.unpack(file, Path(folder) / "study")
            opened = study.specification(place / "study.yaml")
            regrets = study.outcomes(study.table(place), study.curves(place)).set_index(list(CELL))["greedy"]
        for run in opened.runs:
            cell = _cell(run)
            key = (opened.name, *cell)
            if not cell or key in done or cell not in regrets.index or (given.classes and cell[0] not in given.classes):
                continue
            done.add(key)
            began = time.process_time()
            try:
                found = Cell(run, given.most).predictions(given.forms)
            except PharosError as error:
                print(f"{', '.join(cell)}: {error}", file=sys.stderr)
                continue
            row = dict(zip(("study", *CELL), key, strict=True)) | found
            row |= {"greedy": regrets[cell], "seconds": time.process_time() - began}
            with out.open("a", newline="") as appended:
                csv.DictWriter(appended, columns, lineterminator="\n").writerow(
                    {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
                )
            print(f"{', '.join(cell)}: {row['seconds']:.0f} s", file=sys.stderr, flush=True)
        _of_runs(out, opened.name, regrets)


def _of_runs(out, name, regrets):
    """Give the rows of a study the regrets of these runs."""
    with out.open(newline="") as file:
        reader = csv.DictReader(file)
        columns, rows = reader.fieldnames, list(reader)
    for row in rows:
        cell = tuple(row[column] for column in CELL)
        if row["study"] == name and cell in regrets.index:
            row["greedy"] = f"{regrets[cell]:.6g}"
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _cell(run):
    return () if run.config["observation"] == "index" else tuple(run.cell[name] for name in CELL)


class Cell:
    """An MDP with an observation and a network: what all forms need."""

    def __init__(self, run, most=MOST):
        self.config, self.agent = run.config, run.config["agent"]
        task = task_of(run.config)
        name, initialisation = _network(run.config, task)
        self.network = Network.of(name, initialisation)
        options = dict(task.observation_options)
        seen = representation(task.space, task.observation, name, initialisation=initialisation, **options)
        self.schedule = _schedule(run.config)
        episode = task.time_limit
        self.learner = Learner(task.mdp, self.schedule, episode)
        everything = self.learner.numbers[self.learner.states]
        self.observations = Grouped(seen.classes, everything)
        if len(self.observations) > most:
            raise PharosError(f"{len(self.observations)} observations; at most {most} are looked at")
        standard = standard_occupancy(task.mdp, self.schedule.gamma, episode)
        weights = self.observations.sums(standard.states[everything])
        self.weights = np.maximum(weights, RAREST * weights.max())
        q = self.observations.sums(standard.states[everything, None] * standard.q[everything]) / self.weights[:, None]
        self.q = q
        observer = observe(task.env, task.observation, state_space=task.space, **options)
        self.inputs = network_inputs(observer, task.space.states(self.observations.representatives))
        self.closed = tangent_kernel(self.network, self.inputs)
        self._kernels = {}

    def predictions(self, forms=None):
        """Name -> number."""
        row = {"states": len(self.learner.states)}
        for form in forms or LEARNERS[self.agent]:
            learner = self.learner
            if form == "paced":
                learner = Paced(self.learner, self.config["hyperparameters"])
            operator = Exact(lambda *_, form=form: self.kernel("diagonal" if form == "paced" else form), self.rows)
            row[f"regret_{form}"] = learner.curve(self.observations, operator).mean_greedy
        if forms:
            return row
        if self.agent == "ppo":
            gamma = self.config["hyperparameters"].get("gamma", 0.99)
            for form in POLICIES:
                for name, updates in (("policy", 1), ("clipped", CLIPPED_UPDATES)):
                    twin = PolicyGradient(self.learner, gamma, updates)
                    row[f"{name}_{form}"] = twin.regret(self.observations, self.kernel(form), self.config["steps"])
        share = self.weights / self.weights.sum()
        advantage = self.q - self.q.max(axis=1, keepdims=True)
        for form in TIMES:
            values, energy = kernel_spectrum._spectrum(self.kernel(form).astype(float), advantage, share)
            row[f"time_{form}"] = float(np.log(kernel_spectrum._time(values / values.sum(), energy)))
        return row

    @property
    def rows(self):
        return np.arange(len(self.observations))

    def kernel(self, form):
        """(C, C) float32 of a form."""
        if form not in self._kernels:
            self._kernels[form] = np.ascontiguousarray(getattr(self, f"_{form}")(), np.float32)
        return self._kernels[form]

    def _plain(self):
        return self.closed

    def _deflated(self):
        share, kernel = self.weights / self.weights.sum(), self.closed.astype(float)
        mean = kernel @ share
        centred = kernel - mean[:, None] - mean[None] + share @ mean
        root = np.sqrt(share)
        return centred + np.linalg.eigvalsh(root[:, None] * centred * root)[-1]

    def _adam(self):
        operator = Exact(lambda *_: self.closed, self.rows)
        operator.preconditioned(self.weights)
        return operator.matrix

    def _rescaled(self):
        axes = (2, 3) if self.inputs.ndim == 4 else ()
        square = (self.inputs**2).mean(axis=axes) if axes else self.inputs**2
        scale = np.maximum(self.weights / self.weights.sum() @ square, 1e-12) ** -0.25
        scale = np.where(scale < 500, scale, 0.0)  # pixels that are never lit
        return tangent_kernel(self.network, (self.inputs * scale[(..., *[None] * len(axes))]).astype(np.float32))

    def _diagonal(self):
        return self._mean(0, rescaled=True)

    def _trained(self):
        return self._mean(UPDATES)

    def _trained_diagonal(self):
        return self._mean(UPDATES, rescaled=True)

    def _last(self):
        return self._mean(0, layers=slice(-1, None))

    def _layers(self):
        total = 0.0
        for layer in range(len(self.network.convolutions) + len(self.network.hidden) + 1):
            kernel = self._mean(0, layers=slice(layer, layer + 1))
            total = total + kernel / (self.weights @ np.diag(kernel))
        return total

    def _mean(self, updates, *, rescaled=False, layers=slice(None)):
        """The mean over random networks of J J', or of J diag(v)^-1/2 J'; J is kept."""
        total = 0.0
        for number in range(NETWORKS):
            for jacobian in self._jacobians(updates, number)[layers]:
                if rescaled:
                    share = torch.as_tensor(self.weights / self.weights.sum(), dtype=torch.float32)
                    moments = share @ jacobian**2
                    jacobian = jacobian * torch.where(moments > 0, moments, 1.0) ** -0.25
                total = total + (jacobian @ jacobian.T).numpy().astype(float)
        return total / NETWORKS

    def _jacobians(self, updates, number):
        """(C, P) of each layer."""
        key = f"jacobians {updates} {number}"
        if key not in self._kernels:
            torch.manual_seed(number)
            net = built(self.network, self.inputs.shape[1:], self.q.shape[1])
            x = torch.as_tensor(self.inputs)
            if updates:
                _train(net, x, self._uniform_values(), self.weights / self.weights.sum(), updates, number)
            self._kernels[key] = jacobians(net, x, number % self.q.shape[1])
        return self._kernels[key]

    def _uniform_values(self):
        """(C, A): of uniform play, with the learner's discount."""
        mdp, gamma = self.learner.mdp, self.schedule.gamma
        memory = Memory(mdp, self.learner.states)
        policy = np.full((len(self.learner.states), mdp.num_actions), 1 / mdp.num_actions)
        memory.play(self.learner.visits(policy), policy, 1)
        v = np.zeros(len(policy))
        for _ in range(200):
            q, visits = memory.targets(v, gamma)
            v = q.mean(axis=1)
        weights = self.observations.sums(visits)
        return self.observations.sums(visits * q) / np.maximum(weights, 1e-300)


class Paced(Learner):
    """With Adam's own step, where that is smaller than the largest stable one."""

    def __init__(self, learner, hyperparameters):
        vars(self).update(vars(learner))
        self.rate = hyperparameters["learning_rate"] * np.sqrt(hyperparameters["batch_size"])

    def learnt(self, apply, weights, error, vector):
        largest = 1.05 * apply.largest_eigenvalue(weights.max(axis=1, keepdims=True), vector)
        rms = float(np.sqrt((weights * error**2).sum()))
        if not largest > 0 or not rms > 0:
            return np.zeros_like(error)
        return apply.descended(weights, error, min(1 / largest, self.rate / rms), self.schedule.gradient_steps)


class PolicyGradient:
    """PPO in expectation: for each rollout the logits z of the policy go up the gradient of the (clipped) objective,

        `updates` times:  z += eta K d objective / d z,   eta such that at first log pi changes by CLIP / sqrt(updates)

    in the mean over visits. Visits and advantages are those of the policy at the rollout, exactly.
    """

    def __init__(self, learner, gamma, updates):
        self.learner, self.gamma, self.updates = learner, gamma, updates

    def regret(self, observations, kernel, steps):
        """The mean over rollouts of the regret of the policy."""
        learner = self.learner
        logits = np.zeros((len(observations), learner.mdp.num_actions))
        v, regrets = np.zeros(len(learner.states)), []
        for _ in range(0, steps, ROLLOUT):
            policy = _softmax(logits)[observations.groups]
            memory = Memory(learner.mdp, learner.states)
            played, _ = memory.play(learner.visits(policy), policy, 1)
            regrets.append(learner.regret(played if learner.is_return else learner.value(policy)))
            for _ in range(60):
                q, visits = memory.targets(v, self.gamma)
                v = (policy * q).sum(axis=1)
            logits = self._updated(logits, policy, visits / visits.sum(), q - v[:, None], observations, kernel)
        return float(np.minimum(regrets, WORST_GREEDY).mean())

    def _updated(self, logits, policy, visits, advantage, observations, kernel):
        eta = None
        for _ in range(self.updates):
            now = _softmax(logits)[observations.groups]
            ratio = now / np.maximum(policy, 1e-30)
            is_clipped = np.where(advantage > 0, ratio > 1 + CLIP, ratio < 1 - CLIP)
            pull = np.where(is_clipped, 0.0, visits * ratio * advantage)
            step = kernel @ observations.sums(pull - now * pull.sum(axis=1, keepdims=True))
            if eta is None:
                change = step[observations.groups]
                change = change - (now * change).sum(axis=1, keepdims=True)
                size = (visits * np.abs(change)).sum()
                eta = CLIP / np.sqrt(self.updates) / size if size > 1e-300 else 0.0
            logits = logits + eta * step
            logits = np.maximum(logits - logits.max(axis=1, keepdims=True), -30.0)
        return logits


def _softmax(logits):
    grown = np.exp(logits - logits.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)


def built(network, shape, actions):
    """A network of PyTorch with `actions` outputs, as agents have it; its first layer gets inputs of a shape."""
    from torch import nn

    parts, channels, size = [], shape[0], shape[1:]
    for layer in network.convolutions:
        parts += [nn.Conv2d(channels, layer.filters, layer.size, layer.stride, layer.padding), nn.ReLU()]
        channels = layer.filters
        size = tuple((side + 2 * layer.padding - layer.size) // layer.stride + 1 for side in size)
    inputs = int(np.prod((channels, *size)))
    parts.append(nn.Flatten())
    for number, units in enumerate(network.hidden):
        parts += [nn.Linear(inputs, units), nn.Tanh() if network.tanh and number else nn.ReLU()]
        inputs = units
    parts.append(nn.Linear(inputs, actions))
    if network.initialisation == "sb3":
        for part in parts[:-1]:
            if hasattr(part, "weight"):
                nn.init.orthogonal_(part.weight, 2**0.5)
                nn.init.zeros_(part.bias)
        nn.init.orthogonal_(parts[-1].weight, 0.01)  # of a policy
        nn.init.zeros_(parts[-1].bias)
    return nn.Sequential(*parts)


def jacobians(net, x, output):
    """(C, P) of one output by the weights and biases of each layer."""
    parameters = {name: value.detach() for name, value in net.named_parameters()}

    def of(values, one):
        return torch.func.functional_call(net, values, (one[None],))[0, output]

    found = torch.func.vmap(torch.func.grad(of), in_dims=(None, 0), chunk_size=256)(parameters, x)
    blocks = [each.flatten(1) for each in found.values()]
    blocks = [torch.cat(pair, dim=1) for pair in zip(blocks[::2], blocks[1::2], strict=True)]
    blocks[-1] = blocks[-1][:, blocks[-1].abs().sum(dim=0) > 0]  # other outputs have weights of their own
    return blocks


def _train(net, x, targets, weights, updates, seed):
    """Adam on minibatches drawn by weights (C,)."""
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3)
    goal = torch.as_tensor(targets, dtype=torch.float32)
    for rows in rng.choice(len(weights), (updates, BATCH), p=weights):
        loss = ((net(x[rows]) - goal[rows]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


if __name__ == "__main__":
    main()
