"""Sealed halves of a suite: tasks unknown until a public random draw, and as hard as the public ones.

A *copy* of a task is the same MDP with other names: its actions are permuted, and so are the entries of what is seen.
Values, gaps, diameter and the regret of learners with fully connected networks are those of the public task, since a
permutation of inputs or outputs changes neither the kernel nor the initial distribution of such a network. So a score
that is lower on copies is what an agent has learnt of the public tasks before its runs.

An *instance* is another draw of a random generator: a map, a mapping of actions, words of a hash. It is of the same
kind, and its measures are its own. Images have instances alone: permuted pixels are another task for convolutions.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.suite import CORE, BenchmarkTask, Protocol, Suite, digest_of_suite, digest_of_task
from pharos.environments import make
from pharos.errors import MissingExtra, ParameterError
from pharos.importers import ImportedOutcomes, save
from pharos.mdp import TabularMDP, paid_outcomes
from pharos.system import storage
from pharos.training import Task

SEEDS = ("seed", "mapping_seed")
"""Parameters of environments that say which draw of a generator an instance is."""
DRAWS = 20
"""Of an instance in which something can be learnt, at most."""


def season_seed(season: str, beacon: str) -> str:
    """SHA-256, hexadecimal, of the name of a season and the text of its round of a public beacon, without blanks.

    Raises:
        ParameterError: one of them is empty.
    """
    words = ["".join(text.split()).lower() for text in (season, beacon)]
    if not all(words):
        raise ParameterError(f"season {season!r}, beacon {beacon!r}; expected a name and the output of a round")
    return hashlib.sha256("\n".join(("pharos benchmark", *words)).encode()).hexdigest()


def sealed_copies(suite: Suite, seed: str, folder: str | os.PathLike) -> Suite:
    """Copies of the tasks of a suite, each with permuted actions and entries of observations.

    The copy of the entry i of an observation is entry entries[i] of the public one, and action a is actions[a]; both
    are drawn from the SHA-256 of the seed and the name of the task. Tasks have the names, levels and predictions of
    the public ones. What is seen in several steps (frames, irrelevant entries) and images are left out.

    Args:
        seed: such as `season_seed` gives.
        folder: where their MDPs are written, one folder each; what is there is written again.
    Raises:
        ParameterError: no task can be copied; the folder holds something else.
    Cost: as building the states of each task; of those with chance, another pass over their outcomes.
    """
    copies = {
        task.name: _copy(task, suite.protocol, _generator(seed, task.name), Path(folder) / task.name)
        for task in suite.tasks
    }
    return _suite(suite, seed, {name: task for name, task in copies.items() if task is not None})


def write_suite(suite: Suite, file: str | os.PathLike) -> None:
    """Replace a file by a suite, as `load_suite` reads it.

    Raises:
        MissingExtra: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise MissingExtra("writing a suite", "pyyaml", "study") from error
    entry = storage.plain(asdict(suite))
    for each in (*entry["core"], *(task for ladder in entry["ladders"] for task in ladder["tasks"])):
        del each["axis"]
    storage.replace_file(file, yaml.safe_dump(entry, sort_keys=False, allow_unicode=True).encode())


def sealed_instances(suite: Suite, seed: str) -> Suite:
    """Instances of a suite's core from other seeds of their generators: maps, mappings of actions, words of a hash.

    Tasks have the names of the public ones and no predictions. Where uniform play is optimal, the next draw counts.

    Raises:
        ParameterError: no task of the core has a generator.
    Cost: as solving the tasks.
    """
    instances = {task.name: _instance(task, suite.protocol, _generator(seed, task.name)) for task in suite.core}
    return _suite(suite, seed, {name: task for name, task in instances.items() if task is not None})


def _generator(seed: str, name: str) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed}\n{name}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest, "little"))


def _suite(suite: Suite, seed: str, tasks: Mapping[str, BenchmarkTask]) -> Suite:
    if not tasks:
        raise ParameterError(f"suite {suite.name}: no task can be sealed; expected vectors, or generators with a seed")
    ladders = [
        replace(each, tasks=tuple(tasks[t.name] for t in each.tasks if t.name in tasks)) for each in suite.ladders
    ]
    half = replace(
        suite,
        name=f"{suite.name}-{seed[:8]}",
        core=tuple(tasks[task.name] for task in suite.core if task.name in tasks),
        ladders=tuple(each for each in ladders if each.tasks),
    )
    return replace(half, digest=digest_of_suite(half))


def _copy(task: BenchmarkTask, protocol: Protocol, draw: np.random.Generator, folder: Path) -> BenchmarkTask | None:
    public = task.training_task(protocol)
    observation = public.observer.observe.observation
    shape = observation.space.shape or ()
    if len(shape) != 1 or observation.frames > 1 or observation.irrelevant:
        return None
    mdp, env = public.space.mdp(gamma=protocol.gamma), public.env
    actions, entries = draw.permutation(mdp.num_actions), draw.permutation(shape[0])
    permuted, outcomes = permuted_actions(mdp, actions)
    save(
        permuted,
        folder,
        source=f"sealed copy of {task.name}",
        actions=[f"action {i}" for i in range(mdp.num_actions)],
        time_limit=env.max_episode_steps,
        observations=observation(public.space.states())[:, entries],
        observed="vector",
        outcomes=outcomes,
    )
    parameters = make("imported", folder=str(folder)).parameters
    return frozen(
        replace(task, environment="imported", parameters=parameters, observation="recorded", observation_options={}),
        protocol,
    )


def permuted_actions(mdp: TabularMDP, actions: np.ndarray) -> tuple[TabularMDP, ImportedOutcomes | None]:
    """The MDP whose action i is action actions[i] of another one, and its outcomes where it has chance.

    Args:
        mdp: without sticky, random or lazy actions.
        actions: a permutation of 0 .. A-1.
    """
    num_states, num_actions = mdp.num_states, mdp.num_actions
    initial = np.zeros(num_states)
    initial[mdp.start_states] = mdp.start_probabilities
    options: dict[str, Any] = {"gamma": mdp.gamma, "horizon": mdp.horizon, "initial": initial, "terminal": mdp.terminal}
    if mdp.is_deterministic:
        table = np.asarray(mdp.dynamics.deterministic_table())
        return TabularMDP.from_arrays(table[:, actions], np.asarray(mdp.rewards)[:, actions], **options), None
    which, after, rewards, probabilities = paid_outcomes(mdp)
    rows = which // num_actions * num_actions + np.argsort(actions)[which % num_actions]
    order = np.argsort(rows, kind="stable")
    rows = rows[order]
    after = np.where(after == num_states, -1, after)[order]
    counts = np.bincount(rows, minlength=num_states * num_actions)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    outcomes = ImportedOutcomes(offsets, after, probabilities[order], rewards[order])
    place = np.arange(len(rows)) - offsets[rows]
    tables = [np.zeros((num_states * num_actions, counts.max()), kind) for kind in (np.int64, float, float)]
    for table, values in zip(tables, outcomes[1:], strict=True):
        table[rows, place] = values
    shape = (num_states, num_actions, -1)
    return TabularMDP.from_outcomes(*(table.reshape(shape) for table in tables), **options), outcomes


def _instance(task: BenchmarkTask, protocol: Protocol, draw: np.random.Generator) -> BenchmarkTask | None:
    values = make(task.environment, **task.parameters).parameters
    seeds = [name for name in SEEDS if values.get(name) is not None]
    if not seeds and task.observation != "hash":
        return None
    for _ in range(DRAWS):
        number = int(draw.integers(2**31))
        options = (
            {**task.observation_options, "seed": number} if task.observation == "hash" else task.observation_options
        )
        parameters = {**task.parameters, **dict.fromkeys(seeds, number)}
        instance = frozen(
            replace(task, parameters=parameters, observation_options=options, predicted={}, axis=CORE), protocol
        )
        if instance.value_optimal - instance.value_uniform > 1e-6 * max(1.0, abs(instance.value_optimal)):
            return instance
    raise ParameterError(f"task {task.name}: uniform play is optimal in {DRAWS} draws; leave it out of the suite")


def frozen(task: BenchmarkTask, protocol: Protocol) -> BenchmarkTask:
    """A copy of the task with its digest and values. Cost: as solving it."""
    solved: Task = task.training_task(protocol)
    reference = solved.reference
    return replace(
        task, value_optimal=reference.optimal, value_uniform=reference.uniform, digest=digest_of_task(solved)
    )
