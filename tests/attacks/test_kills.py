"""Every command that writes, killed at any moment: the same command then ends as if nothing had happened."""

import shlex
import shutil
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
import yaml

from attacks.kills import ForkServer, content, processes_in
from patience import wait_for

pytestmark = pytest.mark.long

PPO = "--agent ppo --engine batched --set n_steps=16 --set n_envs=2 --set batch_size=16 --set net_arch=[8]"
DQN = "--agent dqn --set learning_starts=20 --set buffer_size=200 --set net_arch=[8]"
SHORT = "--steps 128 --interval 32"
BLOCK = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "chance": ["plain"], "seeds": [0, 1]}
STUDY = {"name": "mine", "steps": 64, "evaluations": 4, "blocks": [BLOCK]}
SEEDS = """\
import pharos
from pharos.training.schedule import Shapes
Shapes.width = lambda *_: 1  # so that three seeds are work for two processes
small = {"n_steps": 16, "n_envs": 2, "batch_size": 16, "net_arch": [8]}
options = {"steps": 128, "evaluation_interval": 32, "hyperparameters": small, "workers": 2, "out": "runs"}
runs = pharos.train_many("ppo", "frozen_lake/4x4", seeds=range(3), **options)
assert all(run.result for run in runs), runs
"""
BUILD = "build breakout height=7 columns=4 brick_rows=1 --out space"


@dataclass(frozen=True)
class Case:
    """A command, and how often it is killed.

    Attributes:
        command: what is killed. before: what is executed before, undisturbed.
        changes: kills at a change of a file. moments: kills after a while.
        is_same: whether all bytes are to be the same; else names of files alone, and `values` within 1e-6.
    """

    command: str
    before: tuple[str, ...] = ()
    changes: int = 6
    moments: int = 0
    is_same: bool = True


CASES = {
    "build": Case(BUILD, changes=10, moments=4),
    "build on disk": Case("build breakout height=7 columns=5 --memory 128KiB --out space", changes=6, moments=4),
    "build with two workers": Case("build breakout height=7 columns=4 --workers 2 --out space", changes=6, moments=4),
    "solve --values": Case("solve space --values values --out v.npz", (BUILD,), 6, 4, is_same=False),
    "hardness": Case("hardness space --measures diameter,minimal_gap --values values", (BUILD,), 6, 3, is_same=False),
    "train": Case("train frozen_lake/4x4 --steps 200 --interval 20 --out run", changes=10, moments=4),
    "train, batched": Case(f"train frozen_lake/4x4 {PPO} {SHORT} --out run", changes=6, moments=2),
    "train, Stable-Baselines3": Case(f"train frozen_lake/4x4 {DQN} {SHORT} --out run", (), 3, 2, is_same=False),
    "train --seeds": Case(f"train frozen_lake/4x4 {PPO} {SHORT} --seeds 0:2 --out runs", changes=6, moments=4),
    "train_many with two workers": Case(shlex.join(["python", SEEDS]), changes=10, moments=4),
    "study run": Case("study run study.yaml --out study --workers 1", changes=8, moments=4),
    "study pack": Case("study pack study --to mine.parquet", ("study run study.yaml --out study",)),
    "study unpack": Case(
        "study unpack mine.parquet --out copy",
        ("study run study.yaml --out study", "study pack study --to mine.parquet"),
        changes=8,
    ),
    "tune": Case("tune frozen_lake/4x4 --agent q_learning --steps 60 --seeds 0 --trials 3 --out search", (), 8, 2),
    "export": Case("export frozen_lake/4x4 --out game_20_fs1.npz"),
    "import": Case("import bridge game_20_fs1.npz --out mdp", ("export frozen_lake/4x4 --out game_20_fs1.npz",), 10, 1),
    "import with chance": Case("import gymnasium FrozenLake-v1 --out mdp", changes=6, moments=2),
    "submit": Case("benchmark submit run --out mine.safetensors", ("train frozen_lake/4x4 --steps 20 --out run",)),
    "solve, no cache": Case("solve frozen_lake/4x4"),
    "cache clear": Case("cache clear", ("solve frozen_lake/4x4", "solve frozen_lake/8x8")),
}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    programs = {}
    for name, case in CASES.items():
        if name == "cache clear":  # which would be the cache of these tests
            continue
        folder = tmp_path_factory.mktemp("warm")
        (folder / "study.yaml").write_text(yaml.safe_dump(STUDY))
        programs[folder] = [shlex.split(command) for command in (*case.before, case.command)]
    server = ForkServer(programs)
    yield server
    server.close()


@pytest.mark.parametrize("name", CASES)
def test_a_command_that_is_killed_and_repeated_ends_as_if_it_had_not_been(name, server, tmp_path, count):
    case, rng = CASES[name], np.random.default_rng(list(name.encode()))
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "study.yaml").write_text(yaml.safe_dump(STUDY))
    words = shlex.split(case.command)

    def execute(folder, given=words, **kill):
        end = server.execute(given, folder, **kill)
        assert end.is_killed or end.code == 0, f"{shlex.join(given)} {kill}: {end.code}, {end.text}"
        return end

    for command in case.before:
        execute(tmp_path / "given", shlex.split(command))
    whole = shutil.copytree(tmp_path / "given", tmp_path / "whole")
    undisturbed = execute(whole)
    expected = content(whole)

    kills = [{"change": int(k)} for k in rng.permutation(undisturbed.changes)[: case.changes] + 1]
    kills += [{"seconds": undisturbed.seconds * rng.uniform(0.05, 0.9)} for _ in range(case.moments)]
    done: Counter = Counter()
    while kills:
        folder = shutil.copytree(tmp_path / "given", tmp_path / "killed")
        for again in range(min(len(kills), rng.choice([1, 2]))):
            ((how, when),) = (kill := kills.pop()).items()
            end = execute(folder, **kill)
            if end.is_killed:
                done[how] += 1
                done["worker"] += end.is_of_worker
            elif how == "seconds":
                kills.append({how: when / 2})
            elif again:  # less was left to do than before
                kills.append(kill)
                break
        wait_for(lambda folder=folder: not processes_in(folder))  # workers of a process that was killed end with it
        execute(folder)
        assert_same(content(folder), expected, case)
        shutil.rmtree(folder)
    assert done["seconds"] == case.moments and done["change"] >= 0.8 * min(case.changes, undisturbed.changes)
    what = "bytes" if case.is_same else "results"
    kills = done["change"] + done["seconds"]
    where = f"{case.moments} of them at any moment, {done['worker']} of a worker"
    count(f"{kills} kills of {name}, {where}: nothing lost, same {what}")


def assert_same(found, expected, case):
    assert found.keys() == expected.keys()
    if case.is_same:
        for name in found:
            assert found[name] == expected[name], name
