"""Schedules: which runs train together, and in which process. Nothing is trained here."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pharos.training import RunConfig, Shapes, Task, dealt, halves, lanes, plan


def config(agent="dqn", environment="frozen_lake/4x4", seed=0, engine="batched", **options):
    return RunConfig.of_task(Task.of(environment, **options), agent, steps=100, seed=seed, engine=engine)


@given(st.lists(st.sampled_from([None, "a", "b"]), max_size=40), st.integers(1, 5))
def test_lanes_hold_each_run_once_with_equal_keys_and_no_more_than_a_width(keys, width):
    groups = lanes(keys, [width] * len(keys))
    assert sorted(i for lane in groups for i in lane) == list(range(len(keys)))
    assert [lane[0] for lane in groups] == sorted(lane[0] for lane in groups)
    for lane in groups:
        assert len({keys[i] for i in lane}) == 1 and len(lane) <= (1 if keys[lane[0]] is None else width)
    for key in {"a", "b"} & set(keys):
        assert sum(keys[lane[0]] == key for lane in groups) == -(-keys.count(key) // width)


@pytest.mark.long
@given(st.lists(st.floats(0, 100), max_size=30), st.integers(1, 6))
def test_no_worker_is_busier_than_the_mean_and_one_job(costs, workers):
    parts = dealt(costs, workers)
    assert sorted(i for part in parts for i in part) == list(range(len(costs))) and len(parts) <= workers
    most = max((sum(costs[i] for i in part) for part in parts), default=0.0)
    assert most <= sum(costs) / workers + max(costs, default=0.0) + 1e-9


def test_halves_are_the_whole():
    assert halves([1, 2, 3]) == [[1], [2, 3]]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_runs_of_one_shape_are_one_lane_and_others_are_not(device):
    """The device is a name here: a plan for a GPU is made without one."""
    shapes = Shapes(device)
    vector, image = (config(observation=name) for name in ("vector", "simple_image"))
    assert shapes.key(vector) == shapes.key(config(seed=1)) != shapes.key(image)
    assert shapes.key(config(random=0.1)) == shapes.key(vector) != shapes.key(config("ppo"))
    assert shapes.width(vector) == (256 if device == "cuda" else 32)
    assert (shapes.width(vector) == shapes.width(image)) == (device == "cuda")


def test_models_of_stable_baselines3_are_alone_and_tables_share_a_world():
    shapes = Shapes()
    assert shapes.key(config(engine="sb3")) is None and shapes.width(config(engine="sb3")) == 1
    table = config("q_learning", observation="index")
    assert shapes.key(table) == shapes.key(config("q_learning", observation="index", sticky=0.1, seed=3))
    assert shapes.key(table) != shapes.key(config("q_learning", "simple_grid/4x4-plain", observation="index"))


def test_long_runs_begin_first_and_lanes_stay_whole():
    runs = [config(seed=seed) for seed in range(3)] + [config(seed=seed, engine="sb3") for seed in range(3)]
    assert plan(runs, workers=1) == [list(range(6))]
    assert plan(runs, workers=2, seconds=[1, 1, 1, 9, 1, 1]) == [[3], [0, 1, 2, 4, 5]]
    assert plan(runs, workers=9) == [[0, 1, 2], [3], [4], [5]]
