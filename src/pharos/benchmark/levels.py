"""Worlds of many levels: an agent learns on some levels of a generator, and is measured on others, exactly.

    levels_of("frozen_lake", {"size": 6}, train=64, held_out=100)

is one MDP, the disjoint union of 164 levels. An episode of training begins in one of the 64, each as likely. Values and
regret are those of episodes that begin in one of the 100, which no agent sees (`pharos.training.HELD_OUT`). Without
held-out levels they are those of the levels that it learns on.
"""

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment, make
from pharos.errors import FileFormatError
from pharos.mdp import TabularMDP
from pharos.observations import observe
from pharos.state_space import build
from pharos.system import mdp_files, storage
from pharos.system.distinct_rows import DistinctRows
from pharos.training import HELD_OUT

if TYPE_CHECKING:
    from pharos.benchmark.suite import BenchmarkTask, Suite

ENVIRONMENT_NAME = "levels"
"""Environment of a task of a suite that is such a world; its parameters are those of `levels_of`."""
FIRST_HELD_OUT = 1_000_000
"""Seed of the first held-out level; those of training levels are 0, 1, 2, ..."""
OBSERVATION_OF_OVERLAP = "simple_image"


def levels_of(world: str, options: Mapping[str, Any], *, train: int, held_out: int = 0) -> Environment:
    """The environment of several levels of a generator, which is kept in the user's cache.

    Its observation "recorded" is a grid of codes (columns, rows, planes): `simple_image` of the level, from the first
    row and column on that show anything.

    Args:
        world, options: as `pharos.make` takes them, but for the seed. Nothing in it is random but its layout.
        train: levels with the seeds 0 to train - 1.
        held_out: levels with the seeds from 1,000,000 on.
    Cost: 15 ms a level at some hundred states each, the first time.
    """
    key = [world, make(world, **options, seed=0).version, dict(options), train, held_out, mdp_files.VERSION]
    folder = storage.cache_directory() / ENVIRONMENT_NAME / storage.digest_of_json(key)
    if not _is_whole(folder):
        if not (folder / storage.LOCK).exists():  # nobody is writing it
            shutil.rmtree(folder, ignore_errors=True)
        _write(folder, world, dict(options), train, held_out)
    return make("imported", folder=str(folder))


def _is_whole(folder: Path) -> bool:
    """Whether a folder has the levels, undamaged. If not, they are written anew."""
    try:
        return mdp_files.is_folder(folder) and bool(mdp_files.read_arrays(folder, mdp_files.read_mdp_manifest(folder)))
    except (FileFormatError, ValueError):
        return False


def _write(folder: Path, world: str, options: dict[str, Any], train: int, held_out: int) -> None:
    """Write the union of levels into a folder."""
    from pharos import importers

    successors, rewards, terminal, pictures, starts = [], [], [], [], []
    first = 0
    seeds = [*range(train), *range(FIRST_HELD_OUT, FIRST_HELD_OUT + held_out)]
    for seed in seeds:
        env = make(world, **options, seed=seed)
        with tempfile.TemporaryDirectory() as directory:
            space = build(env, directory, progress=False)
            mdp, states = space.mdp(gamma=1.0), space.states()
            successors.append(np.asarray(space.successors, np.int64) + first)
            rewards.append(np.asarray(mdp.rewards, np.float64))
            terminal.append(np.asarray(mdp.terminal, bool))
        pictures.append(_cropped(observe(env, OBSERVATION_OF_OVERLAP)(states)))
        starts.append(first)  # the state that is found first
        first += len(states)
    initial = np.zeros(first)
    initial[starts] = np.where(np.arange(len(seeds)) < train, 1.0 / train, HELD_OUT)
    union = TabularMDP.from_arrays(
        np.concatenate(successors),
        np.concatenate(rewards),
        gamma=1.0,
        initial=initial,
        horizon=int(env.max_episode_steps),
        terminal=np.concatenate(terminal),
    )
    height, width = (max(each.shape[axis] for each in pictures) for axis in (2, 3))
    grids = [
        np.pad(each, ((0, 0), (0, 0), (0, height - each.shape[2]), (0, width - each.shape[3]))) for each in pictures
    ]
    shown = np.concatenate(grids).transpose(0, 3, 2, 1)
    source = f"{world}: {train} levels, {held_out} held out"
    importers.save(union, folder, source=source, actions=env.actions, observations=shown, observed="grid")


def _cropped(images: np.ndarray) -> np.ndarray:
    """(S, C, H, W) images of a level without the rows and columns around it that are empty in all of them."""
    shown = np.asarray(images.any(axis=(0, 1)))
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    return images[:, :, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def has_held_out(task: "BenchmarkTask") -> bool:
    """Whether a task measures on levels that no episode of training begins in."""
    return task.environment == ENVIRONMENT_NAME and bool(task.parameters["held_out"])


def twins(suite: "Suite") -> list[tuple["BenchmarkTask", "BenchmarkTask"]]:
    """Pairs of tasks on the same training levels, measured on these and on held-out ones, in the suite's order."""
    unsplit = {
        json.dumps({**task.parameters, "held_out": 0}, sort_keys=True): task
        for task in suite.tasks
        if task.environment == ENVIRONMENT_NAME and not has_held_out(task)
    }
    pairs = []
    for task in suite.tasks:
        own = unsplit.get(json.dumps({**task.parameters, "held_out": 0}, sort_keys=True))
        if own is not None and own is not task:
            pairs.append((own, task))
    return pairs


def overlap(env: Environment) -> float:
    """Share of the distinct observations of held-out levels that training levels show as well, without terminal states.

    Args:
        env: of `levels_of`, with held-out levels.
    """
    from pharos import importers

    folder = env.parameters["folder"]
    mdp, shown = importers.load(folder), mdp_files.read_observations(folder, mdp_files.read_mdp_manifest(folder))
    assert shown is not None
    if isinstance(shown, DistinctRows):
        which = shown.index
    else:
        _, which = np.unique(shown.reshape(len(shown), -1), axis=0, return_inverse=True)
    first = mdp.start_states[mdp.start_probabilities <= HELD_OUT].min()
    is_held_out, goes_on = np.arange(len(which)) >= first, ~np.asarray(mdp.terminal, bool)
    theirs = np.unique(which[is_held_out & goes_on])
    return float(np.isin(theirs, which[~is_held_out & goes_on]).mean())
