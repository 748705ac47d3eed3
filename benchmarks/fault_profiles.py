"""Profiles of known faults for `pharos diagnose`: readings of small agents, healthy ones and ones with a fault.

    python benchmarks/fault_profiles.py --rounds 3
    python benchmarks/fault_profiles.py --rounds 3 --scores
    python benchmarks/fault_profiles.py --read DIR

Each round has all faults once, each with hyperparameters and seeds of its own, and three healthy agents of each kind.
An agent takes about 6 s of a processor. Writes src/pharos/benchmark/data/fault_profiles.csv.

With `--read DIR` it runs nothing: of each finished run in a folder of DIR it prints what `compare`, the page and
`diagnose` say, beside the shipped DQN, as a row of a table.

With `--scores` it writes fault_scores.csv beside it: what a finished run has of some tasks of v1, of all but agents
whose seeds are ignored, and of two healthy ones a round. An agent takes about 2 s a task.
"""

import argparse
import csv
import zlib
from pathlib import Path

import numpy as np

from pharos.benchmark import faults, load_suite
from pharos.benchmark.agent_diagnosis import diagnosis_of_results
from pharos.benchmark.comparison import WORSE, compare_groups
from pharos.benchmark.contents import contents_of, residual_tasks
from pharos.benchmark.diagnosis import (
    fall_everywhere,
    groups_of,
    is_own,
    lowest_rungs,
    nearest,
    play_sentences,
    policy_sentences,
    random_play,
    seeds_sentence,
    suspicion,
    worst_groups,
)
from pharos.benchmark.doctor import readings
from pharos.benchmark.examination import NAMES, examine
from pharos.benchmark.play import late_play
from pharos.benchmark.profiles import DECIMALS, IMAGE_TASK, PROFILES_FILE, SCORED_TASKS, SCORES, run_readings
from pharos.training.budget import generated_curve

FURTHER = 100  # between numbers of the healthy agents of a round


def setting(agent, fault, number):
    """Hyperparameters of an agent of a round; in round 0 its own."""
    if not number:
        return {}
    rng = np.random.default_rng([number, zlib.crc32(f"{agent}/{fault}".encode())])
    values = {
        "width": int(rng.choice([16, 32, 64])),
        "learning_rate": float(np.exp(rng.uniform(np.log(5e-4), np.log(2e-3)))),
        "gamma": float(rng.choice([0.9, 0.95, 0.99])),
        "batch_size": int(rng.choice([16, 32, 64])),
    }
    if agent == "dqn":
        return values | {"target_interval": int(rng.choice([100, 200, 400]))}
    return values | {"rollout": int(rng.choice([32, 64])), "epochs": int(rng.choice([5, 10]))}


def agents(rounds):
    """Yield (agent, fault, number) of all agents."""
    for number in rounds:
        for agent, table in faults.FAULTS.items():
            for again in range(3):
                yield agent, faults.HEALTHY, number + FURTHER * again
            for fault in table:
                yield agent, fault, number


def examinations(agent, fault, number):
    """Examinations of one agent: all worlds with one seed, and some with another one."""
    learn = faults.faulty_agent(agent, fault, **setting(agent, fault, number))
    again = examine(learn, worlds=NAMES[::4], seeds=[10 * number + 1])
    return examine(learn, seeds=[10 * number]) + again


def scores(agent, fault, number):
    """Readings of one agent's runs of SCORED_TASKS and the image, with one seed."""
    suite, curves, policies, play = load_suite("v1"), {}, {}, {}
    protocol = suite.protocol
    for name in (*SCORED_TASKS, IMAGE_TASK):
        learn = faults.faulty_agent(agent, fault, **setting(agent, fault, number))
        options = {"steps": protocol.steps, "evaluations": protocol.evaluations, "seed": 10 * number}
        with np.errstate(all="ignore"):
            curve = generated_curve(learn, suite.task(name).check(protocol), **options)
        curves[name] = np.array([[row["normalized_regret"] for row in curve.rows[1:]]])
        policies[name] = curve.policies
        play[name] = late_play(curve.rows, curve.result())
    return run_readings(curves, policies, {name: facts["regret"] for name, facts in play.items() if facts})


def write(rows, file=PROFILES_FILE):
    """Write (agent, fault, readings) as a table."""
    names = list(dict.fromkeys(name for *_, numbers in rows for name in numbers if not name.startswith("regret_")))
    names += [f"regret_{name}" for name in NAMES] if file == PROFILES_FILE else []
    with open(file, "w", encoding="utf-8", newline="") as lines:
        table = csv.writer(lines, lineterminator="\n")
        table.writerow(["agent", "fault", *names])
        for agent, fault, numbers in rows:
            values = [f"{round(numbers[name], DECIMALS) + 0.0:g}" if name in numbers else "" for name in names]
            table.writerow([agent, fault, *values])


def told(folder):
    """(difference on the core and each axis, sentences of the page, what diagnose says) of a finished run."""
    contents = contents_of(folder, predictor="dqn")
    ours, index = contents.agent.results, nearest(contents)[0]
    comparison, theirs = contents.comparisons[index], contents.beside[index].results
    differences = {"core": comparison.core, **{axis: each.score for axis, each in comparison.axes.items()}}
    numbers = [
        f"{name} {each.interval.value:+.2f}{' worse' * (each.verdict == WORSE)}"
        for name, each in differences.items()
        if each is not None
    ]
    kinds = groups_of(contents)
    groups = {name: names for each in kinds for name, names in each.items()}
    tables = [compare_groups(ours, theirs, each) for each in kinds]
    own_words = [*seeds_sentence([contents.agent]), *random_play(ours), fall_everywhere(contents)]
    own_words += [*lowest_rungs(contents), *worst_groups(tables, groups, ours, theirs)]
    own_words += [suspicion(ours, theirs, groups)]
    own_words += [text for text in policy_sentences(contents) if not text.startswith("Deterministic")]
    own_words += play_sentences(contents)
    residuals = [task.name for task, own, _ in residual_tasks(contents) if is_own(contents, task, own.value)]
    own_words += [f"Residuals of its own: {', '.join(residuals)}."] if residuals else []
    said = diagnosis_of_results(contents)
    shares = ", ".join(f"{name} {share:.2f}" for name, share, _ in said.nearest())
    others = "".join(f" {each.wrong}." for each in said.findings[1:])
    return ", ".join(numbers), " ".join(filter(None, own_words)), f"{said.verdict}{others} Nearest: {shares}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scores", action="store_true")
    parser.add_argument("--read", type=Path, metavar="DIR")
    options, rows = parser.parse_args(), []
    if options.read:
        for folder in sorted(path for path in options.read.iterdir() if path.is_dir()):
            print("|", " | ".join((folder.name, *told(folder))), "|", flush=True)
        return
    for agent, fault, number in agents(range(options.rounds)):
        if options.scores and (fault == "seeds_ignored" or number >= 2 * FURTHER):
            continue
        numbers = scores(agent, fault, number) if options.scores else readings(examinations(agent, fault, number))
        rows.append((agent, fault, numbers))
        print(agent, fault, number, flush=True)
    write(rows, SCORES if options.scores else PROFILES_FILE)


if __name__ == "__main__":
    main()
