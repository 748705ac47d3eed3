"""Observations that several states share: how many there are."""

import json

import numpy as np
import pytest
from gymnasium import spaces
from typer.testing import CliRunner

import pharos
from pharos.cli import app
from pharos.observations import aliasing, observation_classes, observe


@pytest.fixture(scope="module")
def breakout(tmp_path_factory):
    env = pharos.make("breakout", height=7, columns=4, brick_rows=1)
    return pharos.build(env, tmp_path_factory.mktemp("space") / "breakout", progress=False)


def test_states_that_share_an_image_are_counted(breakout):
    observation = observe(breakout.environment, "simple_image")
    image = aliasing(breakout, observation)
    assert (image.num_states, image.num_observations) == (1658, 1068)
    assert round(100 * image.share, 1) == 62.5
    assert aliasing(breakout, observe(breakout.environment, "vector")).share == 0
    pixels = observation(breakout.states())
    _, classes, counts = np.unique(pixels.reshape(len(pixels), -1), axis=0, return_inverse=True, return_counts=True)
    assert image.num_sharing == counts[counts > 1].sum()
    alive = np.bincount(classes[~breakout.terminal])
    assert image.num_confused == alive[alive > 1].sum() < image.num_sharing
    found = observation_classes(breakout, observation)
    assert len(set(zip(found.tolist(), classes.tolist(), strict=True))) == len(counts) == found.max() + 1


def answer(folder, *words):
    result = CliRunner().invoke(app, ["observations", str(folder), *words, "--json"])
    assert (result.exit_code, result.stderr) == (0, ""), result.output
    return json.loads(result.stdout)


def test_the_command_line_counts_them_for_each_observation(breakout):
    told = answer(breakout.folder)
    assert told["num_states"] == 1658
    entries = {entry["observation"]: entry for entry in told["observations"] if not entry["options"]}
    assert [entries[name]["num_sharing"] for name in ("vector", "one_hot", "index")] == [0, 0, 0]
    for name in ("simple_image", "complex_image"):
        assert (entries[name]["num_observations"], entries[name]["num_sharing"]) == (1068, 1037)
    assert (entries["vector"]["shape"], entries["vector"]["dtype"]) == ([9], "float32")
    (one,) = answer(breakout.folder, "--observation", "simple_image", "--option", "scale=2")["observations"]
    assert (one["options"], one["shape"], one["num_sharing"]) == ({"scale": 2}, [3, 14, 8], 1037)


def test_an_observation_of_ones_own_is_counted_too(breakout):
    from pharos.observations import register

    register("ball_row", lambda env, states: states[:, 0], spaces.Discrete(7))
    (rows,) = answer(breakout.folder, "--observation", "ball_row")["observations"]
    assert (rows["num_observations"], rows["share"], rows["shape"]) == (7, 1.0, [])
    result = CliRunner().invoke(app, ["observations", str(breakout.folder), "--option", "scale=2"])
    assert result.exit_code == 2
    assert "--option goes with --observation" in result.stderr
