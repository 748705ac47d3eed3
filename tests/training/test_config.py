"""The configuration of a run: its id, which names folders that exist, and its way through a file and back."""

import hashlib
import json

import pytest

import pharos
from pharos import study
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.mdp import random_actions, sticky_actions
from pharos.solvers import value_iteration
from pharos.training import ChanceSetting, Horizon, RunConfig, Task, run_id
from refusals import refusal

LAKE = {"size": 4, "map": None, "seed": None, "frozen_probability": 0.8}
STICKY = {
    "environment": "frozen_lake",
    "parameters": LAKE,
    "chance": {"sticky": 0.25, "random": 0.0},
    "observation": "index",
    "observation_options": {},
    "agent": "q_learning",
    "hyperparameters": {},
    "steps": 2000,
    "seed": 3,
    "gamma": 1.0,
    "horizon": 100,
    "evaluation_interval": 20,
}
GRID = {
    **STICKY,
    "environment": "simple_grid",
    "parameters": {"height": 5, "width": 5, "goal": [4, 4], "rewards": [], "penalties": []},
    "chance": {"sticky": 0.0, "random": 0.1},
    "steps": 1000,
    "seed": 1,
    "gamma": 0.9,
    "horizon": None,
    "evaluation_interval": 10,
}
DEEP = {
    **STICKY,
    "chance": {"sticky": 0.0, "random": 0.1},
    "observation": "vector",
    "agent": "dqn",
    "hyperparameters": {"learning_starts": 50, "buffer_size": 1000, "target_update_interval": 50},
    "steps": 600,
    "evaluation_interval": 6,
}
# As version 0.1.0 named the folders of these runs.
IDS = [(STICKY, "16c6e3a1ce9b5baf"), (GRID, "62d6ef94bab09fc7"), (DEEP, "1a6fa55b55742664")]
# Preset: its first and last run, and a digest of the ids of all runs, which change with hyperparameters of classes.
PRESETS = {
    "quick": ("f61401af6050c7c5", "108e7e8c2348f12e", "7816e81b463bd2d3c9702dae1f64e789f66d5a7ce44cf43dbdfdee20456940b3"),  # noqa: E501
    "small": ("c40d4509c7f775c3", "79bd57c5fcfb019b", "15693fe60ba09179d4a40544027a6fd35dc6d19189a46f75539ba98216fe15c1"),  # noqa: E501
    "paper": ("c40d4509c7f775c3", "4c62fffca280b32d", "403d34b1d5fcc767ed8a133d8d9867d42bd2ab64788bcf79e55e45ec66847e83"),  # noqa: E501
}  # fmt: skip


@pytest.mark.parametrize(("entry", "id"), IDS)
def test_stored_configurations_keep_their_id_and_their_keys(entry, id):
    config = RunConfig.from_dict(entry)
    assert config.id == run_id(entry) == id
    assert config.to_dict() == entry
    assert list(config.to_dict()) == list(entry)


def test_the_options_of_train_make_the_configurations_of_before():
    env = pharos.make("simple_grid", height=5, width=5)
    lake = Task.of("frozen_lake/4x4", sticky=0.25, observation="index")
    grid = Task(env, random=0.1, observation="index", gamma=0.9, horizon=None)
    one = RunConfig.of_task(lake, "q_learning", steps=2000, seed=3)
    other = RunConfig.of_task(grid, "q_learning", steps=1000, seed=1)
    assert (one.id, other.id) == (IDS[0][1], IDS[1][1])


@pytest.mark.parametrize("name", PRESETS)
def test_runs_of_the_presets_keep_their_ids(name):
    runs = study.specification(name).runs
    digest = hashlib.sha256("".join(run.id for run in runs).encode()).hexdigest()
    assert (runs[0].id, runs[-1].id, digest) == PRESETS[name]


@pytest.mark.parametrize("entry", [STICKY, GRID, DEEP])
def test_a_configuration_is_that_of_its_task(entry):
    config = RunConfig.from_dict(json.loads(json.dumps(entry)))
    given = ("steps", "seed", "evaluation_interval", "hyperparameters")
    again = RunConfig.of_task(config.task(), config.agent, **{name: getattr(config, name) for name in given})
    assert again == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": None}, "steps is None"),
        ({"chance": {"windy": 0.1}}, "unknown kind of chance 'windy'"),
        ({"chance": 3}, "a run: chance is 3; expected ChanceSetting"),
        ({"colour": "red"}, "unknown entry 'colour'"),
    ],
)
def test_what_is_no_configuration_is_refused_in_one_line(change, message):
    assert message in refusal(FileFormatError, RunConfig.from_dict, {**STICKY, **change})
    with pytest.raises(FileFormatError, match="lacks agent, seed"):
        RunConfig.from_dict({name: value for name, value in STICKY.items() if name not in ("agent", "seed")})


def test_a_horizon_is_a_number_the_limit_of_the_environment_or_none():
    lake = pharos.make("frozen_lake/4x4")
    settings = (7, "limit", "default", "none", None, Horizon(3))
    assert [Horizon.of(setting).steps(lake) for setting in settings] == [7, 100, 100, None, None, 3]
    for wrong in (0, -1, True, 1.5, "never", 2**31):
        assert "expected a number of steps, limit" in refusal(ParameterError, Horizon.of, wrong)


@pytest.mark.parametrize(("sticky", "random"), [(0.0, 0.0), (0.25, 0.0), (0.0, 0.1), (0.25, 0.1)])
def test_chance_on_an_mdp_is_that_of_its_two_functions(sticky, random):
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp(gamma=0.9)
    chance = ChanceSetting(sticky, random)
    expected = random_actions(sticky_actions(mdp, sticky), random)
    assert value_iteration(chance.of(mdp)).value_at_start == value_iteration(expected).value_at_start
    assert ChanceSetting.from_dict(chance.to_dict()) == chance
    assert bool(chance) == bool(sticky or random)


def test_chance_in_words():
    words = [str(ChanceSetting(*each)) for each in ((0, 0), (0.25, 0), (0, 0.1), (0.5, 0.1))]
    assert words == ["plain", "sticky 0.25", "random 0.1", "sticky 0.5, random 0.1"]
    assert "kind of chance 'windy'" in refusal(UnknownName, ChanceSetting.from_dict, {"windy": 0.1})
