"""pharos plot, and pharos evaluate of what runs have learnt: files, answers, and what bad input gets."""

import numpy as np
import pytest
from PIL import Image

import pharos
from command_line import answer, run
from pharos.training import Task, load_agent, read_record, train


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    for agent, seed, steps in (("q_learning", 0, 4000), ("q_learning", 1, 4000), ("ppo", 0, 256)):
        options = {"evaluation_interval": steps // 4, "random": 0.1, "out": place / f"{agent}-{seed}"}
        train(agent, "frozen_lake/4x4", steps=steps, seed=seed, **options)
    return {path.name: path for path in place.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["q_learning-0", "ppo-0"])
def test_what_a_run_has_learnt_has_the_value_that_the_run_wrote_down(folders, name):
    found = answer("evaluate", "frozen_lake/4x4", "--policy", folders[name], "--random", 0.1, "--horizon", 100)
    result = read_record(folders[name])["result"]
    assert found["value_at_start"] == pytest.approx(result["final_value"], abs=1e-6)
    assert found["regret"] == pytest.approx(result["final_regret"], abs=1e-6)
    lost = found["optimal_value_at_start"] - found["worst_value_at_start"]
    assert found["regret_relative_to_worst"] == pytest.approx(found["regret"] / lost)
    own = answer("evaluate", "frozen_lake/4x4", "--policy", folders[name])
    assert {**own, "seconds": 0, "setting": ""} == {**found, "seconds": 0, "setting": ""}
    assert own["setting"] == "the run's own" and found["setting"] == "the run's own, but for horizon, random"
    said = run("evaluate", "frozen_lake/4x4", "--policy", folders[name]).stdout
    assert (", for the probabilities that its network computes in 32 bits" in " ".join(said.split())) == ("ppo" in name)
    assert own["policy_dtype"] == (None if name == "q_learning-0" else "float32")
    other = answer("evaluate", "frozen_lake/4x4", "--policy", folders[name], "--gamma", 0.5, "--random", 0)
    assert (other["gamma"], other["random"], other["horizon"]) == (0.5, 0.0, 100)


@pytest.mark.slow
def test_an_agent_is_read_back_with_its_task(folders):
    task, agent = load_agent(folders["ppo-0"])
    assert (task.env.name, task.random, task.horizon, task.observation) == ("frozen_lake", 0.1, 100, "vector")
    found = pharos.evaluate_policy(task.mdp, agent)
    assert found.value_at_start == pytest.approx(read_record(folders["ppo-0"])["result"]["final_value"], abs=1e-6)


@pytest.mark.long
def test_regret_of_runs_is_drawn(folders, tmp_path):
    out = tmp_path / "regret.png"
    found = answer("plot", "regret", *folders.values(), "--out", out)
    assert found["bytes"] == out.stat().st_size > 5000
    assert run("plot", "regret", folders["ppo-0"], "--out", tmp_path / "regret.svg").stdout.strip().endswith(".svg")


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["optimal", "uniform", "worst", "table", "ppo-0"])
def test_values_of_any_policy_are_drawn(folders, tmp_path, policy):
    given = policy
    if policy == "table":
        given = tmp_path / "policy.npy"
        np.save(given, np.full((16, 4), 0.25))
    words = ("--policy", folders.get(policy, given), "--out", tmp_path / "v.png")
    found = answer("plot", "value", "frozen_lake/4x4", *words)
    if policy in ("uniform", "table"):
        task = Task.of("frozen_lake/4x4", gamma=0.99, horizon=None)
        assert found["value_at_start"] == pytest.approx(task.uniform.value_at_start, abs=2e-6)
    assert found["bytes"] > 5000


@pytest.mark.long
def test_growth_and_the_plane_are_drawn(tmp_path):
    targets = ("frozen_lake/4x4", "simple_grid/4x4-plain")
    grown = answer("plot", "growth", *targets, "--out", tmp_path / "g.png")
    assert grown["num_states"] == {"frozen_lake/4x4": 16, "simple_grid/4x4-plain": 16}
    plane = answer("plot", "plane", *targets, "--out", tmp_path / "p.png")
    assert plane["measures"]["simple_grid/4x4-plain"]["sum_of_reciprocal_gaps"] > 0


@pytest.mark.slow
def test_policies_of_runs_play_beside_the_best_and_a_random_one(folders, tmp_path):
    runs = (folders["ppo-0"], folders["q_learning-0"])
    found = answer("plot", "policies", *runs, "--out", tmp_path / "play.gif", "--steps", 5)
    assert found["policies"] == ["ppo-0", "q_learning-0", "optimal", "random"]
    with Image.open(tmp_path / "play.gif") as gif:
        assert 2 <= gif.n_frames <= 6


@pytest.mark.slow
def test_mistakes_are_one_line(folders, tmp_path):
    for words, said in (
        (("plot", "regret", tmp_path, "--out", tmp_path / "r.png"), "expected the folder of a run"),
        (("plot", "value", "breakout", "--out", tmp_path / "v.gif"), "expected a file name"),
        (("plot", "value", "freeway", "num_cars=1", "--out", tmp_path / "v.png"), "expected row and column"),
        (("plot", "policies", folders["ppo-0"], "--out", tmp_path / "p.png"), "ends in .gif"),
        (("evaluate", "frozen_lake/4x4", "--policy", tmp_path), "expected the folder of a run"),
        (("evaluate", "frozen_lake/8x8", "--policy", folders["q_learning-0"]), "expected 64"),
        (("evaluate", "frozen_lake/4x4", "--policy", "best"), "RUN_DIR"),
    ):
        done = run(*words)
        assert done.exit_code in (1, 2)
        assert said in done.stderr and len(done.stderr.strip().splitlines()) == 1
