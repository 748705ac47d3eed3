"""Forms of the idealised PPO beside each other: what each says of runs that have been made.

python benchmarks/policy_forms.py STUDY.yaml RUNS.parquet [STUDY.yaml RUNS.parquet ...] --out FORMS.csv
    [--form NAME ...] [--most N]

RUNS.parquet are packed studies (`pharos study pack`) with the PPO cells of STUDY.yaml. Writes a row for each cell: its
regret, and for each form the mean regret over rollouts of the most probable actions, that of the policy by episodes
(_played) and by rollouts (_evaluated). What is in FORMS.csv is not computed again. Prints the table.

    plain       `kernel_policy_regret`: no clipping, advantages of standard deviation 1
    sampled     advantages divided by the standard deviation of sampled ones, as PPO's are: with the variance of returns
    clipped     PPO's clipping, `Rollouts(clip_range=0.2)`
    clipped_sampled     both
    careful     clipped, with a sixteenth of the step
    bounded     log-probabilities kept within the range at each step, in the place of the objective's clipping
"""

import argparse
import csv
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import study
from pharos.errors import PharosError
from pharos.hardness import Schedule
from pharos.hardness.representation.kernel_operator import Exact
from pharos.hardness.representation.policy_regret import (
    MOST_BACKUPS,
    RETURNS,
    SPAN,
    PolicyLearner,
    softmax,
    standardised,
)
from pharos.hardness.representation.representation import Grouped
from pharos.observations import representation
from pharos.solvers import value_iteration
from pharos.study.predictions import _network, _rollouts
from pharos.study.values import task_of

FORMS = ("plain", "sampled", "clipped", "clipped_sampled", "careful", "bounded")
KINDS = ("", "_played", "_evaluated")
CELL = ("environment", "instance", "chance", "agent", "observation")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", metavar="FILE")
    parser.add_argument("--out", required=True)
    parser.add_argument("--form", dest="forms", action="append", choices=FORMS)
    parser.add_argument("--most", type=int, default=2_000, help="states; cells of more are left out")
    given = parser.parse_args()
    forms, out = given.forms or list(FORMS), Path(given.out)
    rows = {}
    if out.exists():
        with out.open(newline="") as file:
            rows = {tuple(row[name] for name in CELL): row for row in csv.DictReader(file)}
    for spec, runs in zip(given.studies[::2], given.studies[1::2], strict=True):
        regrets = outcomes_of(runs)
        for run in study.specification(spec).runs:
            cell = tuple(run.cell[name] for name in CELL)
            if cell[3] != "ppo" or cell not in regrets.index:
                continue
            row = rows.setdefault(cell, dict(zip(CELL, cell, strict=True)))
            row["greedy"] = f"{regrets[cell]:.6g}"
            missing = [form for form in forms if not row.get(form)]
            if missing:
                row |= computed(run.config, missing, given.most)
                print(", ".join(cell), file=sys.stderr, flush=True)
                write(out, rows)
    write(out, rows)
    show(pd.read_csv(out), forms)


def outcomes_of(packed):
    with tempfile.TemporaryDirectory() as folder:
        place, _ = study.unpack(packed, Path(folder) / "study")
        return study.outcomes(study.table(place), study.curves(place)).set_index(list(CELL))["greedy"]


def write(out, rows):
    columns = [*CELL, "greedy", *(form + kind for form in FORMS for kind in KINDS)]
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(rows.values())


def computed(config, forms, most):
    """The columns of some forms, of one cell; none where it has too many states, or no scale of regret."""
    task = task_of(config)
    if task.mdp.num_states > most:
        return {}
    name, initialisation = _network(config, task)
    options = dict(task.observation_options)
    seen = representation(task.space, task.observation, name, initialisation=initialisation, **options)
    schedule = Schedule(steps=config["steps"], gamma=config["hyperparameters"]["gamma"])
    rollouts, clip_range = _rollouts(config)
    solution, row, kernel = value_iteration(task.mdp), {}, None
    for form in forms:
        own = replace(rollouts, clip_range=clip_range if form in ("clipped", "clipped_sampled", "careful") else None)
        try:
            learner = LEARNERS.get(form, PolicyLearner)(task.mdp, schedule, task.time_limit, solution, own)
        except PharosError as error:
            print(error, file=sys.stderr)
            return {}
        observations = Grouped(seen.classes, learner.numbers[learner.states])
        kernel = kernel or Exact(seen.kernel, observations.representatives)
        curve = learner.curve(observations, kernel)
        for kind, value in zip(KINDS, (curve.mean_greedy, curve.mean_played, curve.mean_evaluated), strict=True):
            row[form + kind] = f"{value:.6g}"
    return row


class Sampled(PolicyLearner):
    """Advantages are divided by the standard deviation of sampled ones: that of returns is in it."""

    def advantages(self, memory, policy, v, returns, visits):
        noise = (visits * np.maximum(self._squares(memory, policy, v, returns) - returns**2, 0.0)).sum()
        return standardised(returns - v[:, None], visits, float(noise))

    def _squares(self, memory, policy, v, returns):
        """(N, A) expected squares of the returns G of each choice, G = r + gamma ((1 - lambda) V(s') + lambda G')."""
        share, gamma, rewards = self.rollouts.gae_lambda, self.schedule.gamma, memory.rewards
        mean = (policy * returns).sum(axis=1)
        once = self._following(memory, (1 - share) * v + share * mean)
        squares = returns**2
        for _ in range(MOST_BACKUPS):
            after = ((1 - share) * v) ** 2 + 2 * (1 - share) * share * v * mean
            after = after + share**2 * (policy * squares).sum(axis=1)
            executed = rewards**2 + 2 * gamma * rewards * once + gamma**2 * self._following(memory, after)
            before, squares = squares, self.mdp.chance.chosen_values(executed)  # not of sticky actions
            if np.abs(squares - before).max() <= RETURNS * np.abs(squares).max():
                break
        return squares

    def _following(self, memory, values):
        x = np.zeros(self.mdp.num_states + 1)
        x[memory.states] = values
        return self.mdp.dynamics.expected(x, memory.states)


class Careful(PolicyLearner):
    """Steps are a sixteenth of the largest stable one."""

    def ascended(self, logits, pull, up, apply, rate):
        return super().ascended(logits, pull, up, apply, rate / 16)


class Bounded(PolicyLearner):
    """The logarithm of each probability stays within log(0.8) and log(1.2) of what it was before the rollout."""

    def ascended(self, logits, pull, up, apply, rate):
        behaviour = np.maximum(softmax(logits), 1e-30)
        low, high = (np.log(behaviour) + np.log(1 + sign * 0.2) for sign in (-1, 1))
        for _ in range(self.rollouts.gradient_steps):
            policy = softmax(logits)
            of_action = pull * policy / behaviour
            logits = logits + rate * apply(of_action - policy * of_action.sum(axis=1, keepdims=True))
            logits = np.clip(np.log(np.maximum(softmax(logits), 1e-30)), low, high)
            logits = np.maximum(logits - logits.max(axis=1, keepdims=True), -SPAN)
        return logits


LEARNERS = {"sampled": Sampled, "clipped_sampled": Sampled, "careful": Careful, "bounded": Bounded}


def show(frame, forms):
    """R2 and rank correlation of classes left out, pairs of observations, image or vector: a row each."""
    print("| form | cells | R2 | rank correlation | pairs of observations rightly ordered | image or vector |")
    print("|---|---|---|---|---|---|")
    for form in forms:
        known = frame[frame[form].notna()]
        for kind in KINDS:
            predictions = known[list(CELL)].assign(policy_regret=known[form + kind])
            cells = known[[*CELL, "greedy"]]
            row = study.validation(predictions, cells, predictors=["policy_regret"], permutations=0).iloc[0]
            words = [
                f"{row[name]:.2f} ({row[name + '_lower']:.2f} to {row[name + '_upper']:.2f})"
                for name in ("r_squared", "rho", "agreement")
            ]
            image = f"{row['image_agreement'] * row['image_pairs']:g} of {row['image_pairs']}"
            print(
                f"| `{form}{kind}` | {len(known)} | {words[0]} | {words[1]} | {words[2]} of {row['pairs']} | {image} |"
            )


if __name__ == "__main__":
    main()
